"""An optimization problem: which measure of a motion to minimize over which design variables, subject to what.

    minimize f(b)   subject to   g_i(b) <= c_i,   lower <= b <= upper          eq. (14)

Arrays in, arrays out: optimizers know nothing of mechanics (torchmbd/optimizers/optimizer.py tells what they ask for).
A batch of designs is one simulation. Constraints are passed on as (g - c)/|c|, feasible where not positive.
A design that cannot be simulated is a failed evaluation with its reason; the others of the batch are not touched.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from torchmbd.design.response import Constraint, Measure
from torchmbd.design.space import DesignSpace
from torchmbd.errors import InputError, SimulationFailure
from torchmbd.integrators import Trajectory, simulate
from torchmbd.integrators.simulate import check
from torchmbd.integrators.trajectory import OK
from torchmbd.optimizers import Evaluation
from torchmbd.system import System


class Problem:
    """A transient optimization problem.

    system      the model; its parameters are the candidates for design variables
    duration    simulated time [s]
    minimize    a measure, such as Integral(StrainEnergy("rod"))
    subject_to  constraints, such as Max(StrainEnergy("rod")) <= "initial"
    bounds      (lower, upper) of the design variables, numbers for all or one for each [rad for angles]
    variables   names of parameters; default: every parameter that requires a gradient
    start       initial design [n]; default: the system's own
    method, steps, options   as in `simulate`
    """

    def __init__(
        self,
        system: System,
        duration: float,
        minimize: Measure,
        subject_to: Sequence[Constraint] = (),
        bounds: Any = (-np.inf, np.inf),
        variables: Sequence[str] | None = None,
        start: Any = None,
        method: str = "generalized_alpha",
        steps: int | None = None,
        **options: Any,
    ):
        if not isinstance(minimize, Measure):
            raise InputError(f"minimize is {minimize!r}; allowed: a measure, such as Integral(StrainEnergy('rod'))")
        for constraint in subject_to:
            if not isinstance(constraint, Constraint):
                raise InputError(f"subject_to has {constraint!r}; allowed: constraints, such as Max(...) <= 'initial'")
        check(duration, method, steps, options)
        for measure in (minimize, *(constraint.measure for constraint in subject_to)):
            measure.check(system)
        self.system, self.duration, self.objective = system, duration, minimize
        self.constraints = list(subject_to)
        self.space = DesignSpace(system, variables, bounds, start)
        self.simulation = {"method": method, "steps": steps, **options}

    @property
    def names(self) -> list[str]:
        """One label for each design variable."""
        return self.space.names

    @property
    def start(self) -> np.ndarray:
        return self.space.start

    @property
    def lower(self) -> np.ndarray:
        return self.space.lower

    @property
    def upper(self) -> np.ndarray:
        return self.space.upper

    def simulate(self, X: np.ndarray, gradients: bool = False) -> Trajectory:
        """Motions of designs [lanes, n], with sensitivities by all variables if `gradients`."""
        names = self.space.variables if gradients else False
        return simulate(
            self.system, self.duration, sensitivities=names, designs=self.space.designs(X), **self.simulation
        )

    def motion(self, x: np.ndarray) -> Trajectory:
        """Motion of one design [n]."""
        return self.simulate(np.asarray(x)[None])

    @cached_property
    def limits(self) -> np.ndarray:
        """Limits c of the constraints; "initial" ones from a simulation of the initial design.

        Raises SimulationFailure if the initial design is needed for a limit and cannot be simulated.
        """
        if not any(c.limit == "initial" for c in self.constraints):
            return np.array([float(c.limit) for c in self.constraints])
        motion = self.motion(self.start).require_ok()
        return np.array(
            [float(c.measure.value(motion)[0]) if c.limit == "initial" else float(c.limit) for c in self.constraints]
        )

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[Evaluation]:
        """Evaluate designs [lanes, n] as one batch."""
        try:
            motion = self.simulate(X, gradients)
        except (InputError, SimulationFailure) as error:
            # The structure stage refused a design (a cluster of modes cut at the truncation, say): find out which.
            if len(X) == 1:
                return [Evaluation.failure(f"failed: {error}", len(self.constraints))]
            return [evaluation for x in X for evaluation in self.evaluate(x[None], gradients)]
        values, slopes = self._measure(motion)
        result = []
        for lane, status in enumerate(motion.status):
            numbers = values[:, lane]
            if status == OK and not np.isfinite(numbers).all():
                status = "failed: a response is not finite"
            if status != OK:
                result.append(Evaluation.failure(status, len(self.constraints)))
                continue
            slope = None if slopes is None else slopes[:, lane]
            result.append(
                Evaluation(
                    float(numbers[0]),
                    numbers[1:],
                    None if slope is None else slope[0],
                    None if slope is None else slope[1:],
                )
            )
        return result

    def _measure(self, motion: Trajectory) -> tuple[np.ndarray, np.ndarray | None]:
        """Objective and normalized constraints [1 + m, lanes] with gradients [1 + m, lanes, n]."""
        found = [measure.of(motion) for measure in (self.objective, *(c.measure for c in self.constraints))]
        limits = np.concatenate([[0.0], self.limits])
        scale = np.concatenate([[1.0], np.where(self.limits == 0.0, 1.0, np.abs(self.limits))])
        values = (np.stack([x.value.numpy() for x in found]) - limits[:, None]) / scale[:, None]
        if found[0].gradient is None:
            return values, None
        slopes = np.stack([x.gradient.numpy() for x in found if x.gradient is not None])
        return values, slopes / scale[:, None, None]
