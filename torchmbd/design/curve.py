"""Histories of a motion as curves, and as values at all times at which its lanes have states.

Where lanes have states besides those at the output times (results/lane_motion.py), a history is evaluated lane by lane at all
of them: the two values at a switch, and the small steps of a contact, are samples like others.

Accelerations and reactions bend or jump between some of these times:

    contacts    a gap closes or opens: a stop, a plane, a law Gap
    controls    values of a ControlHistory: a linear one bends there, a held one jumps, and a sample there is the mean of both

Differences do not look across these intervals (slopes.py). Kinks of other laws, such as those of Table or of functions of
users, and of prescribed motions, are not known.
Checked in tests/design/test_kinks.py, tests/design/test_switches.py, tests/integrate/test_contacts.py.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from torchmbd.design.spline import Spline, Window
from torchmbd.integrate import Trajectory
from torchmbd.integrate.contacts import ContactWatch
from torchmbd.multibody.forces.control_history import ControlHistory
from torchmbd.results.lane_motion import has_lane_times, lane_motion

_SAME = 1e-9  # of the duration: times that are equal

# Motion -> its kinks.
_known: WeakKeyDictionary[Any, list[Tensor] | None] = WeakKeyDictionary()


def kinks_of(motion: Any) -> list[Tensor] | None:
    """Intervals [n - 1] in which histories are not smooth, of each lane at all its times; None: there are none.

    They are found once for a motion: all its histories have the same.
    """
    if motion not in _known:
        topology = motion.dynamics.topology
        modules = [getattr(link.control, "module", None) for link in topology.links.each] if topology.actions else []
        controls = [m for module in modules if module is not None for m in module.modules()]
        times = [time for m in controls if isinstance(m, ControlHistory) for time in _control_times(m)]
        if ContactWatch(motion.dynamics, 0).idle and not times:
            _known[motion] = None
        elif has_lane_times(motion):
            lanes = (lane_motion(motion, lane).motion for lane in range(motion.lanes))
            _known[motion] = [_between(alone, times)[0] for alone in lanes]
        else:
            _known[motion] = list(_between(motion, times))
    return _known[motion]


def _between(motion: Any, times: list[tuple[float, str]]) -> Tensor:
    """Intervals with a kink [lanes, n - 1] of a motion that has all states of its lanes."""
    t = motion.t.detach()
    same = _SAME * (t[-1] - t[0])
    kinks = torch.zeros(motion.lanes, len(t) - 1, dtype=torch.bool)
    for time, kind in times:
        ends = same if kind == "hold" else -same  # beside a sample at the jump both intervals have a part of it
        kinks = kinks | (t[:-1] - same <= time) & (time <= t[1:] + ends)
    watch = ContactWatch(motion.dynamics, len(t) - 1)
    if not watch.idle and len(t) > 1:
        q, v = (x.detach().permute(1, 2, 0)[:, :, None] for x in (motion.q, motion.v))
        watch.update(0, t, q, v)
        assert watch.gaps_and_rates is not None
        closed = watch.gaps_and_rates[0] < 0.0  # [gaps, times, lanes]
        kinks = kinks | (closed[:, 1:] != closed[:, :-1]).any(0).T
    return kinks


def _control_times(history: ControlHistory) -> list[tuple[float, str]]:
    """Times at which the control, or its rate, jumps [s], with the kind of the history."""
    if history.kind == "hold":
        return [(t, "hold") for t in history.jumps]
    count = len(history.values) - 1
    return [(k * history.duration / count, "linear") for k in range(count + 1)]


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
