"""Reactions that alternate from step to step: numerical errors of multipliers, told where a reaction is asked for.

    d_n = (x_(n-1) - 2 x_n + x_(n+1)) / 4        amplitude: sqrt(-d_n . d_(n+1)) where three d in a row change their sign

Multipliers of generalized-alpha alternate about their values, with an amplitude that is their error, where the acceleration of
a drive jumps within a phase, and where they follow vibrations that the steps do not resolve. Steps at the start and after a
switch begin from states without this error (integrate/smooth_start.py).
Source: Arnold, Bruels and Cardona, Numer. Math. 129 (2015) 149-179.
Checked in tests/results/test_ringing.py.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchmbd.errors import warn
from torchmbd.math.gradients import untransformed

if TYPE_CHECKING:
    from torchmbd.results.motion_data import MotionData

SHARE = 0.05  # of the largest value, as of elastic_limits.py
_EQUAL = 1e-6  # of a step: rounding of times
_ROUNDING = 1e-9  # of the largest multiplier: a reaction that is nothing else


def alternation(x: Tensor) -> Tensor:
    """Amplitude [..., times - 4] of what alternates in vectors x [..., times, 3]; entry n is that of the times n to n + 4."""
    d = 0.25 * (x[..., 2:, :] - 2.0 * x[..., 1:-1, :] + x[..., :-2, :])
    flips = -(d[..., 1:, :] * d[..., :-1, :]).sum(-1)
    return torch.minimum(flips[..., 1:], flips[..., :-1]).clamp_min(0.0).sqrt()


def _four_steps(t: Tensor, step: float) -> Tensor:
    """Return True for each n whose times n to n + 4 are the ends of equal steps of at most this size [times - 4].

    A lane with switches has both states of each at one time; between checkpoints there are steps whose states are not kept.
    """
    intervals = t.diff().unfold(0, 4, 1)
    longest, shortest = intervals.amax(-1), intervals.amin(-1)
    return (longest - shortest <= _EQUAL * longest) & (longest <= (1.0 + _EQUAL) * step)


def warn_of_ringing(motion: MotionData, joint: str, kind: str, x: Tensor) -> None:
    """Warn where more than a twentieth of the largest force or torque of a joint alternates [lanes, times, 3]."""
    x, step = untransformed(x), motion.stats.get("step_size")
    if x.shape[-2] < 5 or step is None:  # adaptive methods
        return
    t = untransformed(motion.t)
    amplitude = torch.where(_four_steps(t, step), alternation(x).nan_to_num(0.0), 0.0)
    for switch in motion.switches:  # values on both sides of a jump are no ringing
        when = untransformed(switch.t)[..., None]
        amplitude = torch.where((t[..., :-4] <= when) & (when <= t[..., 4:]), 0.0, amplitude)
    largest = x.norm(dim=-1).nan_to_num(0.0).amax(-1)
    rounding = _ROUNDING * untransformed(motion.lam).abs().nan_to_num(0.0).amax()
    alternates = (amplitude > SHARE * largest[..., None]) & (largest > rounding)[..., None]
    if not bool(alternates.any()):
        return
    worst = float((amplitude / largest[..., None].clamp_min(torch.finfo(x.dtype).tiny))[alternates].max())
    until = float(t[..., 4:][alternates.flatten(0, -2).any(0)].max())
    warn(  # few different texts: Python shows each once in an optimization
        f"the {kind} of joint {joint!r} alternates from step to step by up to {worst:.1g} of its largest value until "
        f"t = {until:.2g} s. This is an error of the time integration. Try: more steps, a smaller spectral_radius, or a "
        "window that begins later"
    )
