"""What operations of torch of our own share: a batch of torch.func.vmap becomes lanes; second derivatives are refused.

Checked in tests/fem/reduction and tests/sensitivity.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from torch import Tensor
from torch.autograd import Function


class FirstDerivative(Function):
    """A first derivative as a torch function; its own derivative is a NotImplementedError, not a wrong number.

    of   name of the function that would be differentiated twice
    """

    of: str

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Any) -> None:
        """Keep nothing."""

    @classmethod
    def jvp(cls, ctx: Any, *_: Any) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        raise NotImplementedError(
            f"second derivatives of {cls.of} are not provided; use finite differences of gradients"
        )

    @classmethod
    def backward(cls, ctx: Any, *_: Any) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        cls.jvp(ctx)


def apply_as_lanes(
    function: Callable[..., Any], info: Any, in_dims: Sequence[int | None], *tensors: Tensor, ordered: bool = True
) -> tuple[Any, Any]:
    """The vmap rule of a function of tensors [lane, ...], one or several: members of the batch are further lanes.

    ordered   False: the function does not name lanes in errors, and takes them in their order in memory without copying them
    """
    size = info.batch_size
    wide = [batch_first(x, dim, size) for x, dim in zip(tensors, in_dims, strict=True)]
    place = int(not ordered and all(x.transpose(0, 1).is_contiguous() for x in wide))  # of the batch
    result = function(*(x.transpose(0, place).flatten(0, 1) for x in wide))
    shape = (-1, size) if place else (size, -1)
    if isinstance(result, tuple):
        return tuple(y.unflatten(0, shape) for y in result), (place,) * len(result)
    return result.unflatten(0, shape), place


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
