"""The adjoint through equal steps by compiled code (adjoint.cpp): the same numbers as AdjointSolver.

Threads share the blocks of lanes (math/threads.py).
Checked in tests/sensitivity/test_adjoint.py, tests/extensions/native/test_threads.py.
"""

from __future__ import annotations

import ctypes
from functools import cached_property, partial

import torch
from torch import Tensor

from torchmbd.extensions.native.feedback import FeedbackAdjoint
from torchmbd.extensions.native.library import Library
from torchmbd.extensions.native.simd_layout import (
    LANES,
    addresses,
    blocks,
    lanes_out,
    prescribed_blocks,
    unknown_weights,
    varied_blocks,
)
from torchmbd.integrate.adjoint_solver import AdjointSolver, Cotangents, Grid, MotionCotangents, rows_of
from torchmbd.integrate.lanes import expanded
from torchmbd.math.pair import value
from torchmbd.math.threads import run_blocks
from torchmbd.multibody.equations.topology import Schedule
from torchmbd.results.state import State

_NUMBERS = ("lanes", "rows", "data", "prescribed", "steps", "moving")
_ARRAYS = ("shared", "q", "v", "vd", "lam", "q_bar", "v_bar", "vd_bar", "lam_bar", "start", "values", "moved")
_ARRAYS += ("row_mask", "diagonal_shift", "weights", "slopes", "moved_slopes", "state_slopes", "error")


class _Job(ctypes.Structure):
    """The struct of this name in adjoint.cpp: fields, order and types are the same."""

    _fields_ = [
        *((n, ctypes.c_long) for n in _NUMBERS),
        *((n, ctypes.c_void_p) for n in _ARRAYS),
        ("moved_columns", ctypes.c_long),
        ("corrections", ctypes.c_long),
        ("mechanism", ctypes.c_void_p),
        ("read", ctypes.c_long),
        *((n, ctypes.c_void_p) for n in ("signals", "strengths", "law_slopes", "strength_bars")),
    ]


class NativeAdjointSolver(AdjointSolver):
    """AdjointSolver by a library; where its factors cannot be relied on, segments go by operators of torch."""

    def __init__(self, library: Library, grid: Grid):
        super().__init__(grid)
        self.code: ctypes.CDLL | None = library.code
        self.library = library
        self.values = library.value_blocks(grid.dynamics)
        self.unknown_weights = unknown_weights(grid.dynamics, len(grid.lanes))
        self.diagonal = grid.dynamics.diagonal()
        self.weights = torch.tensor(grid.weights, dtype=torch.float64)

    @cached_property
    def _known_at_first(self) -> tuple[Schedule, Tensor, Tensor]:
        """`_known` of the first segment, kept: most motions are one segment."""
        return self._known(0)

    def _known(self, number: int) -> tuple[Schedule, Tensor, Tensor]:
        """Drives and known motions at the ends of the steps of a segment; those that all lanes share, and those that vary."""
        T, schedule = self.dynamics.topology, self._schedule(self.segments[number])
        return (
            schedule,
            prescribed_blocks(T, self.weights, schedule),
            varied_blocks(T, schedule, len(self.grid.lanes), 0),
        )

    def _segment(self, number: int, of_motion: MotionCotangents, y: State) -> tuple[Cotangents, Tensor]:
        rows, lanes = rows_of(of_motion), len(self.grid.lanes)
        if self.code is None:
            return super()._segment(number, of_motion, y)
        turned = lanes == 1 < rows and not self.library.called.actions
        if turned:  # rows of one design fill a block, which would have copies of the design
            bars = [x if x is None else x.mT for x in of_motion]
            result = self._compiled_segment(number, bars, y.map(lambda x: x.mT), rows, 1)
        else:
            result = self._compiled_segment(number, of_motion, y, lanes, rows)
        if result is None:
            self.code = None
            return super()._segment(number, of_motion, y)
        return _turned_back(*result) if turned else result

    def _compiled_segment(
        self, number: int, of_motion: MotionCotangents, y: State, lanes: int, rows: int
    ) -> tuple[Cotangents, Tensor] | None:
        """As `_segment`, of so many lanes, all with the numbers of the only one of the grid or with their own; None where
        factors cannot be relied on."""
        T, steps, count = self.dynamics.topology, self.segments[number], -(-lanes // LANES)
        schedule, table, moved = self._known(number) if number else self._known_at_first
        h, a = self._history(number, schedule)
        values, moved = (_of_blocks(x, axis, count) for x, axis in ((self.values, 0), (moved, 1)))
        data, moving = values.shape[2], moved.shape[3]
        new = values.new_zeros
        slopes, moved_slopes = new(count, rows, data, LANES), new(len(steps), count, rows, moving, LANES)
        state_slopes, error = blocks(torch.cat([expanded(x, lanes) for x in y])), new(count, LANES)
        names, (row_mask, diagonal_shift) = ("q", "v", "vd", "lam"), self.diagonal or (None, None)
        arrays: dict[str, Tensor | None] = {"shared": table, "values": values, "moved": moved}
        arrays |= {name: expanded(x, lanes).contiguous() for name, x in zip(names, h.states, strict=True)}
        bars = (x if x is None else _spaced(x, steps, self.grid) for x in of_motion)
        arrays |= {f"{name}_bar": x for name, x in zip(names, bars, strict=True)}
        arrays |= {"start": blocks(expanded(a, lanes)), "row_mask": row_mask, "diagonal_shift": diagonal_shift}
        arrays |= {
            "weights": _of_blocks(self.unknown_weights, 0, count),
            "slopes": slopes,
            "moved_slopes": moved_slopes,
        }
        arrays |= {"state_slopes": state_slopes, "error": error}
        job = _Job(
            lanes=lanes,
            rows=rows,
            data=data,
            prescribed=table.shape[1],
            steps=len(steps),
            moving=moving,
            moved_columns=moved.shape[2],
            corrections=self.corrections,
            mechanism=self.library.address,
            **addresses(arrays),
        )
        job.kept = [arrays]
        called, of_strengths = self._called(job, schedule) if self.library.called.actions else (None, new(0))
        if self._run(job):
            return None
        start = lanes_out(state_slopes, lanes).split([T.n_q, T.n_v, T.n_v, T.n_v, T.rows])
        laws = torch.stack([lanes_out(x, lanes) for x in moved_slopes]) if moving else None
        by = self.library.unflattened(self.dynamics, lanes_out(slopes, lanes))
        by |= called.cotangents(_lanes(of_strengths, lanes)) if called else {}
        return Cotangents(by, laws, State(*start)), error.flatten()[:lanes]

    def _run(self, job: _Job) -> int:
        """The steps of a job backwards; 1 where factors cannot be relied on."""
        assert self.code is not None
        blocks, scratch = -(-job.lanes // LANES), self.code.adjoint_scratch(job.mechanism, job.rows, job.steps)
        return run_blocks(partial(self.code.adjoint, ctypes.byref(job)), blocks, scratch=scratch)

    def _called(self, job: _Job, schedule: Schedule) -> tuple[FeedbackAdjoint, Tensor]:
        """Laws that are called back, and an array for the cotangents of their strengths [steps, block, rows, n, LANES]."""
        assert self.code is not None
        laws, (steps, count, rows, lanes) = self.library.called, (job.steps, len(self.values), job.rows, job.lanes)
        n = len(laws.actions)
        signals, of_strengths = (self.values.new_zeros(steps, count, *some, LANES) for some in ((2 * n,), (rows, n)))
        job.signals, job.rows, job.read = signals.data_ptr(), 0, 1
        self._run(job)
        job.rows, job.read = rows, 0
        data, times = self.grid.dynamics.data, schedule.t
        variables = {name for name, x in data.items() if value(x).requires_grad}
        plain = {name: value(x).detach() for name, x in data.items()}
        adjoint = FeedbackAdjoint(laws, plain, _lanes(signals, lanes), times, variables)
        arrays = {"strengths": _blocks(adjoint.strengths), "law_slopes": _blocks(adjoint.slopes)}
        arrays["strength_bars"] = of_strengths
        for name, address in addresses(arrays).items():
            setattr(job, name, address)
        job.kept.append(arrays)
        return adjoint, of_strengths


def _of_blocks(x: Tensor, axis: int, count: int) -> Tensor:
    """Numbers of so many blocks, in the place of one whose lanes are all equal, or of none."""
    if x.shape[axis] in (0, count):
        return x
    return x.expand(*x.shape[:axis], count, *x.shape[axis + 1 :]).contiguous()


def _turned_back(by: Cotangents, error: Tensor) -> tuple[Cotangents, Tensor]:
    """Cotangents of the rows of one design out of those of as many lanes."""
    data, laws = {name: x.mT for name, x in by.data.items()}, None if by.laws is None else by.laws.mT
    return Cotangents(data, laws, by.start.map(lambda x: x.mT)), error.amax(0, keepdim=True)


def _lanes(x: Tensor, lanes: int) -> Tensor:
    """Numbers [steps, block, ..., LANES] as [steps, ..., lanes]."""
    return x.movedim(1, -2).flatten(-2)[..., :lanes]


def _blocks(x: Tensor) -> Tensor:
    """The inverse of `_lanes`; the last lane fills the last block."""
    x = torch.cat([x, x[..., -1:].expand(*x.shape[:-1], -x.shape[-1] % LANES)], -1)
    return x.unflatten(-1, (-1, LANES)).movedim(-2, 1).contiguous()


def _spaced(x: Tensor, steps: range, grid: Grid) -> Tensor:
    """Cotangents [outputs, ...] of the states of a segment, zero where a state is not an output."""
    every, offset = grid.every, grid.offset
    if every == 1 and not offset:
        return x[steps.start : steps.stop + 1].contiguous()
    first, last = max(-((offset - steps.start) // every), 0), (steps.stop - offset) // every
    result = x.new_zeros(len(steps) + 1, *x.shape[1:])
    if last >= first:
        result[first * every + offset - steps.start :: every] = x[first : last + 1]
    return result
