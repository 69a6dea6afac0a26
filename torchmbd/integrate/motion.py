"""The motion as one operation of PyTorch: `Motion.apply(integration, *inputs)`.

    outputs = F(inputs)                  forward    the integrator, on plain tensors
    d outputs = F' d inputs              jvp        tangents of the discrete steps; under vmap all of them in one pass
    inputs_bar = F'^T outputs_bar        backward   the discrete adjoint; under vmap all rows in one pass

Every tensor has the axes [component..., k, lanes]: k = 1 for values, the number of tangents or of cotangents (rows) for
derivatives. Lanes are designs that do not depend on each other, so `vmap` over designs becomes more lanes. A lane axis of
one holds for all lanes.

An `Integration` has the equations, the method and, once it has run, status and statistics.
Second derivatives are refused: tangents and adjoint have none.
Checked in tests/integrate/test_motion.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NoReturn, Protocol

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.math.gradients import refuse_batched_by_grad
from torchmbd.math.vmap import as_lanes, extent, fold
from torchmbd.process import one_thread

Tensors = Sequence[Tensor | None]


class Integration(Protocol):
    """A function of `Motion` with its derivatives, on plain tensors [component..., k, lanes]."""

    def values(self, inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Outputs of the inputs; keeps what the derivatives need."""
        ...

    def tangents(self, directions: Tensors) -> list[Tensor]:
        """Tangents of all outputs along directions of the inputs (None: zero)."""
        ...

    def cotangents(self, outputs: Tensors, needs_grad: Sequence[bool]) -> list[Tensor | None]:
        """Cotangents of the inputs that need a gradient (others: None), of all lanes, by those of the outputs (None: zero)."""
        ...


class Motion(torch.autograd.Function):
    """See the module header."""

    @staticmethod
    def forward(integration: Integration, *inputs: Tensor) -> tuple[Tensor, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        outputs = integration.values([x.detach() for x in inputs])
        # Torch attaches its graph to these, not to what the integration keeps.
        return tuple(x.detach() for x in outputs)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple[Tensor, ...]) -> None:
        ctx.integration, *tensors = inputs
        ctx.save_for_backward(*tensors)
        ctx.save_for_forward(*tensors)
        ctx.set_materialize_grads(False)

    @staticmethod
    @one_thread()
    def backward(ctx: Any, *cotangents: Tensor | None) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        inputs, needs_grad = ctx.saved_tensors, ctx.needs_input_grad[1:]
        refuse_batched_by_grad(cotangents)
        if all(x is None for x in cotangents):
            return (None,) * (1 + len(inputs))
        by_inputs = iter(_Backward.apply(ctx.integration, needs_grad, *inputs, *cotangents))  # pyright: ignore[reportArgumentType]
        return None, *(next(by_inputs) if needed else None for needed in needs_grad)

    @staticmethod
    def jvp(ctx: Any, _: None, *directions: Tensor | None) -> tuple[Tensor, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return _Forward.apply(ctx.integration, len(directions), *ctx.saved_tensors, *directions)  # pyright: ignore[reportReturnType]

    @staticmethod
    def vmap(info: Any, in_dims: tuple, integration: Integration, *inputs: Tensor) -> tuple[tuple[Tensor, ...], Any]:
        batch = info.batch_size
        outputs = Motion.apply(integration, *as_lanes(inputs, in_dims[1:], batch))
        return tuple(_unfold(x, batch) for x in outputs), (0,) * len(outputs)  # pyright: ignore[reportOptionalIterable, reportArgumentType]


def _refuse() -> NoReturn:
    raise InputError(
        "motion",
        allowed="differentiated once",
        noun="a motion",
        state="is being differentiated twice",
        hint="differences of gradients, for second derivatives",
    )


class _Derivative(torch.autograd.Function):
    """A derivative of `Motion`; it has none of its own."""

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Any) -> None:
        return None

    @staticmethod
    def backward(ctx: Any, *_: Any) -> NoReturn:  # pyright: ignore[reportIncompatibleMethodOverride]
        _refuse()

    @staticmethod
    def jvp(ctx: Any, *_: Any) -> NoReturn:  # pyright: ignore[reportIncompatibleMethodOverride]
        _refuse()


class _Backward(_Derivative):
    """(inputs, cotangents of the outputs) -> cotangents of the inputs that need a gradient."""

    @staticmethod
    def forward(integration: Integration, needs_grad: tuple[bool, ...], *tensors: Tensor | None) -> tuple[Tensor, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        inputs, outputs = tensors[: len(needs_grad)], tensors[len(needs_grad) :]
        rows = next(x.shape[-2] for x in outputs if x is not None)
        result = []
        for x, cotangent, needed in zip(inputs, integration.cotangents(outputs, needs_grad), needs_grad, strict=True):
            if needed and x is not None:
                y = x.new_zeros(*x.shape[:-2], rows, x.shape[-1]) if cotangent is None else cotangent
                result.append(y.sum(-1, keepdim=True) if x.shape[-1] == 1 < y.shape[-1] else y)
        return tuple(result)

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple, integration: Integration, needs_grad: tuple[bool, ...], *tensors: Tensor | None
    ):
        n, dims, batch = len(needs_grad), in_dims[2:], info.batch_size
        if all(d is None for d in dims[:n]):  # one motion, many cotangents
            stacked = [x if x is None else _stack(x, d, batch) for x, d in zip(tensors[n:], dims[n:], strict=True)]
            cotangents: Any = _Backward.apply(integration, needs_grad, *tensors[:n], *stacked)
            return tuple(_unstack(x, batch) for x in cotangents), (0,) * len(cotangents)
        lanes = _lanes(tensors, dims)
        folded = [x if x is None else fold(x, d, batch, lanes) for x, d in zip(tensors, dims, strict=True)]
        cotangents = [_unfold(x, batch) for x in _Backward.apply(integration, needs_grad, *folded)]  # pyright: ignore[reportOptionalIterable]
        single = [
            x is not None and extent(x, d) == 1
            for x, d, needed in zip(tensors[:n], dims[:n], needs_grad, strict=True)
            if needed
        ]
        cotangents = [
            x.sum(-1, keepdim=True) if is_single else x for x, is_single in zip(cotangents, single, strict=True)
        ]
        return tuple(cotangents), (0,) * len(cotangents)


class _Forward(_Derivative):
    """(inputs, their directions) -> tangents of the outputs; count: number of inputs."""

    @staticmethod
    def forward(integration: Integration, count: int, *tensors: Tensor | None) -> tuple[Tensor, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return tuple(integration.tangents(tensors[count:]))

    @staticmethod
    def vmap(info: Any, in_dims: tuple, integration: Integration, count: int, *tensors: Tensor | None):
        dims, batch = in_dims[2:], info.batch_size
        if all(d is None for d in dims[:count]):  # one motion, many directions
            rest = zip(tensors[count:], dims[count:], strict=True)
            stacked = [x if x is None else _stack(x, d, batch) for x, d in rest]
            tangents: Any = _Forward.apply(integration, count, *tensors[:count], *stacked)
            return tuple(_unstack(x, batch) for x in tangents), (0,) * len(tangents)
        lanes = _lanes(tensors, dims)
        folded = [x if x is None else fold(x, d, batch, lanes) for x, d in zip(tensors, dims, strict=True)]
        tangents = _Forward.apply(integration, count, *folded)
        return tuple(_unfold(x, batch) for x in tangents), (0,) * len(tangents)


def _lanes(tensors: Tensors, dims: Sequence[int | None]) -> int:
    return max(extent(x, d) for x, d in zip(tensors, dims, strict=True) if x is not None)


def _unfold(x: Tensor, batch: int) -> Tensor:
    return x.unflatten(-1, (batch, -1)).movedim(-2, 0)


def _stack(x: Tensor, dim: int | None, batch: int) -> Tensor:
    """A batch of derivatives, concatenated: [component..., batch * k, lanes]."""
    y = x[None].expand(batch, *x.shape) if dim is None else x.movedim(dim, 0)
    return y.movedim(0, -3).flatten(-3, -2)


def _unstack(x: Tensor, batch: int) -> Tensor:
    return x.unflatten(-2, (batch, -1)).movedim(-3, 0)
