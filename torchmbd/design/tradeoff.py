"""Several criteria of one motion, for a Pareto front.

    minimize f_1(b) .. f_k(b)   subject to   g_i(b) <= c_i,   lower <= b <= upper

    tradeoff = mbd.Tradeoff(
        system, 0.06, {"energy": mbd.Integral(U), "torsion": mbd.Integral(twist**2)}, bounds=mbd.deg([-90, 90])
    )
    front = mbd.optimization.pareto_front(tradeoff)

A batch of designs is one simulation for all criteria. Checked in tests/design/test_tradeoff.py.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from torchmbd.design.problem import Problem
from torchmbd.design.problem_parts import constraints_of
from torchmbd.design.response import Constraint, Measure, require_scalar_measures
from torchmbd.design.words import unit
from torchmbd.errors import InputError
from torchmbd.fixed_arguments import FixedArguments
from torchmbd.integrate import Trajectory
from torchmbd.multibody.system import System
from torchmbd.optimization import Criteria


class Tradeoff(FixedArguments):
    """A transient problem of several criteria, for `pareto_front`.

    system, duration  as in Problem [s]
    minimize          name -> measure of one number, at least two
    subject_to        inequalities, as in Problem
    options           bounds, variables, start, links, method, steps, phases and options of the method, as in Problem

    >>> energy, mass = mbd.Integral(mbd.StrainEnergy("arm")), mbd.Mass("arm")
    >>> tradeoff = mbd.Tradeoff(
    ...     mbd.examples.arm(),
    ...     0.05,
    ...     {"energy": energy, "mass": mass},
    ...     variables=["arm.laminate.thickness"],
    ...     bounds=(0.5e-3, 2e-3),
    ...     steps=20,
    ... )
    >>> [found] = tradeoff.evaluate(tradeoff.start[None], True)
    >>> found.values.shape, found.gradients.shape  # two criteria, two thicknesses
    ((2,), (2, 2))
    """

    def __init__(
        self,
        system: System,
        duration: float,
        minimize: Mapping[str, Measure],
        subject_to: Constraint | Sequence[Constraint] = (),
        **options: Any,
    ):
        if not isinstance(minimize, Mapping):
            raise InputError("minimize", minimize, "a mapping name -> measure, such as {'energy': Integral(...)}")
        self.criteria = list(minimize)
        if len(self.criteria) < 2:
            raise InputError(
                "minimize",
                minimize,
                "must have at least two criteria",
                state=f"has {self.criteria}",
                hint="Problem, for one criterion",
            )
        for name, measure in minimize.items():
            if getattr(measure, "rows", 1) > 1:
                state, noun = f"has {measure.rows} rows", f"criterion {name!r}"
                raise InputError(("minimize", name), measure, "a response of one number", noun=noun, state=state)
        require_scalar_measures(minimize.values(), "tradeoff")
        first, *others = minimize.values()
        # All criteria but the first are constraints of the problem, with limit 0 and scale 1: their rows are the criteria.
        rows = [Constraint(measure, 0.0, scale=1.0) for measure in others]
        self.problem = Problem(system, duration, first, [*rows, *constraints_of(subject_to)], **options)
        if self.problem.equalities.size:
            raise InputError("subject_to", subject_to, "must have inequalities alone", state="has equalities")
        self.names, self.start, self.period = self.problem.names, self.problem.start, self.problem.period
        self.lower, self.upper = self.problem.lower, self.problem.upper

    @property
    def units(self) -> list[str | None]:
        """The unit of each criterion, None where it is not known."""
        measures = [
            self.problem.objective,
            *(row.measure for row in self.problem.constraints[: len(self.criteria) - 1]),
        ]
        return [unit(measure) for measure in measures]

    def over(self, problem: Any) -> Tradeoff:
        """The same criteria with the evaluations of another problem, such as one that keeps them."""
        other = copy.copy(self)
        vars(other)["problem"] = problem
        return other

    def motion(self, x: np.ndarray) -> Trajectory:
        """Motion of one design [n]."""
        return self.problem.motion(x)

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[Criteria]:
        """Evaluate designs [lanes, n] as one batch."""
        others = len(self.criteria) - 1
        result = []
        for e in self.problem.evaluate(X, gradients):
            values = np.append(e.objective, e.constraints[:others])
            if e.objective_gradient is None or e.constraint_gradients is None:
                result.append(Criteria(values, e.constraints[others:], status=e.status))
                continue
            slopes = np.vstack([e.objective_gradient, e.constraint_gradients[:others]])
            result.append(Criteria(values, e.constraints[others:], slopes, e.constraint_gradients[others:]))
        return result
