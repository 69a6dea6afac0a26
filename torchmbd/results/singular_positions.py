"""Singular positions along a trajectory: times at which the constraints lose rank, and the rows that do.

    s(t) = the singular value of Phi_q, rows of length one, that counts last at the start

A mechanism has the rank of its start almost everywhere; where s comes near zero it gains a degree of freedom for a moment,
its motion may branch, and multipliers grow like 1/s. Minima of s below a threshold count; diagnosis/failures.py tells those of
motions that failed.
Checked in tests/results/test_singular_positions.py: four-bars that fold flat.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchmbd.multibody.saddle.rank import RELATIVE, dominant_rows, jacobians
from torchmbd.results.motion_data import MotionData

NEAR = 2e-2  # of the largest singular value
_SAMPLES, _CLOSE = 1000, 10.0  # states that are looked at first; all are where one of these is within 10 NEAR


@dataclass(frozen=True)
class SingularPosition:
    """A minimum of the last singular value, relative to the largest, of one lane at one time [s]; rows: "joint: row"."""

    lane: int
    t: float
    value: float
    rows: tuple[str, ...]

    def __str__(self) -> str:
        return (
            f"singular position near t = {self.t:.6g} s (lane {self.lane}, singular value {self.value:.1e}): "
            f"{', '.join(self.rows)} depend on each other"
        )


def singular_positions(motion: MotionData) -> list[SingularPosition]:
    """The singular positions that a motion came near to, at its output times."""
    return [position for lane in range(motion.lanes) for position in positions_of_lane(motion, lane)]


def positions_of_lane(motion: MotionData, lane: int) -> list[SingularPosition]:
    """The singular positions of one lane; times at which its numbers are not finite are left out."""
    T = motion.dynamics.topology
    good = torch.isfinite(motion.q[lane]).all(1)
    if not T.rows or not bool(good.any()):
        return []
    q, t = motion.q[lane, good], motion.t[good]
    with torch.no_grad():
        last, J, finite, rank = _last_singular_values(motion, lane, q, t)
        t, low = t[finite], _minima(last, NEAR)
        U = torch.linalg.svd(J[low], full_matrices=False)[0]
    rows = (dominant_rows(T, x[:, rank - 1]) for x in U)
    return [SingularPosition(lane, float(t[i]), float(last[i]), names) for i, names in zip(low, rows, strict=True)]


def may_be_near(motion: MotionData, lane: int) -> bool:
    """True if a lane may come near to a singular position, by some of its states: all of a long motion take seconds."""
    every = -(-len(motion.t) // _SAMPLES)
    if every == 1 or not motion.dynamics.topology.rows:
        return True
    with torch.no_grad():
        last, *_ = _last_singular_values(motion, lane, motion.q[lane, ::every], motion.t[::every])
    return bool((last < _CLOSE * NEAR).any())


def _last_singular_values(motion: MotionData, lane: int, q: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor, int]:
    """s [n] and Phi_q [n, rows, n_v] of the states of a lane whose constraints are finite, a mask of these, and the rank."""
    dynamics = motion.dynamics.values()
    J = jacobians(dynamics.select_lanes([lane if dynamics.lanes > 1 else 0]), q, t)
    J[:, list(dynamics.rank.left_out)] = 0.0
    finite = torch.isfinite(J).all(2).all(1)
    J = J[finite]
    s = torch.linalg.svdvals(J)
    rank = int((s > RELATIVE * s[:, :1]).sum(1).max())
    return s[:, rank - 1] / s[:, 0], J, finite, rank


def _minima(x: Tensor, below: float) -> list[int]:
    """Where x [n] is less than its neighbors and a threshold."""
    padded = torch.cat([x[:1] + 1.0, x, x[-1:] + 1.0])
    low = (x <= padded[:-2]) & (x < padded[2:]) & (x < below)
    return torch.nonzero(low)[:, 0].tolist()
