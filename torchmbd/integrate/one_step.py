"""Integrators of one step on the index-3 equations of a flexible multibody system: generalized-alpha, HHT-alpha and their kin.

    a1    = share v1' + a_from_vd v0' + a_from_a a0                              a: of the method, v': true accelerations
    step  = h v0 + step_from_a a0 + step_from_new a1      q1 = q0 o exp(step)    rotations on the Lie group
    v1    = v0 + v_from_a a0 + v_from_new a1
    M(q1) v1' + Phi_q' lam + s(q1, v1) + K q1 = g,        Phi(q1, t1) = 0

The methods of this family differ in the `Weights` (step.py) of a step of size h, and in nothing else. Unknowns are
z = (v1', lam); constraint rows are divided by dq1/dv1', which makes the iteration matrix the saddle-point matrix of the
accelerations, well scaled for every h.

Iteration: z <- z - H R(z), a fixed number of times, and further in lanes where an estimate says so (stepper.py). H is the
inverse of the iteration matrix, renewed before the last correction of values: the correction before that leaves little, so the
last converges like Newton's, and the tangents of the *discrete* map are one more solution with nearly the exact matrix:

    R_z dz + R_x dx + R_b = 0   by   dz <- dz - H (R_z dz + R_x dx + R_b)

The error that this leaves is estimated by a second correction once in every check interval (`CHECK` steps); where it is
too large, further steps make more corrections. Steps have tangents and an exact pullback (adjoint.py), by every backend.
Bodies that joints to the ground hold simply are not unknowns (multibody/saddle/condensation.py).
Source: Arnold and Bruels, Multibody Syst. Dyn. 18 (2007) 185-202; Bruels, Cardona, Arnold, Mech. Mach. Theory 48 (2012)
121-137.
Checked in tests/contracts/test_integrators.py, tests/convergence/ (order), tests/sensitivity/ (against its own discrete map).
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from torchmbd.errors import InputError
from torchmbd.integrate.backend import backend_of
from torchmbd.integrate.estimates import StepEstimates
from torchmbd.integrate.integrator import Integrator, Steps
from torchmbd.integrate.smooth_start import SmoothStart, smooth_start
from torchmbd.integrate.step import Weights
from torchmbd.integrate.stepper import EagerStepper
from torchmbd.integrate.variable_step import step_of_size
from torchmbd.math.checked_numbers import is_whole
from torchmbd.multibody.system.dynamics import Dynamics, SaddleSolver
from torchmbd.results.state import State

_ITERATIONS, _OF_BEAMS = (3, 1), (4, 2)  # corrections of values and tangents


@dataclass(frozen=True)
class OneStep(Integrator):
    """Equal steps of a method of this family.

    iterations  corrections of values, and the least number of corrections of tangents, in every step; None: 3 and 1, or 4 and
                2 with elements of beams, whose forces turn far in a step
    refresh     steps between two inverses of the iteration matrix; 0: a new one before every correction; with elements of
                beams these begin with a uniform motion, and converge where the accelerations of before say nothing of a step.
                None: 1, or 2 with elements of beams, whose matrices are half of a step, where there are no tangents
    halvings    how many times the step of lanes that fail may be halved
    checkpoint  steps between two states that are kept: the motion has these times alone, and its memory falls so many times.
                Reverse mode makes the steps between them again
    """

    iterations: tuple[int, int] | None = None
    refresh: int | None = None
    halvings: int = 1
    checkpoint: int = 1
    work: ClassVar[tuple[str, ...]] = ("step",)
    adjoint: ClassVar[bool] = True
    condenses: ClassVar[bool] = True
    shortest_step: ClassVar[float] = 0.05  # index-3 equations do not bear much less

    def __post_init__(self) -> None:
        iterations = self.iterations if self.iterations is not None else _ITERATIONS
        counts = iterations if isinstance(iterations, (tuple, list)) else ()
        if len(counts) != 2 or not all(is_whole(k) and k >= 1 for k in counts):
            allowed = "two positive integers, for values and for tangents"
            raise InputError("iterations", self.iterations, allowed)
        if self.refresh is not None and (not is_whole(self.refresh) or self.refresh < 0):
            raise InputError("refresh", self.refresh, "a number of steps, or 0 for every correction")
        if not is_whole(self.halvings) or self.halvings < 0:
            raise InputError("halvings", self.halvings, "a whole number, 0 or more")
        if not is_whole(self.checkpoint) or self.checkpoint < 1:
            raise InputError("checkpoint", self.checkpoint, "a number of steps, 1 or more")

    def stored_intervals(self, steps: int) -> int:
        if steps % self.checkpoint:
            raise InputError("steps", steps, f"a multiple of checkpoint, {self.checkpoint}")
        return steps // self.checkpoint

    def round_up_steps(self, steps: int) -> int:
        return -(-steps // self.checkpoint) * self.checkpoint

    @abstractmethod
    def weights(self, h: Any) -> Weights:
        """Weights of a step of size h [s]: a float, or a number [1, 1] that may be a pair (variable_step.py)."""

    def stepper(self, dynamics: Dynamics, h: float) -> EagerStepper:
        refresh = self.refresh
        if refresh is None:
            refresh = 2 if dynamics.topology.has_fast_elements and not dynamics.tangents else 1
        return backend_of(dynamics).stepper(dynamics, self.weights(h), self.counts(dynamics), refresh)

    def counts(self, dynamics: Dynamics) -> tuple[int, int]:
        """Corrections of values and tangents for a system."""
        return self.iterations or (_OF_BEAMS if dynamics.topology.has_fast_elements else _ITERATIONS)

    def step_of_size(self, dynamics: Dynamics, x: State, h: Any, t1: Any, near: State | None = None) -> State:
        return step_of_size(dynamics, self.weights, x, h, t1, near)

    def smooth_start(
        self, dynamics: Dynamics, x: State, t: Any, h: Any, closed: bool = False, solver: SaddleSolver | None = None
    ) -> SmoothStart:
        if not dynamics.topology.rows:
            return SmoothStart()
        weights = self.weights(1.0)
        known = backend_of(dynamics).third_rates(dynamics, weights, x, h) if closed else None
        return smooth_start(dynamics, weights, x, t, h, closed, solver, known)

    def estimates(self, dynamics: Dynamics, duration: float, steps: int) -> StepEstimates:
        return StepEstimates(dynamics, abs(self.weights(1.0).step_from_new - 1.0 / 6.0), duration, steps)

    @property
    def refines(self) -> bool:
        return self.halvings > 0

    def retry(self) -> Steps | None:
        """First with a new matrix for every correction, and more of these; then with half the step.

        The matrix of the step before does not suit one near a singular position: there its inverse grows without bound. Nor do
        the accelerations of the nodes of beams before, where they last for much less than a step (`Step.uniform`).
        """
        if self.refresh != 0:
            values, tangents = self.iterations or _OF_BEAMS
            return Steps(replace(self, iterations=(2 * values, tangents), refresh=0), 1)
        return Steps(replace(self, halvings=self.halvings - 1), 2) if self.halvings else None
