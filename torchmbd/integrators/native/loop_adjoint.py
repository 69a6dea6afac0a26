"""The way back through equal steps by compiled code (adjoint.cpp): the same numbers as Sweep (adjoint.py).

Checked in tests/sensitivity/test_adjoint.py.
"""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from torchmbd.integrators.adjoint import Bars, Cotangents, Grid, Sweep, rows_of
from torchmbd.integrators.blocks import (
    addresses,
    blocks,
    in_all_lanes,
    lanes_out,
    moving_blocks,
    shared,
    uniform,
)
from torchmbd.integrators.native.data import unflattened
from torchmbd.integrators.native.loop_march import _cached, data_blocks
from torchmbd.integrators.step import State
from torchmbd.numerics.pair import value

_NUMBERS = ("lanes", "rows", "data", "uniform", "steps", "moving")
_ARRAYS = ("given", "q", "v", "vd", "lam", "q_bar", "v_bar", "vd_bar", "lam_bar", "start", "values", "moved")
_ARRAYS += ("stay", "lost", "nothing", "slopes", "moved_slopes", "start_slopes", "error", "room")


class _Job(ctypes.Structure):
    """As in adjoint.cpp."""

    _fields_ = [
        *((n, ctypes.c_long) for n in _NUMBERS),
        *((n, ctypes.c_void_p) for n in _ARRAYS),
        ("moved_slots", ctypes.c_long),
        ("corrections", ctypes.c_long),
        ("mechanism", ctypes.c_void_p),
    ]


class LoopSweep(Sweep):
    """Sweep by a library. Where its factors cannot be relied on, it goes the eager way."""

    def __init__(self, code: ctypes.CDLL, grid: Grid):
        super().__init__(grid)
        self.code: ctypes.CDLL | None = code
        code.adjoint_room.restype = code.adjoint.restype = ctypes.c_long
        code.adjoint_room.argtypes = [ctypes.c_void_p, ctypes.c_long, ctypes.c_long]
        self.mechanism = _cached(grid.dynamics).struct(code)
        T, lanes = grid.dynamics.topology, len(grid.lanes)
        plain = grid.dynamics.values()
        self.values, _ = data_blocks(plain)
        self.moved = moving_blocks(T, self.schedule, lanes, 0)
        self.table = uniform(torch.tensor(grid.weights, dtype=torch.float64), shared(T, self.schedule))
        h = grid.history
        self.states = [x.contiguous() for x in (h.q, h.v, h.vd, h.lam)]
        self.least = blocks(in_all_lanes(self.nothing[None, None], lanes))
        self.start = blocks(in_all_lanes(value(grid.start.a), lanes))

    def __call__(self, bars: Bars) -> tuple[Cotangents, Tensor]:
        if self.code is None:
            return super().__call__(bars)
        T, lanes, rows, steps = self.dynamics.topology, len(self.grid.lanes), rows_of(bars), len(self.table)
        count, data, moving = len(self.values), self.values.shape[2], self.moved.shape[3]
        n_x = T.n_q + 3 * T.n_v + T.rows
        new = self.values.new_zeros
        slopes, moved_slopes = new(count, rows, data, 8), new(steps, count, rows, moving, 8)
        start_slopes, error = new(count, rows, n_x, 8), new(count, 8)
        room = torch.empty(self.code.adjoint_room(ctypes.byref(self.mechanism), rows, steps), dtype=torch.float64)
        arrays = [self.table, *self.states, *(x if x is None else x.contiguous() for x in bars), self.start]
        arrays += [self.values, self.moved, *(self.diagonal or (None, None)), self.least]
        arrays += [slopes, moved_slopes, start_slopes, error, room]
        numbers = (lanes, rows, data, self.table.shape[1], steps, moving)
        job = _Job(*numbers, *addresses(arrays), self.moved.shape[2], self.grid.corrections, ctypes.addressof(self.mechanism))
        if self.code.adjoint(ctypes.byref(job)):
            self.code = None
            return super().__call__(bars)
        y = lanes_out(start_slopes, lanes).split([T.n_q, T.n_v, T.n_v, T.n_v, T.rows])
        laws = torch.stack([lanes_out(x, lanes) for x in moved_slopes]) if moving else None
        by = unflattened(self.dynamics, lanes_out(slopes, lanes))
        return Cotangents(by, laws, State(*y)), error.flatten()[:lanes]
