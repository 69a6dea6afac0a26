"""Steps on a CUDA device by a kernel: the compiled step (code.py), one lane in each thread (march.cu).

All steps between two looks are one launch. The kernel is compiled in the background from the second batch on, once for a
topology and a kind of device. Until then graphs serve (captured.py), and where its factors cannot be relied on.
Checked in tests/integrators/test_kernel.py: the same text by a compiler of C++, the numbers of the eager march.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchmbd.integrators import captured, repeated
from torchmbd.integrators.blocks import addresses, flat_data, in_all_lanes, moving, shared, uniform
from torchmbd.integrators.captured import CapturedMarch
from torchmbd.integrators.history import Record
from torchmbd.integrators.library import found
from torchmbd.integrators.march import CHECK, March, between_looks
from torchmbd.integrators.step import State, Weights
from torchmbd.numerics import build_cache
from torchmbd.numerics.native import wanted
from torchmbd.numerics.nvrtc import Kernels
from torchmbd.numerics.pair import Pair
from torchmbd.system.dynamics import Dynamics
from torchmbd.system.topology import Prescribed

Launch = Callable[[str, Tensor, int], None]  # name of a kernel, its array, lanes


def march(dynamics: Dynamics, w: Weights, iterations: tuple[int, int], refresh: int) -> March:
    """The march of a system on its device: by a kernel if it is there."""
    launch = kernels(dynamics) if dynamics.device.type == "cuda" and wanted() else None
    if launch is None:
        return captured.march(dynamics, w, iterations, refresh)
    with torch.cuda.device(dynamics.device):
        return KernelMarch(launch, dynamics, repeated.model(dynamics, w), iterations, refresh)


def kernels(dynamics: Dynamics) -> Launch | None:
    """The kernels of a system, if they are there; asked for again, they are compiled in the background."""
    major, minor = torch.cuda.get_device_capability(dynamics.device)

    def load(path: Path) -> Kernels | None:
        code = build_cache.read(path)
        return None if code is None else Kernels(code, ["march", "doubts", "room"])

    with torch.cuda.device(dynamics.device):
        return found(dynamics, f"kernel:sm_{major}{minor}", load, str(dynamics.device))


class KernelMarch(CapturedMarch):
    """March by a kernel; where its factors cannot be relied on, it goes on by graphs."""

    def __init__(self, launch: Launch, dynamics: Dynamics, model: Any, iterations: tuple[int, int], refresh: int):
        super().__init__(captured.GRAPHS.get(dynamics.device.type), dynamics, model, iterations, refresh)
        T = dynamics.topology
        self.launch: Launch | None = launch
        self.lanes, self.slots, self.fresh = dynamics.lanes, dynamics.tangents, 1
        self.values, self.tangents = flat_data(dynamics)
        self.weights = torch.tensor(model.plain, dtype=torch.float64).to(dynamics.device)
        size = torch.zeros(1, dtype=torch.long).to(dynamics.device)
        self.launch("room", size, 1)
        n, n_x = T.n_v + T.rows, T.n_q + 3 * T.n_v + T.rows
        self.factors = self.values.new_empty(n * n + n, self.lanes)
        more = n * self.slots + max(n_x * (1 + self.slots), n * n + n)
        self.room = self.values.new_empty(int(size) + more, self.lanes)

    def _marched(self, x: State, schedule: Sequence[Prescribed], record: Record, first: int, place: int) -> State:
        if self.launch is None:
            return super()._marched(x, schedule, record, first, place)
        T = self.dynamics.topology
        parts = [in_all_lanes(y.full if isinstance(y, Pair) else y, self.lanes) for y in x]
        state, moved = torch.cat(parts), moving(T, schedule, self.lanes, self.slots)
        table = uniform(self.weights, shared(T, schedule))
        for some in between_looks(len(schedule), first, self.slots):
            at = some.start
            if not self._some(state, table[some], moved[some], record, first + at, place + at):
                self.launch = None
                return super()._marched(self._state(state), schedule[at:], record, first + at, place + at)
        return self._state(state)

    def _some(self, state: Tensor, table: Tensor, moved: Tensor, record: Record, first: int, place: int) -> bool:
        """Steps between two looks; False if the factors cannot be relied on, and nothing is done."""
        assert self.launch is not None
        look, steps = int(first % CHECK == 0), len(table)
        sizes, doubt = state.new_empty(steps, 2, self.lanes), state.new_empty(self.lanes)
        errors = state.new_empty(3, self.slots, self.lanes)
        stay, lost = self.diagonal or (None, None)
        numbers = [self.lanes, self.slots, len(self.values), table.shape[1], first, steps, self.corrections, self.most]
        numbers += [self.refresh, look, self.fresh, moved.shape[1]]
        arrays = [table, state, self.values, self.tangents, self.factors, stay, lost]
        arrays += [part[place:] for part in record.parts]
        arrays += [sizes, errors, self.room, moved, self.passes, doubt]
        job = torch.tensor(numbers + [x or 0 for x in addresses(arrays)], dtype=torch.long).to(state.device)
        if self.fresh or look:
            self.launch("doubts", job, self.lanes)
            if bool(doubt.any()):
                return False
        self.launch("march", job, self.lanes)
        self.fresh = 0
        self.sizes += sizes.unbind(0)
        if look and self.slots:
            self.look(*errors)
        return True

    def _state(self, state: Tensor) -> State:
        """A state out of its numbers [n, 1 + slots, lanes]."""
        T = self.dynamics.topology
        parts = state.split([T.n_q, T.n_v, T.n_v, T.n_v, T.rows])
        return State(*(Pair(y) if self.slots else y for y in parts))
