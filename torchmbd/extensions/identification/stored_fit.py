"""A fit problem that keeps its evaluations on disk, so that a fit that was killed continues with what was evaluated.

    status     "ok" and, in further lines, the notes of the evaluation
    numbers    differences of model and data, then residuals of priors, as constraints of an evaluation (evaluations.py), with
               their derivatives; without the deviations that a fit estimates and changes

The fit is deterministic: continued, it asks for the same designs again, and goes on where it was. Steps that the experiments
leave open are chosen once, by the motions of the start, before anything is asked for.
Checked in tests/extensions/identification/test_files.py.
"""

from __future__ import annotations

from typing import Any, Self

import numpy as np

from torchmbd.extensions.identification.fit_problem import FitProblem, Residuals
from torchmbd.math.digest import digest
from torchmbd.optimization import Evaluation
from torchmbd.results.motion_data import OK
from torchmbd.study.record.evaluations import Evaluations


class StoredFit(FitProblem):
    """A problem with a store; made by `of`.

    counts   "hits", "computed": designs that were on disk, and others
    """

    store: Evaluations
    counts: dict[str, int]

    @classmethod
    def of(cls, problem: FitProblem, store: Evaluations, counts: dict[str, int]) -> Self:
        """The problem with a store."""
        result = object.__new__(cls)
        vars(result).update(vars(problem), store=store, counts=counts)
        return result

    @property
    def _units(self) -> np.ndarray:
        return np.concatenate([self.deviations, np.ones(len(self.prior_rows))])

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[Residuals]:
        """Residuals of unknowns [lanes, n]: those in the store, others are computed and stored."""
        X = np.asarray(X, dtype=float)
        known = self.store.find(X, gradients)
        missing = [k for k, x in enumerate(known) if x is None]
        if missing:
            units = self._units
            made = [_evaluation(x, units, X.shape[1]) for x in super().evaluate(X[missing], gradients)]
            self.store.keep(X[missing], gradients, made)
            for k, x in zip(missing, made, strict=True):
                known[k] = x
            self.counts["computed"] += len(missing)
        self.counts["hits"] += len(X) - len(missing)
        return [_residuals(x, self._units, gradients) for x in known if x is not None]


def _evaluation(x: Residuals, units: np.ndarray, n: int) -> Evaluation:
    status = "\n".join([x.status, *x.notes])
    if x.jacobian is None:
        return Evaluation(0.0, x.values * units, status=status)
    return Evaluation(0.0, x.values * units, np.zeros(n), x.jacobian * units[:, None], status)


def _residuals(x: Evaluation, units: np.ndarray, gradients: bool) -> Residuals:
    status, *notes = x.status.split("\n")
    slopes = x.constraint_gradients if gradients and status == OK else None
    return Residuals(x.constraints / units, None if slopes is None else slopes / units[:, None], status, tuple(notes))


def fit_key(problem: FitProblem) -> str:
    """Hash of all that the numbers of a problem depend on, but values of the unknowns."""
    parts: list[Any] = [
        problem.measured,
        problem.steps,
        problem.prior_rows,
        problem.prior_mean,
        problem.prior_deviation,
    ]
    unknown: list[Any] = []
    for name, experiment in problem.experiments.items():
        own = dict(experiment.system.named_parameters())
        unknown += [own[key] for key in problem.space.variables if key in own]
        unknown += [x for measurement in experiment.measurements for x in measurement.unknowns.values()]
        parts += [name, experiment.system, experiment.settings, experiment.duration]
        parts += [experiment.simulation.settings]
        parts += [list(measurement.unknowns) for measurement in experiment.measurements]
        parts += [vars(measurement) for measurement in experiment.measurements]
    return digest(parts, problem.space.entries, problem.space.links, problem.space.offset, ignored=unknown)
