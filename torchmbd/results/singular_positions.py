"""Singular positions along a trajectory: times at which the constraints lose rank, and the rows that do.

    s(t) = the singular value of Phi_q, rows of length one, that counts last at the start

A mechanism has the rank of its start almost everywhere; where s comes near zero it gains a degree of freedom for a moment,
its motion may branch, and multipliers grow like 1/s. Minima of s below a threshold are reported: in the status of a lane that
failed, as a warning for a lane that failed before it was integrated again (integrate/retries.py).
So are laws of forces by which a motion failed, those that are not finite just after its last finite state:

    f(s, s', t + h),  f(s + h s', s', t + h)        at the last time t at which the motion is finite, h the output interval

Checked in tests/results/test_singular_positions.py: four-bars that fold flat; tests/multibody/forces/test_laws.py.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import torch
from torch import Tensor

from torchmbd.errors import warn
from torchmbd.math.pair import value
from torchmbd.multibody.equations import equations
from torchmbd.multibody.forces.feedback import Port
from torchmbd.multibody.joints.joint import AttachmentTable
from torchmbd.multibody.saddle.rank import RELATIVE, dominant_rows, jacobians
from torchmbd.results.motion_data import MotionData, has_failed


def action_names(motion: MotionData) -> dict[tuple[type, int], str]:
    """Name of the force element of each action: (kind, number among its kind) -> name."""
    count, names = Counter(), {}
    for force in motion.system.forces:
        for action in force.actions(AttachmentTable()):
            names[action.kind, count[action.kind]] = force.name
            count[action.kind] += 1
    return names


def laws_at_fault(motion: MotionData, lane: int) -> list[str]:
    """Messages on the laws that are not finite just after the last finite state of a lane; [] if all are."""
    T = motion.dynamics.topology
    good = torch.isfinite(motion.q[lane]).all(1) & torch.isfinite(motion.v[lane]).all(1)
    ended = torch.nonzero(~good)
    if not T.actions or not len(ended) or int(ended[0]) == 0:
        return []
    i = int(ended[0]) - 1
    t, h = motion.t[i + 1], motion.t[i + 1] - motion.t[i]
    dynamics = motion.dynamics.values().select_lanes([lane if motion.dynamics.lanes > 1 else 0])
    data = {name: value(x) for name, x in dynamics.data.items()}
    q, v = (x[lane, i][:, None, None] for x in (motion.q, motion.v))
    at = equations.placement(T, data, q, T.prescribed(t, data))
    names, faults = action_names(motion), []
    states = equations.action_states(T, data, at, v)
    ahead = [(s + h * rate, rate, direction) for s, rate, direction in states]
    both = zip(*(equations.strengths(T, data, at_states, t) for at_states in (states, ahead)), strict=True)
    for action, (s, rate, _), forces in zip(T.actions, states, both, strict=True):
        finite = [f.flatten(1).isfinite().all(1) for f in forces]
        for k in torch.nonzero(~(finite[0] & finite[1]))[:, 0].tolist():
            law = action.laws[k]
            if isinstance(law, Port):
                faults.append(f"the {law.control.label} is not finite near t = {float(t):.6g} s")
                continue
            faults.append(
                f"the law of {names[type(action), k]!r} is not finite near s = {float(s[k]):.6g}, "
                f"s' = {float(rate[k]):.6g}, t = {float(t):.6g} s"
            )
    return list(dict.fromkeys(faults))


_MANY = 3  # further corrections of a step, each with a new matrix: elsewhere one is mostly enough

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


def _may_be_near(motion: MotionData, lane: int) -> bool:
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


def report_singular_positions(motion: MotionData) -> None:
    """Add singular positions, and laws of forces that are not finite, to the status of lanes that failed.

    Of lanes that succeeded when they were integrated again, or in which a step took many corrections, they are a warning.
    """
    failed_first, further = motion.stats.get("failed_first", ()), motion.stats.get("further_corrections")
    for lane, status in enumerate(motion.status):
        if has_failed(status):
            near = positions_of_lane(motion, lane)[:1]  # after the first the motion means little
            motion.status[lane] = "; ".join([status, *laws_at_fault(motion, lane), *map(str, near)])
        elif lane in failed_first or (further is not None and float(further[lane]) >= _MANY):
            for near in positions_of_lane(motion, lane) if _may_be_near(motion, lane) else ():
                warn(f"{near}; from there the motion may go on in several ways")
