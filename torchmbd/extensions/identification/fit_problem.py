"""The least-squares problem of an identification: residuals of all experiments and priors, by all unknowns, with Jacobians.

    r = (prediction - measured) / deviation, then (b - mean) / deviation of priors          [rows]
    dr/db = (d prediction / d entries) map                                                  [rows, n]

Unknowns are entries of parameters of systems and of measurements, in one DesignSpace with bounds and links. Designs of a batch
are lanes of one motion for each experiment. A design that cannot be simulated has a status, and no numbers.
Checked in tests/extensions/identification/test_fit_problem.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchmbd.design.scenario_settings import MAKE_PARAMETER
from torchmbd.design.space import DesignSpace
from torchmbd.diagnosis.repetition import finer_count
from torchmbd.errors import InputError, SimulationFailure
from torchmbd.extensions.identification.experiment import Experiment
from torchmbd.extensions.identification.measurement import Block, Measurement
from torchmbd.extensions.identification.run import Run
from torchmbd.integrate.arguments import of_allowed_sign
from torchmbd.integrate.memory import lanes_at_once
from torchmbd.integrate.step_count import FEWEST
from torchmbd.math.checked_numbers import list_of
from torchmbd.results.motion_data import OK

LEAST_SPREAD = 1e-12  # of the largest number of a channel: below, its numbers are equal


@dataclass(frozen=True)
class Residuals:
    """Residuals of one design [rows], in deviations, and their derivatives [rows, n] by its unknowns; None: not asked for.

    A status but "ok" is the reason of a failure; then there are no numbers.
    """

    values: np.ndarray
    jacobian: np.ndarray | None = None
    status: str = OK
    notes: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """True if there are numbers."""
        return self.status == OK


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of a block among all residuals.

    name    of the channel, with that of its experiment where there are several
    rows    of the residuals;  scale: deviation that divides them [rows], in the unit of the block
    """

    name: str
    experiment: str
    block: Block
    rows: slice

    @property
    def estimated(self) -> bool:
        """True if the deviation is estimated from the residuals."""
        return self.block.deviation is None


class FitProblem:
    """See the module header.

    experiments   by name
    unknowns      names of parameters of their systems; those of measurements are unknowns of themselves
    bounds, start, links   as in DesignSpace
    priors        parameter name -> (mean, standard deviation), of its entries
    """

    def __init__(
        self,
        experiments: Mapping[str, Experiment],
        unknowns: Sequence[str],
        bounds: Any = (-np.inf, np.inf),
        start: Any = None,
        links: Any = None,
        priors: Mapping[str, Any] | None = None,
    ):
        parameters = _parameters_of_systems(experiments, unknowns)
        self._names = {name: _own_names(name, x, parameters, len(experiments) > 1) for name, x in experiments.items()}
        if not parameters:
            raise InputError(
                "unknowns", unknowns, "names of parameters, or mbd.variable(...) in a channel", state="is empty"
            )
        self.space = DesignSpace.of_parameters(parameters, bounds, start, links)
        self._keep_positive(experiments)
        self.experiments = self._within(experiments, self._names)
        self.rows = _rows(self.experiments)
        self.data = self.rows[-1].rows.stop
        self.prior_rows, self.prior_mean, self.prior_deviation = self._priors(priors or {})
        self.deviations = np.concatenate([_first_deviation(x.block) for x in self.rows])
        self.measured = np.concatenate([x.block.measured for x in self.rows])
        self.steps: dict[str, int | None] = {name: x.steps for name, x in experiments.items()}
        self.multiples: dict[str, int] = {}  # of which steps of an experiment are one, known from its motions
        count = self.data + len(self.prior_rows)
        searched = [name for name, low, high in zip(self.names, self.lower, self.upper, strict=True) if low < high]
        if count < len(searched):
            raise InputError(
                "unknowns",
                searched,
                "at most as many unknowns as numbers",
                state=f"are {len(searched)} ({', '.join(searched)}), but there are only {count} measured numbers and priors",
            )

    def _within(
        self, experiments: Mapping[str, Experiment], names: Mapping[str, Mapping[str, str]]
    ) -> dict[str, Experiment]:
        """Experiments without the numbers that no model within the bounds has, or that has none at the start."""
        entries = self.space.designs(self.start[None])
        return {name: x.within(self.limits(names[name]), entries) for name, x in experiments.items()}

    def _keep_positive(self, experiments: Mapping[str, Experiment]) -> None:
        """Lower bounds of zero for what must not be negative, such as masses and moduli, where lower ones are asked for."""
        negative = torch.tensor([-1.0], dtype=torch.float64)
        for k, name in enumerate(self.space.names):
            parameter = name.rpartition("[")[0]
            holders = [x.system for x in experiments.values() if parameter in dict(x.system.named_parameters())]
            signs = [of_allowed_sign(system, parameter, negative)[0] for system in holders]
            if self.space.start[k] >= 0.0 and any(not bool(allowed) for allowed in signs):
                self.space.lower[k] = max(self.space.lower[k], 0.0)

    @property
    def names(self) -> list[str]:
        """One label for each unknown [n]."""
        return self.space.names

    @property
    def start(self) -> np.ndarray:
        """Initial values [n]."""
        return self.space.start

    @property
    def lower(self) -> np.ndarray:
        """Lower bounds [n]."""
        return self.space.lower

    @property
    def upper(self) -> np.ndarray:
        """Upper bounds [n]."""
        return self.space.upper

    @property
    def origins(self) -> np.ndarray:
        """Which unknowns [n] are offsets and delays of sensors: their size says where an origin lies, not how they change."""
        labels = {
            x for names in self._names.values() for local, x in names.items() if local.endswith(("offset", "delay"))
        }
        return np.array([name.rpartition("[")[0] in labels for name in self.names], dtype=bool)

    def limits(self, names: Mapping[str, str]) -> dict[str, tuple[float, float]]:
        """Bounds of unknowns of measurements; names: their name in the measurement -> name of the parameter."""
        result = {}
        for local, name in names.items():
            [entry] = [i for i, x in enumerate(self.space.entries) if x == f"{name}[0]"]
            of_entry = self.space.links.entry == entry
            moves, factors = self.space.links.variable[of_entry], self.space.links.factor[of_entry]
            ends = factors * np.stack([self.lower[moves], self.upper[moves]])
            constant = self.space.offset[entry]
            result[local] = float(ends.min(0).sum() + constant), float(ends.max(0).sum() + constant)
        return result

    def _priors(self, priors: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Unknowns with a prior, their means and deviations."""
        if not isinstance(priors, Mapping):
            raise InputError("priors", priors, "a mapping parameter name -> (mean, standard deviation)")
        means, deviations = {}, {}
        for name, pair in priors.items():
            if not isinstance(pair, (tuple, list)) or len(pair) != 2:
                raise InputError(("prior", name), pair, "(mean, standard deviation)", noun=f"prior of {name}")
            means[name], deviations[name] = pair
        nothing = np.full(len(self.names), np.nan)
        mean = self.space.vector("prior", means, nothing, "mean of the prior")
        deviation = self.space.vector("prior", deviations, nothing, "deviation of the prior")
        rows = np.flatnonzero(np.isfinite(mean))
        for row in rows:
            if not 0.0 < deviation[row] < np.inf:
                noun, value = f"deviation of the prior of {self.names[row]}", float(deviation[row])
                raise InputError(("prior", self.names[row]), value, "above 0", noun=noun, shown=f"{value:g}")
        return rows, mean[rows], deviation[rows]

    @property
    def estimated(self) -> bool:
        """True if the deviations of some channels are estimated from the residuals."""
        return any(x.estimated for x in self.rows)

    def with_deviations(self, deviations: np.ndarray) -> FitProblem:
        """The same problem with other deviations of the measured numbers [data]."""
        result = object.__new__(type(self))
        vars(result).update(vars(self), deviations=deviations)
        return result

    def with_steps(self, steps: Mapping[str, int | None]) -> FitProblem:
        """The same problem with other steps of the motions of experiments, by name."""
        result = object.__new__(FitProblem)  # without what a subclass keeps of evaluations by other steps
        vars(result).update(vars(self), steps={**self.steps, **steps})
        return result

    def rows_of(self, experiment: str) -> slice:
        """The rows of the data that an experiment has."""
        rows = [x.rows for x in self.rows if x.experiment == experiment]
        return slice(rows[0].start, rows[-1].stop)

    def has_unknown_gain(self, row: Rows) -> bool:
        """True if the gain of a channel is an unknown."""
        return f"{row.block.channel}.gain" in self._names[row.experiment]

    def errors_by_steps(self, x: np.ndarray, shown: np.ndarray) -> tuple[dict[str, np.ndarray], dict[str, str]]:
        """True minus predicted numbers by the steps of each experiment with a motion, in SI, by name; and why not, by name.

        x   a design [n];  shown: its predictions [data]. Experiments without equal steps of a method of second order have none.
        """
        errors, reasons = {}, {}
        for name, experiment in self.experiments.items():
            steps = self.steps[name]
            if steps is None or not experiment.has_steps(self.limits(self._names[name])):
                continue
            if name not in self.multiples:
                self._of_experiment(name, x[None], False)
            more = finer_count(steps, self.multiples.get(name, 1))
            try:
                [finer] = self.with_steps({name: more})._of_experiment(name, x[None], False)
                reason = "" if finer.ok else finer.status
            except (InputError, SimulationFailure) as error:
                finer, reason = None, str(error)
            if finer is None or reason:
                reasons[name] = f"with {more} steps: {reason}"
            else:
                errors[name] = (finer.values - shown[self.rows_of(name)]) / (1.0 - (steps / more) ** 2)
        return errors, reasons

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[Residuals]:
        """Residuals of designs [lanes, n], by one batch for each experiment."""
        X = np.asarray(X, dtype=float)
        most = min(self._lanes_at_once(name, gradients) for name in self.experiments)
        if len(X) > most:
            return [x for k in range(0, len(X), most) for x in self.evaluate(X[k : k + most], gradients)]
        try:
            parts = [self._of_experiment(name, X, gradients) for name in self.experiments]
        except (InputError, SimulationFailure) as error:
            if len(X) == 1:
                return [self._failure(f"failed: {error}")]
            # The structure stage refuses some design of the batch: each design alone shows which.
            return [y for x in X for y in self.evaluate(x[None], gradients)]
        return [self._residuals(x, [part[lane] for part in parts], gradients) for lane, x in enumerate(X)]

    def _lanes_at_once(self, name: str, gradients: bool) -> int:
        tangents = len(self.space.entries) if gradients else 0
        return max(1, lanes_at_once(self.experiments[name].system, self.steps[name] or FEWEST, tangents, False))

    def _failure(self, status: str) -> Residuals:
        return Residuals(np.full(self.data + len(self.prior_rows), np.nan), None, status)

    def _of_experiment(self, name: str, X: np.ndarray, gradients: bool) -> list[Residuals]:
        """Predictions of an experiment, in SI, with derivatives with respect to all entries of the space, for each design."""
        experiment, entries = self.experiments[name], self.space.designs(X)
        own_parameters = dict(experiment.system.named_parameters())
        designs = {key: x for key, x in entries.items() if key in own_parameters}
        run = experiment.run(designs, len(X), gradients, self.steps[name])
        statuses, values, slopes, notes = [OK] * len(X), [], [], []
        for measurement in experiment.measurements:
            local = {key: entries[self._names[name][key]].reshape(len(X)) for key in measurement.unknowns}
            prediction = measurement.predict(run, local)
            statuses = [a if a != OK else b for a, b in zip(statuses, prediction.status, strict=True)]
            values.append(prediction.value.detach().numpy())
            notes += prediction.notes
            if gradients:
                slopes.append(
                    self._by_entries(name, run, prediction.by_design, prediction.by_unknown, values[-1].shape)
                )
        if "motion" in vars(run):
            self.multiples[name] = run.motion.require_repetition().multiple
            if self.steps[name] is None:
                self.steps[name] = run.motion.stats.get("steps")
        value = np.concatenate(values, 1)
        slope = np.concatenate(slopes, 1) if gradients else None
        where = f" (experiment {name!r})" if len(self.experiments) > 1 else ""
        return [
            Residuals(
                value[k], None if slope is None else slope[k], OK if status == OK else f"{status}{where}", tuple(notes)
            )
            for k, status in enumerate(statuses)
        ]

    def _by_entries(
        self, name: str, run: Run, by_design: Tensor | None, by_unknown: Mapping[str, Tensor], shape: tuple[int, ...]
    ) -> np.ndarray:
        """Derivatives [lanes, rows, entries] from those by the variables of a run and by unknowns of a measurement."""
        result = np.zeros((*shape, len(self.space.entries)))
        first = {x: k for k, x in reversed(list(enumerate(e.rpartition("[")[0] for e in self.space.entries)))}
        column = 0
        for key, x in run.designs.items():
            size = x[0].numel()
            if by_design is not None and size:
                result[:, :, first[key] : first[key] + size] = by_design[..., column : column + size].numpy()
            column += size
        for key, slope in by_unknown.items():  # a parameter of several channels has several rows
            result[:, :, first[self._names[name][key]]] += slope.detach().numpy()
        return result

    def _residuals(self, x: np.ndarray, parts: Sequence[Residuals], gradients: bool) -> Residuals:
        for part in parts:
            if not part.ok:
                return self._failure(part.status)
        value = (np.concatenate([part.values for part in parts]) - self.measured) / self.deviations
        prior = (x[self.prior_rows] - self.prior_mean) / self.prior_deviation
        notes = tuple(dict.fromkeys(note for part in parts for note in part.notes))
        values, jacobian = np.concatenate([value, prior]), None
        if gradients:
            slopes = self.space.slopes(np.concatenate([part.jacobian for part in parts if part.jacobian is not None]))
            of_priors = np.eye(len(x))[self.prior_rows] / self.prior_deviation[:, None]
            jacobian = np.concatenate([slopes / self.deviations[:, None], of_priors])
        for numbers, what in ((values, "a residual"), (jacobian, "the derivative of a residual")):
            if numbers is not None and not np.isfinite(numbers).all():
                row = int(np.flatnonzero(~np.isfinite(numbers.reshape(len(values), -1)).all(1))[0])
                return self._failure(f"failed: {what} of {self.row_name(row)} is not finite")
        return Residuals(values, jacobian, OK, notes)

    def row_name(self, row: int) -> str:
        """What a row of the residuals is of."""
        if row >= self.data:
            return f"the prior of {self.names[self.prior_rows[row - self.data]]}"
        return next(f"channel {x.name!r}" for x in self.rows if x.rows.start <= row < x.rows.stop)

    def predictions(self, values: np.ndarray) -> np.ndarray:
        """Numbers of the model [data], SI, of residuals [rows]."""
        return self.measured + self.deviations * values[: self.data]

    def held_out(self, experiments: Mapping[str, Experiment]) -> FitProblem:
        """The same unknowns for other experiments, which have none of their own."""
        result = object.__new__(type(self))
        vars(result).update(vars(self))
        known = {id(p): n for m in self._measurements() for n, p in self._named(m)}
        names = {}
        for name, x in experiments.items():
            names[name] = {}
            for measurement in x.measurements:
                for key, parameter in measurement.unknowns.items():
                    if id(parameter) not in known:
                        raise InputError(
                            ("validation", name),
                            key,
                            "a number, or an mbd.variable(...) that an experiment of the fit also has",
                            state="is an unknown of the validation alone, so that the fit cannot find it",
                            noun=f"{key!r} of the validation {name!r}",
                        )
                    names[name][key] = known[id(parameter)]
        result._names = names
        result.experiments = self._within(experiments, names)
        result.rows = _rows(result.experiments)
        result.data = result.rows[-1].rows.stop
        result.deviations = np.concatenate([_first_deviation(x.block) for x in result.rows])
        result.measured = np.concatenate([x.block.measured for x in result.rows])
        result.steps = {name: x.steps for name, x in experiments.items()}
        result.prior_rows = result.prior_rows[:0]
        result.prior_mean, result.prior_deviation = result.prior_mean[:0], result.prior_deviation[:0]
        return result

    def _measurements(self) -> list[tuple[str, Measurement]]:
        return [(name, measurement) for name, x in self.experiments.items() for measurement in x.measurements]

    def _named(self, measurement: tuple[str, Measurement]) -> list[tuple[str, Any]]:
        name, x = measurement
        return [(self._names[name][key], parameter) for key, parameter in x.unknowns.items()]


def _parameters_of_systems(experiments: Mapping[str, Experiment], unknowns: Sequence[str]) -> dict[str, Any]:
    """The unknown parameters of the systems by name; InputError for one that no system has, or that an experiment sets."""
    names = list_of("unknowns", unknowns, str, "names of parameters")
    if len(set(names)) < len(names):
        raise InputError("unknowns", names, "must name each parameter once")
    every: dict[str, Any] = {}
    for x in experiments.values():
        every = dict(x.system.named_parameters()) | every
    parameters = {}
    for name in names:
        if name not in every:
            noun, state = f"unknown {name!r}", "is not a parameter"
            raise InputError(("unknowns", name), allowed=every, hint=MAKE_PARAMETER, noun=noun, state=state)
        parameters[name] = every[name]
        for key, x in experiments.items():
            of_system = dict(x.system.named_parameters())
            if name in x.settings:
                state, noun = f"sets {name!r}, which the fit has to find", f"experiment {key!r}"
                raise InputError(("unknowns", name), allowed="must not set unknowns", noun=noun, state=state)
            if any(name in measurement.sets for measurement in x.measurements):
                state, allowed = f"is a measured load of experiment {key!r}", "a parameter that is not measured"
                raise InputError(("unknowns", name), noun=f"unknown {name!r}", allowed=allowed, state=state)
            if name in of_system and of_system[name].shape != every[name].shape:
                sizes = of_system[name].numel(), every[name].numel()
                state = f"has {sizes[0]} entries in experiment {key!r}, and {sizes[1]} in another"
                allowed = "must have the same number in all systems that have it"
                raise InputError(("unknowns", name), noun=repr(name), allowed=allowed, state=state)
    return parameters


def _own_names(name: str, experiment: Experiment, parameters: dict[str, Any], several: bool) -> dict[str, str]:
    """Unknowns of the measurements of an experiment: name in the measurement -> name of the parameter, which is added."""
    known, result = {id(x): key for key, x in parameters.items()}, {}
    for measurement in experiment.measurements:
        for local, x in measurement.unknowns.items():
            label = f"{name}.{local}" if several else local
            if id(x) not in known:
                if label in parameters:
                    state, allowed = "is a parameter of a system and an unknown of a channel", "must have other names"
                    raise InputError(("unknowns", label), noun=repr(label), allowed=allowed, state=state)
                parameters[label] = x
                known[id(x)] = label
            result[local] = known[id(x)]
    return result


def _rows(experiments: Mapping[str, Experiment]) -> list[Rows]:
    """Where the numbers of every block stand among all."""
    result, first = [], 0
    for name, experiment in experiments.items():
        for block in (block for measurement in experiment.measurements for block in measurement.blocks):
            label = f"{name}.{block.channel}" if len(experiments) > 1 else block.channel
            last = first + len(block.measured)
            result.append(Rows(label, name, replace(block), slice(first, last)))
            first = last
    return result


def _first_deviation(block: Block) -> np.ndarray:
    """The deviation of a block [rows]; where it is estimated, the spread of what was measured is the first estimate."""
    if block.deviation is not None:
        return np.asarray(block.deviation, dtype=float)
    spread, size = float(np.std(block.measured)), float(np.abs(block.measured).max())
    spread = spread if spread > LEAST_SPREAD * size else size
    return np.full(len(block.measured), spread or 1.0)
