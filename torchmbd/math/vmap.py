"""What the vmap rules of torch.autograd.Function share.

Checked in tests/fem/reduction and tests/sensitivity.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor


def batch_first(x: Tensor, dim: int | None, size: int) -> Tensor:
    """Return x with its batch dimension of torch.func.vmap, `dim` of `in_dims`, in front; repeated where it has none."""
    return x.expand(size, *x.shape) if dim is None else x.movedim(dim, 0)


def extent(x: Tensor, dim: int | None) -> int:
    """Lanes of one member of a batch along `dim`: x is [..., lanes]."""
    return x.shape[-1] if dim is None else x.movedim(dim, 0).shape[-1]


def fold(x: Tensor, dim: int | None, size: int, lanes: int) -> Tensor:
    """A batch along `dim` as lanes: [..., size * lanes]."""
    y = batch_first(x, dim, size)
    return y.expand(*y.shape[:-1], lanes).movedim(0, -2).flatten(-2)


def as_lanes(tensors: Sequence[Tensor], dims: Sequence[int | None], size: int) -> list[Tensor]:
    """Tensors [..., lanes] with a batch as further lanes; one lane for all members stays one."""
    lanes = max((extent(x, d) for x, d in zip(tensors, dims, strict=True)), default=1)
    each = zip(tensors, dims, strict=True)
    return [x if d is None and x.shape[-1] == 1 else fold(x, d, size, lanes) for x, d in each]
