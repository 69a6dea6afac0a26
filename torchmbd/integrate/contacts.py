"""Contacts located in time: those that fixed steps pass over, and those of too few steps.

    missed    both ends of a step are apart, but the cubic of gaps and rates at its ends (Hermite) is not in between
    short     bodies touch at fewer than STEPS consecutive times, between times at which they are apart; or they touch at the
              last time, and lose half of their speed in fewer than a third of STEPS, as in a contact of STEPS

The first of either says how many steps would stand for one; attempts.py makes them, for the whole motion of that lane, so
that derivatives are those of equal steps. A linear spring in contact for STEPS steps gives the speed back to 0.05 %, with an
error of the third order in the step. What changes the speed by less than a thousandth of the motion's largest is no contact.
Checked in tests/integrate/test_contacts.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmbd.math.pair import value
from torchmbd.math.variable import law_key
from torchmbd.multibody.forces.contact_law import ContactControl
from torchmbd.multibody.system import equations
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.multibody.system.times_as_lanes import as_lanes

STEPS = 20  # in contact
MOST = 256  # steps for one
_FIRST = 7  # of these, before which a linear spring takes less than half of the speed
_PASSED = 4  # steps for one where a contact was passed over
_SLOW = 1e-3  # of the largest rate of the gap: slower contacts count as none
_SHALLOW = 1e-3  # of what the gap changes in a step: a cubic that overlaps less touches nothing
_AT_ONCE = 20_000  # times of lanes


class Doubt(NamedTuple):
    """The first contact of a lane that its steps do not show.

    text    which it is, and when
    steps   that should stand for one
    fails   whether the motion is another one than without it
    """

    text: str
    steps: int
    fails: bool


@dataclass(frozen=True)
class _Gap:
    """A gap of a control: its number there, and where the inputs are among s | s' of all actions."""

    control: ContactControl
    read: Tensor


class ContactWatch:
    """Sees the states of a motion in order, all lanes; says what its steps do not show."""

    def __init__(self, whole: Dynamics):
        self.dynamics = whole
        links = whole.topology.links.each if whole.topology.actions else []
        self.gaps = [_Gap(x.control, x.read) for x in links if isinstance(x.control, ContactControl)]
        self.seen: list[tuple[Tensor, Tensor]] = []

    @property
    def idle(self) -> bool:
        """Whether there is no contact to look at."""
        return not self.gaps

    @torch.no_grad()
    def see(self, times: Tensor, q: Tensor, v: Tensor) -> None:
        """Go on with states q, v [times, n, 1, lanes] of the whole system; the first was the last before."""
        lanes = q.shape[-1]
        size = max(_AT_ONCE // lanes, 1)
        for start in range(min(len(self.seen), 1), len(times), size):
            some = slice(start, start + size)
            self.seen.append(self._looked(times[some], q[some], v[some]))

    def doubts(self, h: float, equal: bool = True) -> dict[int, Doubt]:
        """The first of each lane, of times h [s] apart; equal: whether these are the steps, or outputs between others."""
        if not self.seen:
            return {}
        gaps, rates = (torch.cat(x, 1) for x in zip(*self.seen, strict=True))  # [gaps, times, lanes]
        labels = [f"{gap.control.label} of {gap.control.what}" for gap in self.gaps for _ in range(gap.control.count)]
        found: dict[int, Doubt] = {}
        for lane in range(gaps.shape[-1]):
            first = min(
                (
                    x
                    for k, label in enumerate(labels)
                    for x in _doubts(label, gaps[k, :, lane], rates[k, :, lane], h, equal)
                ),
                key=lambda x: x[0],
                default=None,
            )
            if first is not None:
                found[lane] = first[1]
        return found

    def _looked(self, times: Tensor, q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """Gaps and their rates [gaps, times, lanes]."""
        T, lanes, count = self.dynamics.topology, q.shape[-1], len(times)

        def tiled(x: Any) -> Tensor:
            x = value(x).detach()
            return x if x.shape[-1] == 1 else x.repeat(*(1,) * (x.dim() - 1), count)

        plain = {name: value(x).detach() for name, x in self.dynamics.data.items()}
        known = as_lanes(T.schedule(times, plain), lanes)
        data = {name: tiled(x) for name, x in plain.items()}
        q, v = (x.movedim(0, -2).flatten(-2) for x in (q, v))
        at = equations.placement(T, data, q, known)
        states = equations.action_states(T, data, at, v)
        both = torch.cat([value(x[k]) for k in range(2) for x in states])[:, 0]
        found = []
        for gap in self.gaps:
            p = data[law_key(gap.control.name)][:, 0] if gap.control.variables is not None else both[:0]
            found.append(gap.control.gaps(gap.control.numbers(p), both[gap.read]))
        return tuple(torch.cat(x).unflatten(-1, (count, lanes)) for x in zip(*found, strict=True))  # pyright: ignore[reportReturnType]


def _doubts(label: str, gap: Tensor, rate: Tensor, h: float, equal: bool) -> list[tuple[int, Doubt]]:
    """First missed and first short contact of a gap [times], with the numbers of their times."""
    closed, speed = gap < 0.0, rate.abs()
    pair = torch.maximum(speed[:-1], speed[1:])
    felt = pair > _SLOW * speed.nan_to_num().max()
    missed = ~closed[:-1] & ~closed[1:] & felt & (lowest(gap, rate, h) < -_SHALLOW * h * pair)
    found = []
    for i in torch.nonzero(missed)[:1, 0].tolist():
        verb = (
            f"is passed over by a step of {h:.3g} s" if equal else "is not seen in its outputs: more steps may show it"
        )
        text = f"{label} between t = {i * h:.6g} s and {(i + 1) * h:.6g} s {verb}"
        found.append((i, Doubt(text, _PASSED, equal)))
    if equal:
        found += _short(label, closed, felt, h) + _cut(label, gap, rate, felt, h)
    return found


def _cut(label: str, gap: Tensor, rate: Tensor, felt: Tensor, h: float) -> list[tuple[int, Doubt]]:
    """A contact that the end of the motion cuts off, and that slows down in too few steps."""
    is_open = torch.nonzero(gap >= 0.0)[:, 0]
    if not len(is_open) or (n := len(gap) - 1 - int(is_open[-1])) in (0, *range(_FIRST, len(gap))):
        return []
    i = int(is_open[-1])
    before = torch.stack([rate[i], rate[i + 1], (gap[i + 1] - gap[i]) / h]).min()
    if not bool(felt[i] & (rate[-1] > 0.5 * before)):
        return []
    text = f"{label} from t = {i * h:.6g} s on stops within {n} steps of {h:.3g} s; allowed: {STEPS} steps in contact"
    return [(i, Doubt(text, 2 ** math.ceil(math.log2(STEPS / 3.0 / n)), False))]


def _short(label: str, closed: Tensor, felt: Tensor, h: float) -> list[tuple[int, Doubt]]:
    number = torch.arange(len(closed))
    last_open = torch.where(closed, -1, number).cummax(0).values
    ends = torch.nonzero(closed[:-1] & ~closed[1:])[:, 0]
    begins = last_open[ends]
    length = ends - begins
    bad = (begins >= 0) & (length < STEPS) & (felt[begins.clamp_min(0)] | felt[ends])
    found = []
    for i, n in zip(begins[bad][:1].tolist(), length[bad][:1].tolist(), strict=True):
        more = 2 ** math.ceil(math.log2(STEPS / n))
        text = (
            f"{label} from t = {i * h:.6g} s on lasts {n} steps of {h:.3g} s; allowed: {STEPS} steps or more in contact"
        )
        found.append((i, Doubt(text, more, False)))
    return found


def lowest(gap: Tensor, rate: Tensor, h: float) -> Tensor:
    """Least value of the cubics between consecutive times, of gaps and rates [times] -> [times - 1]."""
    a, b, m, n = gap[:-1], gap[1:], h * rate[:-1], h * rate[1:]
    square, cube = 3.0 * (b - a) - 2.0 * m - n, 2.0 * (a - b) + m + n
    # Zeros u of m + 2 square u + 3 cube u^2, the second as m over the other factor: no division by a small cube.
    root = (square * square - 3.0 * cube * m).clamp_min(0.0).sqrt()
    big = -(square + torch.where(square >= 0.0, root, -root))
    least = torch.minimum(a, b)
    for u in (big / (3.0 * cube), m / big):
        u = u.nan_to_num(0.0, 0.0, 0.0).clamp(0.0, 1.0)
        least = torch.minimum(least, a + u * (m + u * (square + u * cube)))
    return least
