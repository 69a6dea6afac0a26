"""Failed evaluations of a search: why they failed, how often, and whether they are so many that the result says it first.

Reasons that differ in numbers alone, such as a time or a lane, count as one; the first of them stands for all.
Checked in tests/optimization/test_failures.py.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

MANY = 0.1  # share of the evaluations: with more failures an optimum may have been missed, and the status says it
_NUMBER = re.compile(r"-?\d+(\.\d+)?(e[-+]?\d+)?", re.IGNORECASE)


def counted(reasons: Iterable[tuple[str, int]]) -> dict[str, int]:
    """Add the counts of reasons that differ in numbers alone; the commonest comes first."""
    counts: dict[str, int] = {}
    first: dict[str, str] = {}
    for reason, count in reasons:
        name = first.setdefault(_NUMBER.sub("#", reason), reason)
        counts[name] = counts.get(name, 0) + count
    return dict(sorted(counts.items(), key=lambda pair: -pair[1]))


def are_many(evaluations: int, reasons: Mapping[str, int]) -> bool:
    """Return whether more than a tenth of the evaluations failed."""
    return sum(reasons.values()) > MANY * evaluations


def failures_text(evaluations: int, reasons: Mapping[str, int]) -> str:
    """Return `31 evaluations, none failed`, or `17 of 31 evaluations failed, 14 of them: ...` with the commonest reason."""
    count = sum(reasons.values())
    if not count:
        return f"{evaluations} evaluations, none failed"
    reason, times = max(reasons.items(), key=lambda pair: pair[1])
    share = "all of them" if times == count else f"{times} of them"
    return f"{count} of {evaluations} evaluations failed, {share}: {reason.removeprefix('failed: ')}"
