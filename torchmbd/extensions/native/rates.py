"""The index-1 right-hand side by compiled code (library.py): the same numbers as Dynamics.rates.

Systems with redundant constraints, or with drives that have design variables, are evaluated by operators of torch (backend.py);
so is a body without inertia about an axis.
Checked in tests/extensions/native/test_steps.py.
"""

from __future__ import annotations

import ctypes
from functools import partial

import torch
from torch import Tensor

from torchmbd.extensions.native.library import Library
from torchmbd.extensions.native.simd_layout import addresses, in_blocks, unknown_weights
from torchmbd.integrate.ode import RightHandSide
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.progress import reach

CHECK = 100  # evaluations between two checks of the factors
_NUMBERS = ("lanes", "n_b", "data", "data_tangents", "check")
_ARRAYS = ("prescribed", "values", "tangents", "y", "dy", "lam", "scratch", "mechanism", "feedback", "weights")


class _Job(ctypes.Structure):
    """The struct of this name in rates.cpp: fields, order and types are the same."""

    _fields_ = [(n, ctypes.c_long) for n in _NUMBERS] + [(n, ctypes.c_void_p) for n in _ARRAYS]


class CompiledRates:
    """dy/dt and multipliers of augmented states y [n_z, 1 + n_b, lanes]."""

    def __init__(self, library: Library, dynamics: Dynamics):
        code, self.library, self.dynamics = library.code, library, dynamics
        self.code = code
        self.values, self.tangents = library.data_blocks(dynamics)
        self.scratch = torch.empty(code.rates_scratch(library.address) // 8, dtype=torch.float64)
        self.weights = unknown_weights(dynamics, dynamics.lanes)
        self.count, self.feedback = 0, library.feedback(dynamics)

    def __call__(self, t: Tensor, y: Tensor) -> tuple[Tensor, Tensor] | None:
        """dy/dt [n_z, 1 + n_b, lanes] and multipliers [rows, 1 + n_b, lanes] at time t; None: not to be relied on."""
        y = y.contiguous()
        T = self.dynamics.topology
        jets = [jet for drive in T.law_jets(t) if drive is not None for jet in drive]
        head = torch.stack([t.new_tensor(1.0 / self.dynamics.stabilization), t])
        prescribed = in_blocks(torch.cat([head, *(x.flatten() for jet in jets for x in jet.parts)]))
        dy, lam = torch.empty_like(y), y.new_empty(T.rows, *y.shape[1:])
        assert y.shape[2] == self.dynamics.lanes
        if self.feedback is not None:
            self.feedback.times = t[None]
        arrays = {"prescribed": prescribed, "values": self.values, "tangents": self.tangents, "y": y, "dy": dy}
        job = _Job(
            lanes=y.shape[2],
            n_b=y.shape[1] - 1,
            data=self.values.shape[2],
            data_tangents=self.tangents.shape[2],
            check=int(self.count % CHECK == 0),
            mechanism=self.library.address,
            feedback=None if self.feedback is None else self.feedback.address,
            **addresses(arrays | {"lam": lam, "scratch": self.scratch, "weights": self.weights}),
        )
        self.count += 1
        run = partial(self.code.rates, ctypes.byref(job))
        failed = run() if self.feedback is None else self.feedback.run(run)
        return None if failed else (dy, lam)


class NativeRightHandSide(RightHandSide):
    """RightHandSide by a library; where its factors cannot be relied on, by operators of torch from then on."""

    def __init__(self, library: Library, dynamics: Dynamics):
        super().__init__(dynamics)
        self.code: CompiledRates | None = CompiledRates(library, dynamics)

    def __call__(self, t: Tensor, y: Tensor) -> Tensor:
        result = self._compiled(t, y)
        if result is None:
            return super().__call__(t, y)
        reach(t)
        self.dynamics.statistics["evaluations"] += 1
        return result[0]

    def accelerations(self, t: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        result = self._compiled(t, y)
        return super().accelerations(t, y) if result is None else (result[0][self.dynamics.topology.n_q :], result[1])

    def _compiled(self, t: Tensor, y: Tensor) -> tuple[Tensor, Tensor] | None:
        # A state may carry the direction of time (of an event) where the data carry none: eager.
        code = self.code if y.shape[1] - 1 <= self.dynamics.tangents else None
        result = None if code is None else code(t, y)
        if result is None:
            self.code = None
        return result
