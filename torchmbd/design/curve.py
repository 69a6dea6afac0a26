"""Histories of a motion as curves, and as values at all times at which its lanes have states.

Where lanes have states besides those at the output times (results/lane_motion.py), a history is evaluated lane by lane at all
of them: the two values at a switch, and the small steps of a contact, are samples like others.
Checked in tests/design/test_switches.py, tests/integrate/test_contacts.py.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torchmbd.design.kinks import kinks_of
from torchmbd.design.spline import Spline, Window
from torchmbd.integrate import Trajectory
from torchmbd.results.lane_motion import has_lane_times, lane_motion

# (motion, its lanes in the batch) -> values [lanes, times], and first and second derivative by time where they are exact
Samples = Callable[[Trajectory, slice], tuple[Tensor, tuple[Tensor, Tensor] | None]]


def curve_of(motion: Trajectory, samples: Samples, window: Window = None) -> Spline:
    """The curve [lanes, times] of a history, on a window (t0, t1) [s] or on the whole motion."""
    if not has_lane_times(motion):
        y, rates = samples(motion, slice(None))
        kinks = None if rates else kinks_of(motion)
        return Spline.of(motion.t, y, window, rates, kinks=None if kinks is None else torch.stack(kinks))
    parts = []
    for lane in range(motion.lanes):
        whole = lane_motion(motion, lane)
        y, rates = samples(whole.motion, slice(lane, lane + 1))
        parts.append((whole.motion.t, whole.begins, y[0], *(x[0] for x in rates or ())))
    most = max(len(part[0]) for part in parts)
    t, begins, y, *rates = (torch.stack([_lengthened(x, most) for x in column]) for column in zip(*parts, strict=True))
    limits = float(motion.t[0].detach()), float(motion.t[-1].detach())
    kinks = None if rates else kinks_of(motion)
    if kinks is not None:
        kinks = torch.stack([torch.nn.functional.pad(x, (0, most - 1 - len(x))) for x in kinks])
    return Spline.of(t, y, window, (rates[0], rates[1]) if rates else None, begins, limits, kinks)


def _lengthened(x: Tensor, count: int) -> Tensor:
    """Numbers [n], followed by the last one up to [count]; of marks by False."""
    last = torch.zeros_like(x[-1:]) if x.dtype == torch.bool else x[-1:]
    return torch.cat([x, last.expand(count - len(x))])


def samples_over_time(history: Any, motion: Trajectory, lane: int) -> tuple[Tensor, Tensor]:
    """Times and values [n] of one lane of a history at all times at which the lane has states, for figures."""
    if not has_lane_times(motion):
        return motion.t, history(motion)[lane]
    alone = lane_motion(motion, lane).motion
    return alone.t, history(alone)[0]
