"""Where histories of a motion are not smooth: between which of its times accelerations and reactions bend or jump.

    contacts    a gap closes or opens: a stop, a plane, a law Gap
    controls    values of a ControlHistory: a linear one bends there, a held one jumps, and a sample there is the mean of both

Differences do not look across these intervals (slopes.py). Kinks of other laws, as of Table or of functions of users, and of
prescribed motions, are not known.
Checked in tests/design/test_kinks.py.
"""

from __future__ import annotations

from typing import Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

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
        _known[motion] = _kinks(motion)
    return _known[motion]


def _kinks(motion: Any) -> list[Tensor] | None:
    times = [(t, kind) for history in _control_histories(motion.dynamics) for t, kind in _control_times(history)]
    if ContactWatch(motion.dynamics, 0).idle and not times:
        return None
    if not has_lane_times(motion):
        return list(_between(motion, times))
    return [_between(lane_motion(motion, lane).motion, times)[0] for lane in range(motion.lanes)]


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


def _control_histories(dynamics: Any) -> list[ControlHistory]:
    """Those of all controllers."""
    topology = dynamics.topology
    modules = [getattr(link.control, "module", None) for link in topology.links.each] if topology.actions else []
    return [m for module in modules if module is not None for m in module.modules() if isinstance(m, ControlHistory)]


def _control_times(history: ControlHistory) -> list[tuple[float, str]]:
    """Times at which the control, or its rate, jumps [s], with the kind of the history."""
    if history.kind == "hold":
        return [(t, "hold") for t in history.jumps]
    count = len(history.values) - 1
    return [(k * history.duration / count, "linear") for k in range(count + 1)]
