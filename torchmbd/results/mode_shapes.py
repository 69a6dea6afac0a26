"""Mode shapes of the designs of a motion, by the structure stage, on demand.

    values(name)     [lanes, nodes, 6, modes] of a flexible body

Checked in tests/results/test_body_motion.py.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from torchmbd.math.forward_mode import jvp
from torchmbd.math.gradients import all_true, is_differentiated
from torchmbd.math.module_call import call_module


class Shapes:
    """Mode shapes of the bodies of a motion; each is kept."""

    def __init__(self) -> None:
        self._kept: dict[tuple[str, bool], Tensor] = {}

    def values(self, name: str) -> Tensor:
        """[lanes, nodes, 6, modes] of one body."""
        key = name, torch.is_grad_enabled()
        if key not in self._kept:
            self._kept[key] = self._values(name)
        return self._kept[key]

    def detach(self) -> Shapes:
        """The same numbers without a graph of torch."""
        raise NotImplementedError(type(self).__name__)

    def _values(self, name: str) -> Tensor:
        raise NotImplementedError(type(self).__name__)


class DesignShapes(Shapes):
    """Mode shapes of all lanes, of designs by name [lanes, ...].

    good     which lanes have not failed [lanes]: shapes of the others have no gradient; None: all
    shapes   those that the structure stage has made already, with gradients
    """

    def __init__(
        self,
        system: Any,
        designs: dict[str, Tensor],
        lanes: int,
        good: Tensor | None = None,
        shapes: Mapping[str, Tensor] = MappingProxyType({}),
    ):
        super().__init__()
        self.system, self.lanes, self.good = system, lanes, good
        # All parameters as they are now: they may change later.
        self.designs = {name: x.detach().clone() for name, x in system.named_parameters()} | designs
        self._kept |= {(name, True): self._in_all_lanes(psi) for name, psi in shapes.items()}

    def detach(self) -> DesignShapes:
        designs = {name: x.detach() for name, x in self.designs.items()}
        return DesignShapes(self.system, designs, self.lanes, self.good)

    def _values(self, name: str) -> Tensor:
        return self._in_all_lanes(call_module(self.system, self.designs, name)["psi"])

    def _in_all_lanes(self, psi: Tensor) -> Tensor:
        wide = psi if psi.dim() == 4 else psi[None].expand(self.lanes, *psi.shape)
        if self.good is None or all_true(self.good):
            return wide
        return torch.where(self.good[:, None, None, None], wide, wide.detach())


def without_failed(data: dict[str, Any], good: Tensor) -> dict[str, Any]:
    """Data [component..., 1, lanes] that have no derivative in lanes that are not good [lanes]: theirs would be nan."""
    if all_true(good):
        return data
    moving = {name: x for name, x in data.items() if isinstance(x, Tensor) and is_differentiated(x)}
    return data | {name: torch.where(good, x, x.detach()) for name, x in moving.items()}


class SomeLanes(Shapes):
    """Mode shapes of some lanes of others."""

    def __init__(self, base: Shapes, lanes: Sequence[int]):
        super().__init__()
        self.base, self.lanes = base, list(lanes)

    def _values(self, name: str) -> Tensor:
        return self.base.values(name)[self.lanes]

    def detach(self) -> SomeLanes:
        return SomeLanes(self.base.detach(), self.lanes)


class GivenShapes(Shapes):
    """Mode shapes by a function of the body's name."""

    def __init__(self, make: Callable[[str], Tensor]):
        super().__init__()
        self._make = make

    def _values(self, name: str) -> Tensor:
        return self._make(name)

    def detach(self) -> GivenShapes:
        return GivenShapes(lambda name: self._make(name).detach())


def shape_tangents(system: Any, designs: Mapping[str, Tensor], directions: Mapping[str, Tensor], name: str) -> Tensor:
    """Tangents of the mode shapes of a body [k, lanes, nodes, 6, modes] along directions of designs [k, lanes, ...]."""
    moving = {key: designs[key] for key in directions}

    def shapes_of(moving: dict[str, Tensor]) -> Tensor:
        return call_module(system, {**designs, **moving}, name)["psi"]

    def push(direction: dict[str, Tensor]) -> Tensor:
        return jvp(shapes_of, (moving,), (direction,))[1]

    with torch.no_grad():
        tangents: Any = torch.func.vmap(push)(dict(directions))
    lanes = max(len(x) for x in moving.values())
    return tangents if tangents.dim() == 5 else tangents[:, None].expand(-1, lanes, -1, -1, -1)
