"""Flows of the index-1 equations by torchdiffeq; motion and sensitivities in one augmented state.

    y = [z, dz/db_1, ..., dz/db_n]          y' = [f(t, z), (df/dz) dz/db_k + df/db_k]

Direct differentiation, eqs. (30)-(33) of the paper: tangents are taken *inside* the right-hand side, never through the
solver (adaptive methods of torchdiffeq raise under torch.func.jvp). Step control sees motion and sensitivities together.
Reverse mode needs nothing here: `torchdiffeq.odeint(dynamics, ...)` and backward() work as they are.
Checked in tests/integrate/, tests/sensitivity/.
"""

from __future__ import annotations

import math
from typing import Any

import torch
import torchdiffeq
from torch import Tensor

from torchmbd.math.pair import Pair, value
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.progress import reach

FIXED = {"euler", "midpoint", "heun2", "heun3", "rk4", "explicit_adams", "implicit_adams", "fixed_adams"}
ADAPTIVE = {"dopri8", "dopri5", "bosh3", "fehlberg2", "adaptive_heun"}
# torchdiffeq's own order of explicit_adams, 12, leaves no stability: at 50 steps, y' = -y ends 35 % off.
DEFAULTS: dict[str, dict[str, Any]] = {"explicit_adams": {"max_order": 5}}
FIRST_STEP = 0.01  # of 1 / omega; the steps grow tenfold at most from one to the next
METHODS = tuple(sorted(FIXED | ADAPTIVE))


class RightHandSide:
    """dy/dt of augmented states, and accelerations, by operators of torch."""

    def __init__(self, dynamics: Dynamics):
        self.dynamics = dynamics

    def __call__(self, t: Tensor, y: Tensor) -> Tensor:
        """dy/dt [n_z, 1 + n_b, lanes] at time t."""
        reach(t)
        return augment(self.dynamics.rates(t, Pair(y) if y.shape[1] > 1 else y), self.dynamics)

    def accelerations(self, t: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Accelerations [n_v, 1 + n_b, lanes] and multipliers [rows, ...]."""
        n, z = self.dynamics.topology.n_q, Pair(y) if y.shape[1] > 1 else y
        a, lam = self.dynamics.accelerations(t, z[:n], z[n:])
        return augment(a, self.dynamics), augment(lam, self.dynamics)


def augment(x: Any, dynamics: Dynamics) -> Tensor:
    """Value and tangents, concatenated [n, 1 + n_b, lanes]."""
    full = x.full if isinstance(x, Pair) else torch.cat([x, x.new_zeros(x.shape[0], dynamics.tangents, x.shape[2])], 1)
    return full.expand(-1, -1, dynamics.lanes)


def first_step(dynamics: Dynamics) -> dict[str, float]:
    """A first step [s] of adaptive methods that the fastest vibration bears; nothing for rigid bodies.

    torchdiffeq judges it from the slopes at the start, where bodies at rest do not vibrate yet. dopri8 may overflow in it.
    """
    fastest = fastest_vibration(dynamics)
    return {"first_step": FIRST_STEP / fastest} if 0.0 < fastest < math.inf else {}


def fastest_vibration(dynamics: Dynamics) -> float:
    """Largest circular frequency [rad/s] of the retained modes of all bodies and designs; 0 for rigid bodies."""
    if "Kr" not in dynamics.data:
        return 0.0
    Kr = value(dynamics.data["Kr"])[:, :, :, 0].permute(2, 3, 0, 1)  # bodies, lanes
    return float(torch.linalg.eigvalsh(Kr.detach()).max().clamp_min(0.0)) ** 0.5


def flow(f: RightHandSide, y0: Tensor, times: Tensor, arguments: dict[str, Any]) -> Tensor:
    """The augmented state [times, n_z, 1 + n_b, lanes] at times [n] from y0 at the first.

    arguments   of torchdiffeq.odeint
    """
    try:
        return torchdiffeq.odeint(f, y0, times, **arguments)  # pyright: ignore[reportReturnType]
    except AssertionError as error:  # torchdiffeq's way to say that dt underflows or that the state is not finite
        raise FloatingPointError(f"{arguments['method']}: {error}") from error
