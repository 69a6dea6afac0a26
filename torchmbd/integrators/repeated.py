"""Steps of one simulation as recorded operations (numerics/recorded.py): the same text, the same numbers, less time.

Of the eager march, whose steps are all alike: the first is done as it is written, the operations of the second are noted,
those after it repeat them.
Checked in tests/integrators/test_repeated.py.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torchmbd.forces.written import known
from torchmbd.integrators.step import Model, State, Step, Weights
from torchmbd.numerics.pair import Pair
from torchmbd.numerics.recorded import Recorded, Unrepeatable
from torchmbd.system.dynamics import Dynamics
from torchmbd.system.topology import Prescribed


def model(dynamics: Dynamics, w: Weights) -> Model:
    """What makes the steps of a march; as they are written where a law of a force is the user's own, which may branch."""
    laws = [law for action in dynamics.topology.actions for law in action.laws]
    kind = RepeatedModel if all(known(law) for law in laws) else Model
    return kind(dynamics.topology, dynamics.saddle, w, dynamics.data)


class RepeatedModel(Model):
    """Makes the steps of one march."""

    _seen: list[torch.Size] | None = None
    _step: RepeatedStep | None = None

    def step(self, x: State, given: Prescribed) -> Step:
        """The step from x; the one before is over."""
        shapes = [y.shape for y in numbers(x, given)]
        if shapes != self._seen:
            self._seen, self._step = shapes, None
            return super().step(x, given)
        if self._step is None:
            self._step = RepeatedStep(self, x, given)
        self._step.move(x, given)
        return self._step


class RepeatedStep(Step):
    """A step whose state and known motions keep their place and get other numbers."""

    def __init__(self, model: Model, x: State, given: Prescribed):
        self.model = model
        self.x = x.map(own)
        self.given = own_given(given)
        self.numbers = numbers(self.x, self.given)
        self._recorded: dict[str, tuple[Tensor, Callable[[], list[Tensor]]]] = {}
        self._at: Tensor | None = None  # unknowns at which `_residual` is

    def move(self, x: State, given: Prescribed) -> None:
        """To another state."""
        self._at = None
        for mine, new in zip(self.numbers, numbers(x, given), strict=True):
            mine.copy_(new)

    def residual(self, z: Any) -> Any:
        """As of a step."""
        if isinstance(z, Pair):
            return Pair(self._repeat("tangent", z.full, lambda step, full: [step.residual(Pair(full)).full])[0])
        if z is self._at:
            return self._residual
        return self._repeat("residual", z, lambda step, z: [step.residual(z)])[0]

    def matrix(self, z: Tensor) -> Tensor:
        """As of a step; the residual, which is often asked for next, has half of the work in common."""
        K, self._residual = self._repeat("matrix", z, lambda step, z: [step.matrix(z), step.residual(z)])
        self._at = z
        return K

    def finish(self, z: Tensor, dz: Tensor | None = None) -> State:
        """As of a step; the state is the caller's own."""
        if dz is None:
            return State(*(y.clone() for y in self._repeat("finish", z, lambda step, z: list(step.finish(z)))))
        both = torch.cat([z, dz], 1)

        def finished(step: Step, both: Tensor) -> list[Tensor]:
            return [y.full for y in step.finish(both[:, :1], both[:, 1:])]

        return State(*(Pair(y.clone()) for y in self._repeat("finish", both, finished)))

    def _repeat(self, name: str, z: Tensor, f: Callable[[Step, Tensor], list[Tensor]]) -> list[Tensor]:
        if name not in self._recorded:
            self._recorded[name] = self._record(z.clone(), f)
        mine, whole = self._recorded[name]
        mine.copy_(z)
        return whole()

    def _record(
        self, mine: Tensor, f: Callable[[Step, Tensor], list[Tensor]]
    ) -> tuple[Tensor, Callable[[], list[Tensor]]]:
        def once() -> list[Tensor]:
            return f(Step(self.model, self.x, self.given), mine)

        try:
            return mine, Recorded(once, [*self.numbers, mine])
        except Unrepeatable as error:  # a joint of the user's own may be made of anything
            warnings.warn(f"uncompiled steps take twice as long as need be: {error}", stacklevel=2)
            return mine, once


def own_given(given: Prescribed) -> Prescribed:
    """A copy of what is known."""
    laws = [law if law is None else tuple(own(y) for y in law) for law in given.laws]
    return Prescribed(laws, *(own(y) for y in given[1:]))


def own(x: Any) -> Any:
    """A copy of a number."""
    return Pair(x.full.clone()) if isinstance(x, Pair) else x.clone()


def numbers(x: State, given: Prescribed) -> list[Tensor]:
    """All tensors of a state and of what is known."""
    parts = [*x, *(y for law in given.laws if law is not None for y in law), *given[1:]]
    return [y.full if isinstance(y, Pair) else y for y in parts]
