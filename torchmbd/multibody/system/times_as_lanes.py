"""Prescribed quantities of several times in one object whose lanes are the times, so that a whole motion is evaluated at once.

For systems without prescribed bodies.
Checked in tests/physics/test_energies.py, tests/results/test_reaction.py, tests/multibody/system/test_condensation.py.
"""

from __future__ import annotations

from typing import Any

import torch

from torchmbd.math.pair import Pair
from torchmbd.multibody.system.topology import Prescribed


def as_lanes(schedule: list[Prescribed], lanes: int = 1, lanes_first: bool = False) -> Prescribed:
    """Prescribed quantities of all times of a schedule for so many lanes: laws [..., times x lanes], or [..., lanes x times] if
    lanes_first, and t [times]."""
    laws = [
        None if kind[0] is None else tuple(_stack_times(part, lanes, lanes_first) for part in zip(*kind, strict=True))
        for kind in zip(*(prescribed.laws for prescribed in schedule), strict=True)
    ]
    return schedule[0]._replace(laws=laws, t=torch.stack([prescribed.t for prescribed in schedule]))


def _stack_times(parts: tuple[Any, ...], lanes: int, lanes_first: bool) -> Any:
    full = [x.full if isinstance(x, Pair) else x for x in parts]
    wide = [x.expand(*x.shape[:-1], lanes) for x in full]
    stacked = torch.stack(wide, -1 if lanes_first else -2).flatten(-2)
    return Pair(stacked) if isinstance(parts[0], Pair) else stacked
