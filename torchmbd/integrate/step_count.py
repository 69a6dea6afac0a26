"""How many equal steps a motion gets where the caller does not say: by what moves it, not by the highest retained mode.

    first   enough to follow loads and drives as functions of time: straight lines between the steps are off by 1 % (L1 norm);
            at least 200, without flexible bodies 1000
    then    again with as many as the estimate of the error of a step asks for (estimates.py), until it is satisfied
    most    20 per period of the fastest retained mode: every mode is resolved

Modes that nothing excites cost no steps. Laws are sampled at 2048 times: a shorter pulse is not seen before it acts.
Checked in tests/integrate/test_step_count.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchmbd.integrate.estimates import GOOD_STEP
from torchmbd.integrate.ode import fastest_vibration
from torchmbd.integrate.stepper import TURN
from torchmbd.multibody.system import Dynamics, equations
from torchmbd.multibody.system.times_as_lanes import as_lanes
from torchmbd.progress import say

FEWEST, RIGID = 200, 1000  # steps
_LONG = 20_000  # steps that are announced
_MOST_RIGID = 20_000
_SAMPLES = 2048  # of laws of time
_SHARE = 0.01  # of a law that straight lines between the steps may miss
_FINER = 4.0  # steps, of those whose error is GOOD_STEP: errors of many periods add up
_NEAR = 1.5  # times the estimated error that is wanted: not worth another motion
_MORE, _UNKNOWN = 1.1, 4  # steps, of those that the estimate says; where a motion failed, of those that it had
_MOST_MORE = 8  # times the steps of a motion has the next: the estimate of a coarse motion is a rough one


def all_modes(dynamics: Dynamics, duration: float) -> int:
    """Twenty steps per period of the fastest retained mode, at least 200 in all."""
    if "Kr" not in dynamics.data:
        return _MOST_RIGID
    return max(FEWEST, math.ceil(20.0 * duration * fastest_vibration(dynamics) / (2.0 * math.pi)))


def first_steps(dynamics: Dynamics, duration: float) -> int:
    """Enough for loads and drives of the first design; see the module header."""
    least = FEWEST if "Kr" in dynamics.data else RIGID
    with torch.no_grad():
        laws = _laws(dynamics.values().select_lanes([0]), duration)
    for count in (2**k for k in range(6, 12)):
        if all(_followed(f, _SAMPLES // count) for f in laws):
            return max(least, count)
    return max(least, _SAMPLES)


def wanted_steps(steps: int, stats: dict[str, Any], status: Sequence[str], faults: dict[int, str]) -> int:
    """How many steps the lanes of a motion of so many want; lanes that have no start want nothing."""
    wanted = steps
    for lane, reason in enumerate(status):
        if lane in faults:
            continue
        if "steps_for_contacts" in stats:
            wanted = max(wanted, int(stats["steps_for_contacts"][lane]))
        turn, error = (float(stats[name][lane]) for name in ("turn", "step_error"))
        if turn > TURN:
            wanted = max(wanted, math.ceil(_MORE * steps * turn / TURN) if math.isfinite(turn) else _UNKNOWN * steps)
        elif reason.startswith("failed") or not math.isfinite(error):
            wanted = max(wanted, _UNKNOWN * steps)
        elif error > _NEAR * GOOD_STEP / _FINER**2:
            wanted = max(wanted, math.ceil(_MORE * _FINER * float(stats["suggested_steps"][lane])))
    return min(wanted, _MOST_MORE * steps)


def announce(steps: int, lanes: int) -> None:
    """Say that a long motion begins, where it has a bar of its own (progress.py)."""
    if steps >= _LONG:
        say(f"torchmbd: a motion of {steps} steps begins" + (f", of {lanes} designs" if lanes > 1 else ""))


def _followed(f: Tensor, stride: int) -> bool:
    """Whether straight lines between every so many samples [k, samples + 1] are near."""
    if not f.numel() or stride < 1:
        return True
    x = torch.linspace(0.0, 1.0, stride + 1, dtype=f.dtype)[:-1]
    ends = f[:, ::stride]
    lines = (ends[:, :-1, None] * (1.0 - x) + ends[:, 1:, None] * x).flatten(1)
    off = (lines - f[:, :-1]).abs().mean(1)
    size = (f - f.mean(1, keepdim=True)).abs().mean(1)
    return bool((off <= _SHARE * size.max()).all())


def _laws(dynamics: Dynamics, duration: float) -> list[Tensor]:
    """What drives prescribe, and forces at the initial positions, at equal times [k, samples + 1]; kinds apart."""
    T, data = dynamics.topology, dynamics.data
    times = torch.linspace(0.0, duration, _SAMPLES + 1, dtype=torch.float64)
    found = []
    for kind in T.primitives:
        if kind.driven:
            found += [part[..., 0].flatten(1).T for part in kind.prescribed(times, data)]
    if T.actions:
        q, v = (x[..., :1].expand(*x.shape[:-1], len(times)) for x in dynamics.start)
        at = equations.placement(T, data, q, as_lanes(T.schedule(times, data)))
        states = equations.action_states(T, data, at, v)
        found += [f.flatten(0, -2) for f in equations.strengths(T, data, states, at.t) if f.shape[-1] == len(times)]
    return [f for f in found if bool(torch.isfinite(f).all())]
