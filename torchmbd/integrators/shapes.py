"""Mode shapes of the designs of a motion: the structure stage once more, when somebody asks.

    values(name)     [lanes, nodes, 6, modes] of a flexible body
    tangents(name)   [lanes, nodes, 6, modes, n_b], None without design variables

Checked in tests/integrators/test_body_motion.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchmbd.integrators.signals import moved
from torchmbd.numerics.called import called


class Shapes:
    """What was asked for once is kept."""

    def __init__(self) -> None:
        self._kept: dict[tuple[str, bool], Tensor] = {}
        self._slopes: dict[str, Tensor | None] = {}

    def values(self, name: str) -> Tensor:
        """Of one body."""
        key = name, torch.is_grad_enabled()
        if key not in self._kept:
            self._kept[key] = self._values(name)
        return self._kept[key]

    def tangents(self, name: str) -> Tensor | None:
        """Their derivatives."""
        if name not in self._slopes:
            self._slopes[name] = self._tangents(name)
        return self._slopes[name]

    def detach(self) -> Shapes:
        """The same numbers without a graph of torch."""
        raise NotImplementedError(type(self).__name__)

    def _values(self, name: str) -> Tensor:
        raise NotImplementedError(type(self).__name__)

    def _tangents(self, name: str) -> Tensor | None:
        return None


class DesignShapes(Shapes):
    """Of all lanes; designs by name [lanes, ...], parameters: names of the design variables, one for each slot.

    status   of the lanes: shapes of those that failed have no gradient
    """

    def __init__(
        self,
        system: Any,
        designs: dict[str, Tensor],
        parameters: tuple[str, ...],
        lanes: int,
        status: Sequence[str] = (),
    ):
        super().__init__()
        self.system, self.parameters, self.lanes, self.status = system, parameters, lanes, status
        # All parameters as they are now: they may be others when somebody looks.
        self.designs = {name: x.detach().clone() for name, x in system.named_parameters()} | designs

    def detach(self) -> DesignShapes:
        """As of Shapes."""
        designs = {name: x.detach() for name, x in self.designs.items()}
        return DesignShapes(self.system, designs, self.parameters, self.lanes, self.status)

    def _values(self, name: str) -> Tensor:
        return self._of(name, self.designs)

    def _tangents(self, name: str) -> Tensor | None:
        if not self.parameters:
            return None
        zero = torch.zeros(len(self.parameters), dtype=torch.float64)
        with torch.no_grad():
            slopes = torch.func.jacfwd(
                lambda delta: self._of(name, moved_designs(self.designs, self.parameters, delta))
            )(zero)
        assert isinstance(slopes, Tensor)
        return slopes

    def _of(self, name: str, designs: dict[str, Tensor]) -> Tensor:
        psi = called(self.system, designs, name)["psi"]
        wide = psi if psi.dim() == 4 else psi[None].expand(self.lanes, *psi.shape)
        good = sound_lanes(self.status, self.lanes)
        return wide if good is None else torch.where(good[:, None, None, None], wide, wide.detach())


def sound_lanes(status: Sequence[str], lanes: int) -> Tensor | None:
    """Which lanes have not failed [lanes]; None: none has. Of a batch of torch.func.vmap all lanes count as sound."""
    good = [not reason.startswith("failed") for reason in status]
    return None if all(good) or len(good) != lanes else torch.tensor(good)


def without_failed(data: dict[str, Any], status: Sequence[str], lanes: int) -> dict[str, Any]:
    """Data [component..., 1, lanes] that have no gradient in lanes that failed: that of their motion would be nan."""
    good = sound_lanes(status, lanes)
    if good is None:
        return data

    moving = {name: x for name, x in data.items() if isinstance(x, Tensor) and x.requires_grad}
    return data | {name: torch.where(good, x, x.detach()) for name, x in moving.items()}


def moved_designs(designs: dict[str, Tensor], parameters: tuple[str, ...], delta: Tensor) -> dict[str, Tensor]:
    """Designs of the neighbor by delta [n_b] or [lanes, n_b]; parameters: names of its entries, one label for each."""
    found, start = dict(designs), 0
    for name in dict.fromkeys(label.rpartition("[")[0] for label in parameters):
        shape = designs[name].shape[1:]
        step = delta[..., start : start + shape.numel()]
        found[name] = designs[name] + step.reshape(delta.shape[:-1] + shape)
        start += shape.numel()
    return found


class MovedShapes(Shapes):
    """Of the neighbor of a motion by delta [n_b] or [lanes, n_b], to first order."""

    def __init__(self, base: Shapes, delta: Tensor):
        super().__init__()
        self.base, self.delta = base, delta

    def _values(self, name: str) -> Tensor:
        return moved(self.base.values(name), self.base.tangents(name), self.delta)


class OneLane(Shapes):
    """Of one lane; n: number of directions, of which those beyond the base's are zero."""

    def __init__(self, base: Shapes, lane: int, n: int = 0):
        super().__init__()
        self.base, self.lane, self.n = base, slice(lane, lane + 1), n

    def _values(self, name: str) -> Tensor:
        return self.base.values(name)[self.lane]

    def detach(self) -> OneLane:
        """As of Shapes."""
        return OneLane(self.base.detach(), self.lane.start, self.n)

    def _tangents(self, name: str) -> Tensor | None:
        slopes = self.base.tangents(name) if self.n else None
        if slopes is None:
            return None
        return torch.nn.functional.pad(slopes[self.lane], (0, self.n - slopes.shape[-1]))
