"""Integrators of one step on the index-3 equations of a flexible multibody system: generalized-alpha, HHT-alpha and their kin.

    a1    = share v1' + a_from_vd v0' + a_from_a a0                              a: of the method, v': true accelerations
    step  = h v0 + step_from_a a0 + step_from_new a1      q1 = q0 o exp(step)    rotations on the Lie group
    v1    = v0 + v_from_a a0 + v_from_new a1
    M(q1) v1' + Phi_q' lam + s(q1, v1) + K q1 = g,        Phi(q1, t1) = 0

A method of this family is its `Weights` (step.py) for a step of size h: nothing else distinguishes it. Unknowns are
z = (v1', lam); constraint rows are divided by dq1/dv1', which makes the iteration matrix the saddle-point matrix of the
accelerations, well scaled for every h.

Iteration: z <- z - H R(z), a fixed number of times. H is the inverse of the iteration matrix, renewed before the last
correction of values: the correction before that leaves little, so the last converges like Newton's, and the tangents of
the *discrete* map are one more solution with nearly the exact matrix:

    R_z dz + R_x dx + R_b = 0   by   dz <- dz - H (R_z dz + R_x dx + R_b)

What this leaves is estimated by a second correction once in every check interval (`CHECK` steps); where it is too much,
further steps make more. Steps have tangents and an exact pullback (adjoint.py), eager and native.
Bodies that joints to the ground hold simply are no unknowns (multibody/system/condensation.py).
Source: Arnold and Bruels, Multibody Syst. Dyn. 18 (2007) 185-202; Bruels, Cardona, Arnold, Mech. Mach. Theory 48 (2012)
121-137.
Checked in tests/contracts/test_integrators.py, tests/convergence/ (order), tests/sensitivity/ (against its own discrete map).
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch

from torchmbd.errors import InputError
from torchmbd.integrate.contacts import ContactWatch
from torchmbd.integrate.estimates import StepErrors, alternations, turns
from torchmbd.integrate.integrator import Again, Integrated, Integrator
from torchmbd.integrate.native import steps
from torchmbd.integrate.phases import loop
from torchmbd.integrate.phases.run import MultiphaseRun
from torchmbd.integrate.prepared import prepare
from torchmbd.integrate.step import Weights
from torchmbd.integrate.step_count import announce
from torchmbd.integrate.stepper import TURN, EagerStepper, IterationErrors, first, resume
from torchmbd.integrate.variable_step import sized
from torchmbd.math.checked_numbers import is_whole
from torchmbd.math.pair import value
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.multibody.system.expansion import Expansion
from torchmbd.results.history import Between, Record, segments
from torchmbd.results.state import State

_ITERATIONS, _OF_BEAMS = (3, 1), (4, 2)  # corrections of values and tangents


@dataclass(frozen=True)
class OneStep(Integrator):
    """Equal steps of a method of this family.

    iterations  corrections of values, and the least number of corrections of tangents, in every step; None: 3 and 1, or 4 and
                2 with elements of beams, whose forces turn far in a step
    refresh     steps between two inverses of the iteration matrix; 0: a new one before every correction
    halvings    how many times the step of lanes that fail may be halved
    checkpoint  steps between two states that are kept: the motion has these times alone, and its memory falls so many times.
                Reverse mode makes the steps between them again
    """

    iterations: tuple[int, int] | None = None
    refresh: int = 1
    halvings: int = 1
    checkpoint: int = 1
    kind: ClassVar[str | None] = "step"
    adjoint: ClassVar[bool] = True
    shortest: ClassVar[float] = 0.05  # index-3 equations do not bear much less
    not_in_phases: ClassVar[tuple[str, ...]] = ("halvings", "checkpoint")

    def __post_init__(self) -> None:
        given = self.iterations if self.iterations is not None else _ITERATIONS
        counts = given if isinstance(given, (tuple, list)) else ()
        if len(counts) != 2 or not all(is_whole(k) and k >= 1 for k in counts):
            allowed = "two positive integers, for values and for tangents"
            raise InputError(f"iterations is {self.iterations!r}; allowed: {allowed}")
        if not is_whole(self.refresh) or self.refresh < 0:
            raise InputError(f"refresh is {self.refresh!r}; allowed: a number of steps, or 0 for every correction")
        if not is_whole(self.halvings) or self.halvings < 0:
            raise InputError(f"halvings is {self.halvings!r}; allowed: a whole number, 0 or more")
        if not is_whole(self.checkpoint) or self.checkpoint < 1:
            raise InputError(f"checkpoint is {self.checkpoint!r}; allowed: a number of steps, 1 or more")

    def kept(self, steps: int) -> int:
        """As of Integrator."""
        if steps % self.checkpoint:
            raise InputError(f"steps is {steps}; allowed: a multiple of checkpoint, {self.checkpoint}")
        return steps // self.checkpoint

    def fitting(self, steps: int) -> int:
        """As of Integrator."""
        return -(-steps // self.checkpoint) * self.checkpoint

    @abstractmethod
    def weights(self, h: Any) -> Weights:
        """Weights of a step of size h [s]: a float, or a number [1, 1] that may be a pair (variable_step.py)."""

    def stepper(self, dynamics: Dynamics, h: float) -> EagerStepper:
        """As of Integrator."""
        return steps.stepper_of(dynamics, self.weights(h), self.counts(dynamics), self.refresh)

    def counts(self, dynamics: Dynamics) -> tuple[int, int]:
        """Corrections of values and tangents for a system."""
        return self.iterations or (_ITERATIONS if dynamics.topology.beams is None else _OF_BEAMS)

    def sized(self, dynamics: Dynamics, x: State, h: Any, t1: Any) -> State:
        """As of Integrator."""
        return sized(dynamics, self.weights, x, h, t1)

    def integrate(self, dynamics: Dynamics, duration: float, steps: int) -> Integrated:
        """As of Integrator.

        Statistics: for each lane the estimated relative error of the iteration in the accelerations ("iteration_error") and
        in their design tangents ("tangent_error"), the estimated error of a step ("step_error"), the number of steps that
        would make it 1 % ("suggested_steps"), and the largest rotation of a body in one step [rad] ("turn"). With elements of
        beams also the share of accelerations that alternates from step to step in the second half ("alternation").
        """
        h, every = duration / steps, self.checkpoint
        whole, left, x = prepare(dynamics).detached()
        same = left.topology is whole.topology
        times = torch.linspace(0.0, duration, steps // every + 1, dtype=torch.float64)
        expansion = None if same else Expansion.of(left.initial.condensation, whole.data, times)
        stepper = self.stepper(left, h)
        record = Record(x, len(times))
        record.put(0, x)
        iterations = IterationErrors(value(x.q)[:, 0], duration, h)
        errors = StepErrors(left, abs(self.weights(1.0).step_from_new - 1.0 / 6.0), h)
        watch = ContactWatch(whole)
        turned, resumed, alternating = [], [], []
        announce(steps, left.lanes)
        for some in segments(steps, every):
            ends = h * torch.arange(some.start + 1, some.stop + 1, dtype=torch.float64)
            schedule = left.topology.schedule(ends, left.data)
            if every == 1:
                x = stepper.run(x, schedule, record, some.start, some.start + 1)
                part = record.history().at(slice(some.start, some.stop + 1))
            else:
                resumed.append(value(x.a))
                x, part = resume(stepper, x, schedule, some.start)
                record.put_all(some.start // every + 1, part.at(slice(every, None, every)))
            iterations.see(part, stepper.take_sizes())
            errors.see(part)
            turned.append(turns(left, part, h)[min(some.start, 1) :])
            alternating += [] if left.topology.beams is None else [alternations(left, part)]
            if not watch.idle:
                seen = h * torch.arange(some.start, some.stop + 1, dtype=torch.float64)
                own = None if same else Expansion.of(left.initial.condensation, whole.data, seen)
                own = replace(part, expansion=own)
                watch.see(seen, *(own.rows(order, pair=slice(1)) for order in range(2)))
        turn = torch.cat(turned)
        statistics: dict[str, Any] = {"steps": steps, "step_size": h, "turn": turn.amax(0)}
        statistics |= errors.statistics(steps) | iterations.statistics() | stepper.tangent_errors()
        if alternating:
            both = torch.cat(alternating, 1)
            change, size = both[:, both.shape[1] // 2 :].sum(1)  # what a jump leaves has been damped since
            statistics["alternation"] = change / size.clamp_min(torch.finfo(size.dtype).tiny)
        until = statistics["until"].minimum(first(turn > TURN).clamp_min(1))
        statistics["until"] = (until + every - 1) // every  # of the states that are kept
        between = Between(every, resumed, self) if every > 1 else None
        return Integrated(replace(record.history(expansion), between=between), statistics, doubts=watch.doubts(h))

    def integrate_phases(self, multiphase: MultiphaseRun) -> dict[str, Any]:
        """As of Integrator; statistics as of `integrate`, without errors of steps."""
        errors = loop.integrate(multiphase, self)
        h = multiphase.duration / multiphase.steps
        turn = turns(multiphase.whole, multiphase.recorded(), h)
        errors["until"] = errors.get("until", first(turn < 0.0)).minimum(first(turn > TURN).clamp_min(1))
        return {"steps": multiphase.steps, "step_size": h, "turn": turn.amax(0)} | errors

    def again(self) -> Again | None:
        """First with a new matrix for every correction, and more of these; then with half the step.

        The matrix of the step before does not suit one near a singular position: there its inverse grows without bound.
        """
        if self.refresh:
            values, tangents = self.iterations or _OF_BEAMS
            return Again(replace(self, iterations=(2 * values, tangents), refresh=0), 1)
        return Again(replace(self, halvings=self.halvings - 1), 2) if self.halvings else None
