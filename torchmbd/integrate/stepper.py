"""The eager stepper of one-step methods: steps one after another by operators of torch on all lanes.

It keeps the factors of the iteration matrix from step to step, and estimates of what the iterations leave.
Other backends (backend.py) make the same steps.
Checked in tests/integrate/.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from torchmbd.integrate.integrator import Stepper
from torchmbd.integrate.pullback import NEGLIGIBLE, PulledBack, StepPullback
from torchmbd.integrate.statistics import ROUNDING, Statistics
from torchmbd.integrate.step import algorithmic
from torchmbd.math.pair import Pair, value
from torchmbd.multibody.equations.topology import Prescribed, Schedule
from torchmbd.multibody.saddle.elimination import Elimination, factored, pays
from torchmbd.multibody.saddle.factors import regularized
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.progress import reach
from torchmbd.results.history import History, Record
from torchmbd.results.state import State

CHECK = 25  # steps between two estimates of what the correction of tangents leaves: the check interval
# Relative; more than this gets another correction. Gradients have 20 times that at most, as measured.
TANGENT_ERROR = 2e-5
MOST = 4  # corrections of tangents
# Corrections of values that a step makes on top, each with a new matrix, in lanes whose estimated error is above a share of the
# largest acceleration so far: gradients are those of equations that are solved. A step that needs one is a hard one, where
# gradients may be off by 1e5 times what is left: it goes on to a smaller share, while corrections fall by half at least.
MORE, PRECISE, SOLVED = 6, 1e-6, 1e-10
_EVEN = 1e-9  # of a correction: rounding


class EagerStepper(Stepper):
    """Steps of one simulation; keeps the factors and what the iterations leave."""

    def __init__(self, dynamics: Dynamics, model: Any, iterations: tuple[int, int], refresh: int):
        super().__init__(dynamics)
        self.model, self.refresh = model, refresh
        self.corrections, self.least = iterations
        passes = self.least
        if any(p.varies for p in dynamics.topology.primitives):
            passes = max(passes, 2)  # the start of a drive kicks the tangents between two checks
        # Corrections of tangents: those of a lane depend on no other lane.
        mass = value(dynamics.data["mass"])
        self.passes, self.most = mass.new_full((dynamics.lanes,), float(passes)), passes
        self.diagonal = dynamics.diagonal(everywhere=refresh == 0)
        # A node of a beam that is let go accelerates for much less than a step; other accelerations are good estimates.
        self.begins_uniformly = refresh == 0 and dynamics.topology.has_fast_elements
        self.factor = Elimination(dynamics.topology) if pays(dynamics.topology) else factored
        self.H: Any = None
        self.K = mass.new_zeros(0)  # the matrices of which H are factors
        self.scale: Tensor | None = None  # largest accelerations so far [lanes]
        self.sizes: list[Tensor] = []  # of the last two corrections of values, and further ones [steps, 3, lanes]
        self.further = mass.new_zeros(dynamics.lanes)  # corrections of values in one step
        self.tangent_error: list[Tensor] = []  # relative [lanes], at each check
        self.largest: Tensor | None = None  # tangents of accelerations so far [n_b, lanes]

    def run(self, x: State, schedule: Schedule, record: Record, first: int = 0, start: int = 1) -> State:
        for i, prescribed in enumerate(schedule):
            x = self._step(first + i, x, prescribed)
            record.put(start + i, x)
            if not self._goes_on(x):
                self._end(x, record, range(start + i + 1, start + len(schedule)))
                break
        return x

    def _goes_on(self, x: State) -> bool:
        """True if a lane that counts has finite rates: others are nan for good."""
        return bool((self.counts & torch.isfinite(value(x.v)[:, 0].sum(0))).any())

    def _end(self, x: State, record: Record, numbers: range) -> None:
        """Note states and corrections of further steps that are not made, because no lane has finite numbers."""
        for k in numbers:
            record.put(k, x)
        self.sizes.append(torch.full((len(numbers), 3, self.dynamics.lanes), torch.nan, dtype=torch.float64))

    def pullback(self, before: State, after: State, prescribed: Prescribed, y: State) -> PulledBack:
        """Cotangents of all that a step depends on, from those y of the state after it; leaves are the model's data."""
        step = StepPullback(self.model, before, after, prescribed, self.least)
        return step(y, lambda K: self.factor(regularized(K.mT, self.diagonal)))

    def restart(self, lanes: Tensor | None = None) -> None:
        self.H = None
        self.scale = None if lanes is None or self.scale is None else torch.where(lanes, torch.nan, self.scale)

    def _step(self, i: int, x: State, prescribed: Prescribed) -> State:
        """The state after step i."""
        reach(value(prescribed.t))
        first, step = self.H is None, self.model.step(x, prescribed)
        self._begin(x)
        start = step.uniform() if self.begins_uniformly else torch.cat([value(x.vd), value(x.lam)])
        z = self._values(step, start, self.refresh == 0 or i % self.refresh == 0)
        if not isinstance(x.q, Pair):
            return step.finish(z)
        dz = torch.cat([x.vd.tangent, x.lam.tangent])
        return step.finish(z, self._tangents(step, z, dz, first, i % CHECK == 0))

    def _values(self, step: Any, z: Tensor, renews: bool) -> Tensor:
        """Unknowns of a step from those of the step before; renews: the factors, before the last correction."""
        if self.H is None:
            self._factorize(step, z)
        corrections = []
        for k in range(self.corrections):
            if self.refresh == 0 or (renews and k == max(self.corrections - 1, 1)):
                self._factorize(step, z)
            z, correction = step.correct(self.H, z)
            corrections.append(correction)
        before, last = (step.size(x)[0] for x in (corrections[max(self.corrections - 2, 0)], corrections[-1]))
        assert self.scale is not None
        reached = step.size(z)[0]
        self.scale = torch.where(reached > self.scale, reached, self.scale)
        further = torch.zeros_like(last)
        for _ in range(MORE):
            error, goal = last * last, self.scale * before
            falls = (further > 0.0) & (last < 0.5 * before)
            open_lanes = self.counts & ((error > PRECISE * goal) | (falls & (error > SOLVED * goal)))
            if not bool(open_lanes.any()):
                break
            self._factorize(step, z, open_lanes)
            better, correction = step.correct(self.H, z)
            z, size = torch.where(open_lanes, better, z), step.size(correction)[0]
            further = further + open_lanes.double()
            before, last = torch.where(open_lanes, last, before), torch.where(open_lanes, size, last)
        if renews and self.corrections == 1:
            self._factorize(step, z)
        self.sizes.append(torch.stack([before, last, further])[None])
        return z

    def _begin(self, x: State) -> None:
        """Accelerations of the first state are those of before; and what the rounding of coordinates makes of them."""
        if self.scale is None or bool(self.scale.isnan().any()):
            sizes = self.dynamics.sizes
            largest, far = ((value(y)[:, 0].abs() / s).amax(0) for y, s in ((x.vd, sizes.v), (x.q, sizes.q)))
            rounding = ROUNDING * far * self.model.plain.inverse_scale
            start = largest.nan_to_num(0.0, 0.0).maximum(rounding.nan_to_num(0.0, 0.0))
            start = start.expand(self.dynamics.lanes).contiguous()
            self.scale = start if self.scale is None else torch.where(self.scale.isnan(), start, self.scale)

    def _factorize(self, step: Any, z: Tensor, lanes: Tensor | None = None) -> None:
        """New matrices at z, of all lanes or of some."""
        K = regularized(step.matrix(z), self.diagonal)
        self.K = K if lanes is None else torch.where(lanes[:, None, None], K, self.K)
        self.H = self.factor(self.K)

    def _tangents(self, step: Any, z: Tensor, dz: Tensor, first: bool, checks: bool) -> Tensor:
        """Tangents [n, n_b, lanes] of the unknowns from those of the step before.

        first    there were no factors before;  checks: the error of the tangents is estimated
        """
        for k in range(self.most):
            better, _ = step.tangent(self.H, z, dz)
            dz = torch.where(self.passes > k, better, dz)
        if checks:  # by one more correction: where that was needed, later steps make it as well
            dz, correction = step.tangent(self.H, z, dz)
            self.check(step.size(correction), step.size(dz), step.size_of_multipliers(dz))
        for _ in range(MOST if first else 0):  # accelerations of the start are not those of a step
            dz, _ = step.tangent(self.H, z, dz)
        return dz

    def check(self, size: Tensor, largest: Tensor, forces: Tensor) -> None:
        """Estimate the error of tangents, and set how many corrections later steps make.

        size      of one more correction [n_b, lanes];  largest: tangents of accelerations;  forces: and of multipliers;
                  each by its size

        The error is that of the worst variable, relative to the largest that its tangents have been; or, where they are
        nothing but rounding (a load that a joint carries away), to what that of the multipliers' tangents makes of them.
        """
        largest = torch.where(self.counts, largest.maximum(NEGLIGIBLE * forces), 0.0)
        self.largest = largest if self.largest is None else largest.maximum(self.largest)
        error = (size / self.largest.clamp_min(torch.finfo(size.dtype).tiny)).amax(0)
        error = torch.where(self.counts, error, 0.0)
        self.tangent_error.append(error)
        # Each correction leaves the same share of what the one before left. A lane that has failed, nan, gets no more.
        share = error.nan_to_num(0.0, 0.5).clamp(TANGENT_ERROR, 0.5).log() / math.log(TANGENT_ERROR)
        self.passes = self.passes.maximum((self.passes / share - _EVEN).ceil().clamp_max(MOST))
        self.most = int(self.passes.max())

    def algorithmic(self, a: Any, vd: Tensor) -> Any:
        return algorithmic(self.model.w, a, vd)

    def take_errors(self, counted: Tensor | None = None) -> Tensor:
        counted = self.counts if counted is None else counted
        before, last, further = torch.cat(self.sizes).unbind(1)
        self.sizes = []
        self.further = self.further.maximum(torch.where(counted, further, 0.0).amax(0))
        errors = last * last / before.clamp_min(torch.finfo(last.dtype).tiny)
        return torch.where(counted, errors, 0.0).T

    def statistics(self) -> Statistics:
        error = torch.stack(self.tangent_error).amax(0) if self.tangent_error else None
        return Statistics(tangent_error=error, further_corrections=self.further)


def resume(
    stepper: Stepper, x: State, schedule: Schedule, number: int, restarts: Iterable[int] = ()
) -> tuple[State, History]:
    """The last state of steps from x, the first of that number, and all states.

    The stepper starts without factors: so the steps can be made again as they were.
    restarts   numbers of further steps before which it discards them
    """
    record = Record(x, len(schedule) + 1)
    record.put(0, x)
    stepper.restart()
    bounds = [number, *(k for k in sorted(restarts) if number < k < number + len(schedule)), number + len(schedule)]
    for first, last in itertools.pairwise(bounds):
        if first > number:
            stepper.restart(torch.zeros_like(stepper.counts))
        x = stepper.run(x, schedule[first - number : last - number], record, first, first - number + 1)
    return x, record.history()
