"""Steps that do not resolve the vibrations of rigid bodies on springs.

    share = sum |d_n| / sum |a_n|,   d_n = (a_(n-1) - 2 a_n + a_(n+1)) / 4   norms: integrate/estimates.py

A vibration of phi radians in a step has the share sin^2(phi / 2): `ALTERNATION`, 0.3, is that of five steps to a period. The
share counts vibrations by their size, so those that nothing excites count as none. A lane with a larger share is
unresolved if the motion, linearized where its accelerations alternate most, has a vibration of less than _STEPS steps to a
period. Loads that change from step to step, and accelerations that jump, have large shares without such a vibration.

The estimates of the steps do it for flexible bodies and for beams; steps that `simulate` chooses have smaller shares
(integrate/step_count.py).
Checked in tests/diagnosis/test_rigid_vibrations.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchmbd.errors import DesignFailure
from torchmbd.integrate.estimates import rigid_alternations
from torchmbd.integrate.lane_status import ALTERNATION, UNRESOLVED, warn_unresolved
from torchmbd.multibody.equilibrium.linearized import Linearization, Vibrations
from torchmbd.results.lane_motion import lane_motion
from torchmbd.results.motion_data import OK
from torchmbd.results.time_rows import IntegratedSignals, StepStates
from torchmbd.results.trajectory import Trajectory

_STEPS = 7.0  # to a period: the stiffness changes along a motion, and 5 steps have the limit of the share
_GOOD = 40.0  # steps to a period whose phase is 1 % off after five periods
_EQUAL = 1e-6  # of a step: rounding of times


def mark_vibrations(motion: Trajectory) -> None:
    """Set the status of lanes of a motion of values whose equal steps do not resolve the vibrations of rigid bodies."""
    T, h = motion.dynamics.topology, motion.stats.get("step_size")
    if h is None or T.flexible or T.has_fast_elements or not T.actions or len(motion.t) - 1 != motion.stats["steps"]:
        return
    lanes, halved = [k for k, status in enumerate(motion.status) if status == OK], motion.stats.get("halved", ())
    if len(lanes) > len(halved):
        _mark(motion, motion, [(k, k) for k in lanes if k not in halved])
    if halved:
        whole = _with_all_steps(motion)
        for lane in (k for k in lanes if k in halved):
            _mark(motion, lane_motion(whole, lane).motion, [(lane, 0)])
    warn_unresolved([motion.status[lane] for lane in lanes])


def _with_all_steps(motion: Trajectory) -> Trajectory:
    """The motion with the states at the smaller steps of its lanes."""
    signals = motion.signals
    assert isinstance(signals, IntegratedSignals)
    assert signals.integration is not None
    states = signals.integration.history.at_steps()
    if not states:
        return motion
    q, v, vd, lam, *rest = states
    at_steps = StepStates(*(x[:, :, :1] for x in (q, v, vd, lam)), *rest)
    known = signals.history, signals.integration, signals.data, signals.valid_times
    return replace(motion, signals=IntegratedSignals(*known, at_steps))


def _mark(motion: Trajectory, part: Trajectory, lanes: Sequence[tuple[int, int]]) -> None:
    """Set the status of lanes of a motion by a part of it that has all their states; lanes of both."""
    change, size = alternations(part)
    share = change.sum(1) / size.sum(1).clamp_min(torch.finfo(size.dtype).tiny)
    for lane, k in lanes:
        if float(share[k]) > ALTERNATION:
            middle = 1 + int(change[k].argmax())
            f, h = _largest_frequency(motion, lane, part, k, middle), float(part.t[middle + 1] - part.t[middle])
            if f * h * _STEPS > 1.0:
                needed = math.ceil(round(_GOOD * f * float(part.t[-1]), 6))
                motion.status[lane] = (
                    f"{UNRESOLVED}the steps do not resolve a vibration of {f:.3g} Hz: a period has {1.0 / (f * h):.2g} steps. "
                    f"Try: steps={needed}, which are {_GOOD:g} for each period"
                )


def alternations(motion: Trajectory) -> tuple[Tensor, Tensor]:
    """|d_n| and |a_n| at the inner times [lanes, times - 2] [kg^1/2 m/s2], zero beside switches; |d_n| is zero where it is
    rounding.
    """
    t, n = motion.t, motion.dynamics.topology.bodies
    change, size = rigid_alternations(
        motion.dynamics, motion.a, motion.q[..., : 3 * n].abs().amax(), motion.stats["step_size"]
    )
    h = t[2:] - t[1:-1]
    inner = (((t[1:-1] - t[:-2]) - h).abs() <= _EQUAL * h).expand_as(change).clone()
    for switch in motion.switches:
        inner &= (switch.t[:, None] < t[:-2]) | (t[2:] < switch.t[:, None])
    return torch.where(inner, change, 0.0), torch.where(inner, size, 0.0)


def _largest_frequency(motion: Trajectory, lane: int, part: Trajectory, k: int, time: int) -> float:
    """The largest frequency of small vibrations about the state of a lane at a time of its part [Hz]; 0: there are none."""
    dynamics, t = part.dynamics.values().select_lanes([k]), part.t[time]
    if motion.switches:  # joints that are released and locks that do not act have no part in them
        assert isinstance(motion.signals, IntegratedSignals)
        assert motion.signals.integration is not None
        rows = motion.signals.integration.rows_at(lane, float(t))
        dynamics = replace(dynamics, topology=dynamics.topology.selected(rows))
    try:
        vibrations = Vibrations.of(Linearization.of(dynamics, part.q[k, time], t, released=True))
    except DesignFailure:  # a part without inertia is free to move: frequencies are infinite
        return 0.0
    frequencies = vibrations.frequencies
    return float(frequencies[frequencies.isfinite()].amax()) if bool(frequencies.isfinite().any()) else 0.0
