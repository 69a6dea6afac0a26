"""The start of motions by compiled code (start.cpp): accelerations and the smooth start of smooth_start.py, with derivatives in
reverse mode.

In forward mode the operators of torch take these values as `known` and add the tangents, so both modes of gradients begin with
the same numbers. The operators of torch compute the start alone if a drive or the duration has design variables, if laws are
called back, if there are no joints, and if the factors cannot be relied on.
Checked in tests/extensions/native/test_start.py.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from torchmbd.extensions.native.library import Library, has_start, library
from torchmbd.extensions.native.simd_layout import LANES, addresses, in_blocks, lanes_out, unknown_weights
from torchmbd.integrate.lanes import expanded
from torchmbd.integrate.prepared import detached
from torchmbd.integrate.smooth_start import start_weights
from torchmbd.integrate.step import Weights
from torchmbd.math.gradients import is_differentiated
from torchmbd.math.pair import value
from torchmbd.math.threads import run_blocks
from torchmbd.math.vmap import FirstDerivative, batch_first
from torchmbd.multibody.equations.data import Data
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.results.state import State

_NUMBERS = ("lanes", "rows", "data", "columns", "third", "numbers")
_ARRAYS = (
    "shared",
    "values",
    "scales",
    "x",
    "row_mask",
    "diagonal_shift",
    "z",
    "z_bar",
    "slopes",
    "x_slopes",
    "mechanism",
    "weights",
)


class _Job(ctypes.Structure):
    """The struct of this name in start.cpp: fields, order and types are the same."""

    _fields_ = [(n, ctypes.c_long) for n in _NUMBERS] + [(n, ctypes.c_void_p) for n in _ARRAYS]


def accelerations(dynamics: Dynamics, q: Any, v: Any) -> Tensor | None:
    """Accelerations at t = 0 above their multipliers [n_v + rows, 1, lanes]; None: there is no such code."""
    if not has_start(dynamics) or (code := library(dynamics, "start")) is None:
        return None
    T, t = dynamics.topology, torch.zeros((), dtype=torch.float64)
    plain = _without_graph(dynamics)
    jets = [jet for drive in T.law_jets(t, plain.data) if drive is not None for jet in drive]
    parts = [x for jet in jets for x in jet.parts]
    numbers = _numbers(t, 1.0 / dynamics.stabilization, parts, [jet.value for jet in jets])
    return _Start(code, plain, numbers).solve(dynamics.data, q, v, 0.0 * value(v))


def third_rates(dynamics: Dynamics, weights: Weights, x: State, h: Any) -> Tensor | None:
    """Values of jerk and d of `smooth_start` at t = 0 for steps of one size [n_v + rows, 2, lanes].

    None: there is no such code.
    """
    if is_differentiated(value(h)) or not has_start(dynamics) or (code := library(dynamics, "start")) is None:
        return None
    _, scales = start_weights(weights)
    plain, size = _without_graph(dynamics), value(h).flatten()[0]
    schedule = plain.topology.schedule(torch.stack([torch.zeros_like(size), size]), plain.data)
    laws = [x for drive in schedule.laws if drive is not None for x in drive]  # their rates do not enter
    numbers = _numbers(size, 0.0, [y for x in laws for y in (x[0], 0.0 * x[0], 0.0 * x[0])], [x[1] for x in laws])
    start = _Start(code, plain, numbers, torch.tensor(scales, dtype=torch.float64))
    return start.solve(dynamics.data, x.q, x.v, x.vd)


_plain: WeakKeyDictionary[Dynamics, Dynamics] = WeakKeyDictionary()


def _without_graph(dynamics: Dynamics) -> Dynamics:
    """The dynamics without a graph of torch, kept as long as they: accelerations and smooth start share it."""
    if dynamics not in _plain:
        _plain[dynamics] = detached(dynamics.values()).share_rank(dynamics)
    return _plain[dynamics]


def _numbers(h: Tensor, rate: float, jets: Sequence[Tensor], ends: Sequence[Tensor]) -> Tensor:
    """Numbers that are the same in all lanes [n, LANES]: two factors (start.cpp), the step h [], the rate of the stabilization,
    the time, then the laws of drives: values and both derivatives at t = 0, values after the step."""
    head = torch.cat([h.new_zeros(2), h[None], h.new_tensor([rate, 0.0])])
    return in_blocks(torch.cat([head, *(x.flatten() for x in (*jets, *ends))]).detach())


@dataclass(eq=False)
class _Start:
    """Solutions at one state: the accelerations, or vectors along M^-1 Phi_q' with `scales` [columns, 2].

    dynamics   without a graph of torch: a graph that holds it, and is held by it, would never be freed
    """

    code: Library
    dynamics: Dynamics
    numbers: Tensor
    scales: Tensor | None = None

    def solve(self, data: Data, q: Any, v: Any, vd: Any) -> Tensor | None:
        """z [n_v + rows, columns, lanes], differentiable by states and data; None where factors cannot be relied on.

        Pairs give their values, and no derivatives.
        """
        lanes = max(self.dynamics.lanes, value(q).shape[-1])
        state = [expanded(value(x), lanes) for x in (q, v, vd)]
        try:
            return _Solution.apply(self, *state, *map(value, data.values()))
        except _UnreliableFactors:
            return None

    def run(self, x: Tensor, z: Tensor, z_bar: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Write z, or return cotangents of the states x [n, lanes] and of the data, both [n, rows, lanes]."""
        values = self.code.value_blocks(self.dynamics)
        lanes, count = x.shape[-1], -(-x.shape[-1] // LANES)
        values = values if len(values) == count else values.expand(count, -1, -1, -1).contiguous()  # of one lane
        data, rows = values.shape[2], 0 if z_bar is None else z_bar.shape[2]
        slopes, x_slopes = (x.new_zeros(count, rows, n, LANES) for n in (data, len(x)))
        row_mask, diagonal_shift = self.dynamics.diagonal() or (None, None)
        arrays = {"shared": self.numbers, "values": values, "scales": self.scales, "x": x, "z": z, "z_bar": z_bar}
        arrays |= {"row_mask": row_mask, "diagonal_shift": diagonal_shift, "slopes": slopes, "x_slopes": x_slopes}
        arrays["weights"] = unknown_weights(self.dynamics, lanes)
        job = _Job(
            lanes=lanes,
            rows=rows,
            data=data,
            columns=z.shape[1],
            third=int(self.scales is not None),
            numbers=len(self.numbers),
            mechanism=self.code.address,
            **addresses(arrays),
        )
        scratch = self.code.code.start_scratch(self.code.address, len(self.numbers))
        if run_blocks(partial(self.code.code.start, ctypes.byref(job)), count, scratch=scratch):
            raise _UnreliableFactors
        return lanes_out(x_slopes, lanes), lanes_out(slopes, lanes)


class _UnreliableFactors(Exception):
    """Factors without pivoting are not those of the matrix."""


class _Solution(torch.autograd.Function):
    """(start, q, v, v', data) -> z."""

    @staticmethod
    def forward(start: _Start, q: Tensor, v: Tensor, vd: Tensor, *_: Tensor) -> Tensor:
        T, columns = start.dynamics.topology, 1 if start.scales is None else len(start.scales)
        z = q.new_empty(T.n_v + T.rows, columns, q.shape[-1])
        start.run(_flat(q, v, vd), z)
        return z

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.start, *tensors = inputs
        ctx.save_for_backward(output, *tensors)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        return None, *_Cotangents.apply(ctx.start, cotangents[0], *ctx.saved_tensors)


class _Cotangents(FirstDerivative):
    """(start, cotangent of z, z, q, v, v', data) -> cotangents of the last."""

    of = "the start of a motion"

    @staticmethod
    def forward(start: _Start, z_bar: Tensor, z: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:
        return tuple(x[0] for x in _pulled(start, z_bar[None], z, tensors))

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple, start: _Start, z_bar: Tensor, z: Tensor, *tensors: Tensor
    ) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        rows = batch_first(z_bar, in_dims[1], info.batch_size)
        return tuple(_pulled(start, rows, z, tensors)), (0,) * len(tensors)


def _pulled(start: _Start, z_bar: Tensor, z: Tensor, tensors: Sequence[Tensor]) -> list[Tensor]:
    """Cotangents [rows, ...] of states and data from rows of z."""
    q, v, vd, *data = tensors
    with torch.no_grad():
        of_state, of_data = start.run(_flat(q, v, vd), z, z_bar.permute(1, 2, 0, 3).contiguous())
        by = start.code.unflattened(start.dynamics, of_data)
    parts = [*of_state.split([len(q), len(v), len(vd)]), *(by[name] for name in start.dynamics.data)]
    return [_of_shape(x, y) for x, y in zip(parts, (q, v, vd, *data), strict=True)]


def _of_shape(cotangents: Tensor, x: Tensor) -> Tensor:
    """Cotangents [component..., rows, lanes] of x [component..., 1, lanes or 1] as [rows, *shape of x]."""
    y = cotangents.movedim(-2, 0).unsqueeze(-2)
    return y if y.shape[-1] == x.shape[-1] else y.sum(-1, keepdim=True)


def _flat(q: Tensor, v: Tensor, vd: Tensor) -> Tensor:
    """States [n, lanes]."""
    return torch.cat([q, v, vd])[:, 0].detach().contiguous()
