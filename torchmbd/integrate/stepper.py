"""The eager stepper of an integrator: steps one after another, factors of the iteration matrix, and what iterations leave.

`EagerStepper` is the eager one: operators of torch on all lanes. steps.py has the same by compiled code.
Checked in tests/integrate/.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmbd.integrate.pullback import PulledBack, StepPullback
from torchmbd.math.pair import Pair, value
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.multibody.system.elimination import Eliminated, Elimination, Factored, factored, pays
from torchmbd.multibody.system.saddle_factors import regularized
from torchmbd.multibody.system.topology import Prescribed
from torchmbd.progress import reach
from torchmbd.results.history import History, Record
from torchmbd.results.state import State

CHECK = 25  # steps between two looks at what the correction of tangents leaves
TANGENT_ERROR = (
    2e-5  # relative; more than this gets another correction. Gradients have 20 times that at most, as measured
)
MOST = 4  # corrections of tangents
_NOTHING = 1e-9  # of the accelerations that tangents of multipliers could cause: no tangents at all
_EVEN = 1e-9  # of a correction: rounding
# A motion is accepted when the iteration of every step left less than this share of the largest acceleration.
ITERATION_ERROR = 1e-2
TURN = 1.0  # [rad] of a body in one step
_ROUNDING = 1e-10  # of coordinates, with room for what equations and factors make of it


class Kind(NamedTuple):
    """What steps differ by, other than in their numbers.

    begins, renew, looks   whether there are no factors yet, new ones are made, tangents are looked at
    most                   corrections of tangents that a lane gets at most
    """

    begins: bool
    renew: bool
    looks: bool
    most: int


class Made(NamedTuple):
    """What a step leaves: state, factors, sizes of the last two corrections of values [2, lanes], and arguments of `look`."""

    state: State
    H: Any
    sizes: Tensor
    seen: tuple[Tensor, ...]


def nothing(dynamics: Dynamics) -> Tensor:
    """What a multiplier of one could accelerate, and be no more than rounding [lanes] or [1]."""
    return _NOTHING / value(dynamics.data["mass"]).amax((0, 1))


def between_looks(count: int, first: int, tangents: int) -> Iterator[slice]:
    """Steps, the first of number `first`, in runs without a look in between: how long compiled code goes on by itself.

    A look may call for more corrections from the next step on, so with tangents its step is a run of its own.
    """
    done = 0
    while done < count:
        since = (first + done) % CHECK
        end = done + (1 if tangents and not since else min(CHECK - since, count - done))
        yield slice(done, end)
        done = end


def first(bad: Tensor) -> Tensor:
    """The first time at which something is bad [times, lanes]; their number where it never is [lanes]."""
    return torch.where(bad.any(0), bad.int().argmax(0), len(bad))


class EagerStepper:
    """Steps of one simulation; keeps the factors and what the iterations leave."""

    def __init__(self, dynamics: Dynamics, model: Any, iterations: tuple[int, int], refresh: int):
        self.dynamics, self.model, self.refresh = dynamics, model, refresh
        self.corrections, self.least = iterations
        passes = self.least
        if any(p.varies for p in dynamics.topology.primitives):
            passes = max(passes, 2)  # the start of a drive kicks the tangents between two looks
        # Corrections of tangents: what a lane gets depends on no other.
        mass = value(dynamics.data["mass"])
        self.passes, self.most = mass.new_full((dynamics.lanes,), float(passes)), passes
        self.nothing = nothing(dynamics)
        self.diagonal = dynamics.diagonal(everywhere=refresh == 0)
        self.factor = Elimination(dynamics.topology) if pays(dynamics.topology) else factored
        self.failed: dict[int, str] = {}  # none: a lane that fails is nan
        self.H: Any = None
        self.sizes: list[Tensor] = []  # of the last two corrections of values [2, lanes], for each step
        self.tangent_error: list[Tensor] = []  # relative [lanes], at each look
        self.largest: Tensor | None = None  # tangents of accelerations so far [n_b, lanes]
        self.counts = mass.new_ones(dynamics.lanes, dtype=torch.bool)  # lanes whose motion is one

    def step(self, i: int, x: State, given: Prescribed, lanes: Tensor) -> State:
        """As of Stepper."""
        self.counts = lanes
        x = self(i, x, given)
        self.sizes[-1] = torch.where(lanes, self.sizes[-1], 0.0)
        return x

    def __call__(self, i: int, x: State, given: Any) -> State:
        """The state after step i."""
        return self._step(i, x, given)

    def run(self, x: State, schedule: Sequence[Prescribed], record: Record, first: int = 0, place: int = 1) -> State:
        """The last state of many steps, the first of number `first`; all go into the record, from `place` on."""
        for i, given in enumerate(schedule):
            x = self._step(first + i, x, given)
            record.put(place + i, x)
        return x

    def pullback(self, before: State, after: State, given: Prescribed, y: State) -> PulledBack:
        """As of Stepper; the data of the model are leaves of a graph."""
        step = StepPullback(self.model, before, after, given, self.least, self.nothing)
        return step(y, lambda K: self.factor(regularized(K.mT, self.diagonal)))

    def forget(self) -> None:
        """The state has jumped: the factors kept do not suit it."""
        self.H = None

    def _step(self, i: int, x: State, given: Any) -> State:
        reach(value(given.t))
        renew, looks = self.refresh == 0 or i % self.refresh == 0, isinstance(x.q, Pair) and i % CHECK == 0
        made = self.made(Kind(self.H is None, renew, looks, self.most), x, given)
        self.H = made.H
        self.sizes.append(made.sizes)
        if looks:
            self.look(*made.seen)
        return made.state

    def made(self, kind: Kind, x: State, given: Any) -> Made:
        """A step from x, with the factors and the numbers of corrections that are kept; changes none of these."""
        step = self.model.step(x, given)
        z, H, sizes = self._values(step, torch.cat([value(x.vd), value(x.lam)]), kind.renew)
        if not isinstance(x.q, Pair):
            return Made(step.finish(z), H, sizes, ())
        dz, seen = torch.cat([x.vd.tangent, x.lam.tangent]), ()
        for k in range(kind.most):
            better, _ = step.tangent(H, z, dz)
            dz = torch.where(self.passes > k, better, dz)
        if kind.looks:
            dz, *seen = self._looked(step, H, z, dz)
        for _ in range(MOST if kind.begins else 0):  # accelerations of the start are not those of a step
            dz, _ = step.tangent(H, z, dz)
        return Made(step.finish(z, dz), H, sizes, tuple(seen))

    def _factors(self, step: Any, z: Tensor) -> Factored | Eliminated:
        return self.factor(regularized(step.matrix(z), self.diagonal))

    def _values(self, step: Any, z: Tensor, renew: bool) -> tuple[Tensor, Any, Tensor]:
        """Unknowns of one step, the factors then, and the sizes of the last two corrections [2, lanes]."""
        H = self._factors(step, z) if self.H is None else self.H
        corrections = []
        for k in range(self.corrections):
            if self.refresh == 0 or (renew and k == max(self.corrections - 1, 1)):
                H = self._factors(step, z)
            z, correction = step.correct(H, z)
            corrections.append(correction)
        H = self._factors(step, z) if renew and self.corrections == 1 else H
        last = corrections[max(self.corrections - 2, 0)], corrections[-1]
        return z, H, torch.stack([step.size(x)[0] for x in last])

    def _looked(self, step: Any, H: Any, z: Tensor, dz: Tensor) -> tuple[Tensor, ...]:
        """Tangents corrected once more, and the arguments of `look`: where that was needed, later steps do it as well."""
        dz, correction = step.tangent(H, z, dz)
        size = step.size(correction)
        n_v = self.dynamics.topology.n_v
        forces = dz[n_v:].abs().amax(0) if len(dz) > n_v else torch.zeros_like(size)
        return dz, size, dz[:n_v].abs().amax(0), forces

    def look(self, size: Tensor, largest: Tensor, forces: Tensor) -> None:
        """Take note of what one more correction of the tangents changed, and of the largest of these [n_b, lanes].

        What counts is the worst variable, relative to the largest that its tangents have been; or, where they are
        nothing but rounding (a load that a joint carries away), to what that of the multipliers' tangents makes of them.
        """
        largest = torch.where(self.counts, largest.maximum(self.nothing * forces), 0.0)
        self.largest = largest if self.largest is None else largest.maximum(self.largest)
        error = (size / self.largest.clamp_min(torch.finfo(size.dtype).tiny)).amax(0)
        error = torch.where(self.counts, error, 0.0)
        self.tangent_error.append(error)
        # Each correction leaves the same share of what the one before left. A lane that has failed, nan, gets no more.
        share = error.nan_to_num(0.0, 0.5).clamp(TANGENT_ERROR, 0.5).log() / math.log(TANGENT_ERROR)
        self.passes = self.passes.maximum((self.passes / share - _EVEN).ceil().clamp_max(MOST))
        self.most = int(self.passes.max())

    def take_sizes(self) -> Tensor:
        """What the corrections of the last steps left, estimated [lanes, steps]; they are forgotten."""
        before, last = torch.stack(self.sizes, -1)
        self.sizes = []
        return last if self.corrections == 1 else last * last / before.clamp_min(torch.finfo(last.dtype).tiny)

    def errors(self, history: History, duration: float, numbers: list[int] | None = None) -> dict[str, Tensor]:
        """Estimated relative errors of the iteration [lanes], and the first time of which it did not converge ("until").

        numbers: times to which the steps led; None: 1, 2, 3, ...
        """
        found = IterationErrors(history.q[0, :, 0], duration, duration / (len(history.q) - 1))
        found.see(history, self.take_sizes(), numbers)
        return found.statistics() | self.tangent_errors()

    def tangent_errors(self) -> dict[str, Tensor]:
        """Estimated relative error of tangents [lanes], if there were any."""
        return {"tangent_error": torch.stack(self.tangent_error).amax(0)} if self.tangent_error else {}


def resume(stepper: EagerStepper, x: State, schedule: Sequence[Prescribed], number: int) -> tuple[State, History]:
    """The last state of steps from x, the first of that number, and all states.

    The stepper forgets its factors: so the steps can be made again as they were.
    """
    record = Record(x, len(schedule) + 1)
    record.put(0, x)
    stepper.forget()
    return stepper.run(x, schedule, record, number), record.history()


class IterationErrors:
    """What the iterations of steps of size h [s] left, and the first time of which they did not converge.

    The next correction of values would be |last|^2 / |one before|, relative to the largest acceleration of the motion, or to
    the largest rate over the duration: a uniform motion has accelerations of rounding size. Or to what the rounding of
    coordinates q [n, lanes] at the start makes of them: a system at rest has nothing else.
    """

    def __init__(self, q: Tensor, duration: float, h: float):
        self.duration, self.rounding = duration, _ROUNDING * q.abs().amax(0) / (h * h)
        self.scale, self.left = self.rounding, torch.zeros_like(self.rounding)  # the largest so far
        self.until, self.seen = torch.zeros_like(self.rounding, dtype=torch.long), 0

    def see(self, history: History, left: Tensor, numbers: list[int] | None = None) -> None:
        """Go on with states at further times, the first of which was the last before, and what steps left [lanes, steps].

        numbers: places in the history to which the steps led; None: 1, 2, 3, ...
        """
        largest = (x[:, :, 0].abs().amax(1) for x in (history.vd, history.v))
        reached, speed = (x.cummax(0).values for x in largest)
        # Up to every time: what comes after a failure is no measure of it.
        scale = self.scale.maximum(reached.maximum(speed / self.duration))
        bad = torch.zeros_like(scale, dtype=torch.bool)
        steps = torch.arange(1, left.shape[-1] + 1) if numbers is None else torch.tensor(numbers)
        bad[steps] = ~(ITERATION_ERROR * scale[steps] >= left.T)
        never, shared = self.until == self.seen, min(self.seen, 1)  # not so far; times that were seen before
        self.until = torch.where(never, self.seen - shared + first(bad), self.until)
        self.seen += len(history.q) - shared
        self.scale, self.left = scale[-1], self.left.maximum(left.amax(-1))

    def statistics(self) -> dict[str, Tensor]:
        """ "iteration_error" and "until" [lanes]."""
        return {"iteration_error": self.left / self.scale, "until": self.until}
