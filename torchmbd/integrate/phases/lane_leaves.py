"""Some lanes of a motion as a graph of torch: its leaves, and their cotangents from those of outputs.

No lane depends on another, so one pass gives the cotangents of all. Cotangents have the rows of the responses first:
[rows, ...] of a number [..., lanes], a design or a mode shape [lanes, ...]. None: zero.
Checked in tests/sensitivity/test_phase_adjoint.py.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchmbd.integrate.lanes import expanded
from torchmbd.integrate.phases.events import Views
from torchmbd.integrate.pullback import leaf
from torchmbd.math.pull_back import pull_back
from torchmbd.multibody.system.dynamics import Dynamics

Key = tuple[str, str]  # kind of a leaf, "data", "design" or "shape", and its name


class LaneLeaves:
    """Data, designs and mode shapes of some lanes as leaves of a graph; shapes on demand.

    dynamics   of these lanes;  names: of the data that are leaves
    are_made   these data are leaves already
    """

    def __init__(
        self, views: Views, lanes: Sequence[int], dynamics: Dynamics, names: Sequence[str], are_made: bool = False
    ):
        self.leaves: dict[Key, Tensor] = {}
        self.dynamics = dynamics
        if are_made:
            self.leaves = {("data", name): dynamics.data[name] for name in names}
        else:
            data = {
                name: self._leaf("data", name, expanded(x, len(lanes))) if name in names else x
                for name, x in dynamics.data.items()
            }
            self.dynamics = dynamics.with_data(data)
        self.views = views.with_leaves(
            lanes,
            lambda name, x: self._leaf("design", name, x),
            lambda name, x: self._leaf("shape", name, x),
        )

    def _leaf(self, kind: str, name: str, x: Tensor) -> Tensor:
        return self.leaves.setdefault((kind, name), leaf(x))


def pulled_back(
    outputs: Sequence[Tensor],
    cotangents: Sequence[Tensor | None],
    inputs: Sequence[Tensor],
    rows: int,
    at_once: bool = False,
) -> list[Tensor]:
    """Cotangents [rows, ...] of the inputs from those of the outputs.

    at_once   all rows by torch.vmap, for which steps are not
    """
    used = [(y, x) for y, x in zip(outputs, cotangents, strict=True) if x is not None and y.requires_grad]
    if not used or not inputs:
        return zeros(rows, inputs)
    of = [y for y, _ in used]
    if at_once:
        return list(pull_back(of, inputs, [x for _, x in used]))
    by_row = [pull_back(of, inputs, [x[row : row + 1] for _, x in used]) for row in range(rows)]
    return [torch.cat(x) for x in zip(*by_row, strict=True)]


def zeros(rows: int, like: Sequence[Tensor]) -> list[Tensor]:
    """Cotangents [rows, ...] of zero, of tensors like these."""
    return [x.new_zeros(rows, *x.shape) for x in like]


def rows_first(cotangent: Tensor, lanes: Sequence[int]) -> Tensor:
    """Cotangents [component..., rows, lanes] of some lanes as [rows, component..., 1, lanes]."""
    some = cotangent[..., list(lanes)] if cotangent.shape[-1] > 1 else expanded(cotangent, len(lanes))
    return some.movedim(-2, 0).unsqueeze(-2)


def add_lanes(total: Tensor, kind: str, lanes: Sequence[int], part: Tensor) -> None:
    """Add the cotangents [rows, ...] of some lanes to those of all; kind: of the leaf."""
    if kind == "data":
        total[..., list(lanes)] += part
    else:
        total[:, list(lanes)] += part


def by_lanes(factor: Tensor, x: Tensor, kind: str) -> Tensor:
    """Cotangents x [1, ...] of each lane times factors [rows, lanes]."""
    if kind == "data":
        return factor.reshape(len(factor), *[1] * (x.dim() - 2), -1) * x
    return factor.reshape(*factor.shape, *[1] * (x.dim() - 2)) * x
