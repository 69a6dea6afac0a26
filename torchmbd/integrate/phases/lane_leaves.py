"""One lane of a simulation through phases as a graph of torch: its leaves, and their cotangents from those of outputs.

Cotangents have the rows of the responses first: [rows, ...] of a number [...]. None: zero.
Checked in tests/sensitivity/test_phase_adjoint.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchmbd.integrate.phases.events import Views
from torchmbd.integrate.phases.lanes import lanes_of
from torchmbd.integrate.pullback import leaf
from torchmbd.multibody.system.dynamics import Dynamics

Key = tuple[str, str]  # kind of a leaf, "data", "design" or "shape", and its name


class LaneLeaves:
    """Data, designs and mode shapes of one lane as leaves of a graph; shapes on demand."""

    def __init__(self, views: Views, lane: int, dynamics: Dynamics, wanted: Sequence[str]):
        self.leaves: dict[Key, Tensor] = {}
        one = lanes_of(dynamics, [lane])
        data = {name: self._leaf("data", name, x) if name in wanted else x for name, x in one.data.items()}
        self.dynamics = one.with_data(data)
        self.views = views.with_leaves(
            [lane],
            lambda name, x: self._leaf("design", name, x),
            lambda name, x: self._leaf("shape", name, x),
        )

    def _leaf(self, kind: str, name: str, x: Tensor) -> Tensor:
        return self.leaves.setdefault((kind, name), leaf(x))


def pull_back(
    outputs: Sequence[Tensor], cotangents: Sequence[Tensor | None], inputs: Sequence[Tensor], rows: int
) -> list[Tensor]:
    """Cotangents [rows, ...] of the inputs from those of the outputs."""
    used = [(y, x) for y, x in zip(outputs, cotangents, strict=True) if x is not None and y.requires_grad]
    if not used or not inputs:
        return zeros(rows, inputs)
    of = [y for y, _ in used]
    options: dict[str, Any] = {"retain_graph": True, "allow_unused": True, "materialize_grads": True}
    found = [torch.autograd.grad(of, list(inputs), [x[row] for _, x in used], **options) for row in range(rows)]
    return [torch.stack(x) for x in zip(*found, strict=True)]


def zeros(rows: int, like: Sequence[Tensor]) -> list[Tensor]:
    """Cotangents [rows, ...] of zero, of tensors like these."""
    return [x.new_zeros(rows, *x.shape) for x in like]


def rows_first(cotangent: Tensor, lane: int) -> Tensor:
    """Cotangents [component..., rows, lanes] of one lane as [rows, component..., 1, 1]."""
    own = cotangent[..., lane] if cotangent.shape[-1] > 1 else cotangent[..., 0]
    return own.movedim(-1, 0)[..., None, None]


def shaped(cotangent: Tensor | None, like: Tensor) -> Tensor | None:
    """Cotangents of a number in the shape of that number."""
    return None if cotangent is None else cotangent.reshape(len(cotangent), *like.shape)
