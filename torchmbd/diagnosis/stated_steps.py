"""The number of steps that the status of a motion advises, so that other advice names the same one.

Statuses that know a number end with `Try: 319 steps` (integrate/lane_status.py) or `Try: steps=319, ...` (rigid_vibrations.py).
Checked in tests/diagnosis/test_stated_steps.py.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

_STATED = re.compile(r"Try: (?:steps=(\d+)|(\d+) steps\b)")


def stated_steps(texts: Iterable[str]) -> int | None:
    """Return the largest number of steps that statuses, or texts around them, advise; None: they advise none."""
    numbers = [int(a or b) for text in texts for a, b in _STATED.findall(text)]
    return max(numbers, default=None)
