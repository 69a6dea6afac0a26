"""Where a function of time jumps, by samples of it.

A difference of two samples that stays while its interval is halved again and again is a jump; what a slope explains is not
part of it, as the differences beside it are taken off. A function that oscillates between the samples has larger differences
within an interval; these fall with the interval at the last halvings, and those of a jump stay.
Checked in tests/diagnosis/test_jumps.py.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import torch
from torch import Tensor

_SAME = 1e-9  # of the duration: times that are equal
_SAMPLES = 512  # of a law: two jumps back within one interval are not seen
_LEAST = 1e-3  # of the range of a law: a smaller jump is not seen
_HALVINGS = 12  # of an interval, to 5e-7 of the duration: what is as steep there is a jump for any steps
_LAST = 4  # halvings, in which a slope falls to a sixteenth
_BISECTIONS = 40  # to the rounding of time


def jump_times(f: Callable[[Tensor], Tensor], duration: float, without: Sequence[float] = ()) -> list[float]:
    """Times at which a function of time [] -> [k] jumps, within the duration [s]; `without`: times that are passed over.

    What it raises is raised. Where it is not finite, or not of one shape, there are none: the motion reports that.
    """
    return distinct(_located(f, duration, without), duration)


def _located(f: Callable[[Tensor], Tensor], duration: float, without: Sequence[float]) -> list[float]:
    times = torch.linspace(0.0, duration, _SAMPLES + 1, dtype=torch.float64)
    y = _values(f, times)
    if not bool(torch.isfinite(y).all()):
        return []
    change = y.diff(dim=0)
    beside = torch.cat([change[1:2], change, change[-2:-1]])
    bend = change - 0.5 * (beside[:-2] + beside[2:])  # what a slope does not explain
    at, part = torch.nonzero(bend.abs() > _LEAST * (y.amax(0) - y.amin(0)), as_tuple=True)
    shifted = [int(t / duration * _SAMPLES + shift) for t in without for shift in (-_SAME, _SAME)]
    known = torch.tensor(shifted, dtype=torch.long)
    at, part = (x[~torch.isin(at, known)] for x in (at, part))
    jump, begin, end = bend[at, part], times[at], times[at + 1]
    before, after = y[at, part], y[at + 1, part]
    least = 0.5 * jump.abs()
    for k in range(_BISECTIONS):
        if not len(part):
            return []
        middle = 0.5 * (begin + end)
        value = _values(f, middle).gather(1, part[:, None])[:, 0]
        first = (value - before) * jump.sign() > (after - value) * jump.sign()
        begin, end = torch.where(first, begin, middle), torch.where(first, middle, end)
        before, after = torch.where(first, before, value), torch.where(first, value, after)
        change = (after - before) * jump.sign()
        if k < _HALVINGS:
            stays = change > least
            change, least = change[stays], least[stays]
            part, jump, begin, end, before, after = (x[stays] for x in (part, jump, begin, end, before, after))
        if k == _HALVINGS - 1 - _LAST:
            least = least.maximum(0.5 * change)
    return end.tolist()


def _values(f: Callable[[Tensor], Tensor], times: Tensor) -> Tensor:
    """f [n, k] at times [n]: at once, or one by one where it has branches in Python; nan where its shape changes with time."""
    try:
        return torch.func.vmap(f)(times)
    except Exception:  # a function of users may raise any error; that of one time says which
        values = [f(t) for t in times]
    same_shape = len({y.shape for y in values}) == 1
    return torch.stack(values) if same_shape else torch.full((len(times), 1), torch.nan, dtype=torch.float64)


def distinct(times: Iterable[float], duration: float) -> list[float]:
    """Times within a duration, ascending, without those that are equal."""
    result: list[float] = []
    for t in sorted(times):
        if _SAME * duration < t - (result[-1] if result else 0.0) and t < duration * (1.0 - _SAME):
            result.append(t)
    return result
