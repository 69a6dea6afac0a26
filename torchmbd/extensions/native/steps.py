"""Steps of one-step methods by compiled code (library.py): the same numbers as by EagerStepper (stepper.py).

Lanes go in blocks (simd_layout.py), each through many steps at a time, so that a block's numbers stay near the processor; one
call of the library makes all steps of some blocks between two checks of the tangents, or CALL of them. Threads share the blocks
(math/threads.py), unless laws are called back: these run in the calling thread.
Checked in tests/extensions/native/test_steps.py, test_threads.py.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from functools import partial

import torch
from torch import Tensor

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
from torchmbd.integrate.lanes import expanded
from torchmbd.integrate.step import Model, Weights
from torchmbd.integrate.stepper import CHECK, EagerStepper
from torchmbd.math.pair import Pair, value
from torchmbd.math.threads import run_blocks
from torchmbd.multibody.equations.topology import Schedule
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.progress import reach
from torchmbd.results.history import Record
from torchmbd.results.state import State

_NUMBERS = ("lanes", "n_b", "data", "data_tangents", "prescribed", "first", "steps", "corrections", "most", "refresh")
_NUMBERS += ("fresh", "moving", "tables")
_ARRAYS = ("shared", "state", "values", "tangents", "factors", "row_mask", "diagonal_shift", "q", "v", "vd", "lam")
_ARRAYS += ("sizes", "errors")
_ARRAYS += ("moved", "mechanism", "passes", "feedback", "counted", "scale", "weights")
CALL = 10 * CHECK  # steps of a call without tangents: progress is shown between two calls


class Job(ctypes.Structure):
    """The struct of this name in steps.cpp: fields, order and types are the same."""

    _fields_ = [(n, ctypes.c_long) for n in _NUMBERS] + [(n, ctypes.c_void_p) for n in _ARRAYS]


class NativeStepper(EagerStepper):
    """EagerStepper by a library; where its factors cannot be relied on, steps go on by operators of torch."""

    def __init__(
        self,
        library: Library,
        dynamics: Dynamics,
        w: Weights,
        iterations: tuple[int, int],
        refresh: int,
    ):
        super().__init__(dynamics, Model.of(dynamics, w), iterations, refresh)
        self.code: ctypes.CDLL | None = library.code
        code, self.library = library.code, library
        self.lanes, self.n_b, self.fresh = dynamics.lanes, dynamics.tangents, 1
        self.sound = torch.ones(self.lanes, dtype=torch.bool)  # lanes in which the iterations converge
        self.weights = torch.tensor(w, dtype=torch.float64)
        self.feedback = library.feedback(dynamics)
        self.values, self.tangents = library.data_blocks(dynamics)
        self.unknown_weights = unknown_weights(dynamics, self.lanes)
        self.factors = torch.empty(len(self.values) * code.steps_factors(library.address) // 8, dtype=torch.float64)

    def restart(self, lanes: Tensor | None = None) -> None:
        super().restart(lanes)
        self.fresh = 1
        self.sound = torch.ones_like(self.sound) if lanes is None else self.sound | lanes

    def run(self, x: State, schedule: Schedule, record: Record, first: int = 0, start: int = 1) -> State:
        if self.code is None:
            return super().run(x, schedule, record, first, start)
        self._begin(x)
        state = blocks(torch.cat([expanded(y.full if isinstance(y, Pair) else y, self.lanes) for y in x]))
        moved = varied_blocks(self.dynamics.topology, schedule, self.lanes, self.n_b)
        table = prescribed_blocks(self.dynamics.topology, self.weights, schedule)
        for part in _between_checks(len(schedule), first, self.n_b):
            done = part.start
            if self.feedback is not None:
                self.feedback.times = schedule.t[part]
            before = state.clone()
            if not self._run_part(state, table[part], moved[part], record, first + done, start + done):
                return super().run(self._state(before), schedule[done:], record, first + done, start + done)
            reach(value(schedule.t[part][-1]))
        return self._state(state)

    def _run_part(self, state: Tensor, table: Tensor, moved: Tensor, record: Record, first: int, start: int) -> bool:
        """Make the steps of a call; False if the factors cannot be relied on, and the steps count for nothing."""
        sizes = torch.empty(len(table), 3, self.lanes, dtype=torch.float64)
        errors = torch.empty(3, self.n_b, self.lanes, dtype=torch.float64)
        assert self.scale is not None
        assert self.code is not None
        assert all(part.shape[-1] == self.lanes for part in record.parts)
        scale = blocks(self.scale[None, None]).clone()  # steps that count for nothing leave self.scale as it was
        row_mask, diagonal_shift = self.diagonal or (None, None)
        arrays = {"shared": table, "state": state, "values": self.values, "tangents": self.tangents, "moved": moved}
        arrays |= {"factors": self.factors, "row_mask": row_mask, "diagonal_shift": diagonal_shift}
        arrays |= {name: x[start:] for name, x in zip(("q", "v", "vd", "lam"), record.parts, strict=True)}
        arrays |= {"sizes": sizes, "errors": errors, "scale": scale, "weights": self.unknown_weights}
        counted = blocks((self.counts * (1.0 + self.sound))[None, None].double())
        arrays |= {"passes": blocks(self.passes[None, None]), "counted": counted}
        job = Job(
            lanes=self.lanes,
            n_b=self.n_b,
            data=self.values.shape[2],
            data_tangents=self.tangents.shape[2],
            prescribed=table.shape[1],
            first=first,
            steps=len(table),
            corrections=self.corrections,
            most=int(self.passes.max()),
            refresh=-1 if self.begins_uniformly else self.refresh,
            fresh=self.fresh,
            moving=moved.shape[3],
            tables=1,
            mechanism=self.library.address,
            feedback=None if self.feedback is None else self.feedback.address,
            **addresses(arrays),
        )
        job.kept = arrays
        make = partial(make_steps, self.code, job, self.library.threads(self.lanes))
        if make() if self.feedback is None else self.feedback.run(make):
            self.code = None
            return False
        self.fresh = 0
        self.scale = lanes_out(scale, self.lanes)[0, 0]
        self.sizes.append(sizes)
        self.sound &= lanes_out(counted, self.lanes)[0, 0] != 1.0
        if self.n_b and first % CHECK == 0:
            self.check(*errors)
        return True

    def _state(self, state: Tensor) -> State:
        """A state out of blocks [block, column, number, LANES]."""
        T = self.dynamics.topology
        parts = lanes_out(state, self.lanes).split([T.n_q, T.n_v, T.n_v, T.n_v, T.rows])
        return State(*(Pair(y) if self.n_b else y for y in parts))


def make_steps(code: ctypes.CDLL, job: Job, threads: int) -> int:
    """Make the steps of a job; 1 where factors cannot be relied on, and the steps count for nothing; 2 where a law raised."""
    blocks, scratch = -(-job.lanes // LANES), code.steps_scratch(job.mechanism, job.n_b)
    return run_blocks(partial(code.run_steps, ctypes.byref(job)), blocks, threads, scratch)


def _between_checks(count: int, first: int, tangents: int) -> Iterator[slice]:
    """Steps, the first of number `first`, in runs without a check of tangents in between, each a call.

    A check may call for more corrections from the next step on, so with tangents its step is a run of its own.
    """
    done = 0
    while done < count:
        since = (first + done) % CHECK
        end = min(done + (CALL if not tangents else CHECK - since if since else 1), count)
        yield slice(done, end)
        done = end
