"""Contacts that the steps of a motion do not show, and the steps that would.

    missed    both ends of a step are apart, but the cubic of gaps and rates at its ends (Hermite) is not in between
    short     bodies touch at fewer than STEPS consecutive times, between times at which they are apart; or they touch at the
              last time, and lose half of their speed in fewer than a third of STEPS, as in a contact of STEPS

`ContactWatch` reads the states of a motion, and then names the first such contact of each lane, with the number of
steps that should stand for one. retries.py makes them, for the whole motion of that lane, so that derivatives are those of
equal steps. A linear spring in contact for STEPS steps gives the speed back to 0.05 %, with an error of the third order in
the step. What changes the speed by less than a thousandth of the motion's largest is not a contact.
Checked in tests/integrate/test_contacts.py.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmbd.math.pair import value
from torchmbd.math.variable import law_key
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equations.times_as_lanes import as_lanes
from torchmbd.multibody.forces.action import Action
from torchmbd.multibody.forces.contact_law import ContactControl
from torchmbd.multibody.forces.laws import Gap, Scaled
from torchmbd.multibody.forces.parametric_law import ParametricLaw
from torchmbd.multibody.system.dynamics import Dynamics

STEPS = 20  # in contact
MOST_SUBSTEPS = 256  # steps for one
_FIRST = 7  # steps in contact before which a linear spring takes less than half of the speed
_MISSED_SUBSTEPS = 4  # steps for one where a contact was missed
_SLOW = 1e-3  # of the largest rate of the gap: slower contacts count as none
_SHALLOW = 1e-3  # of the change of the gap in a step: a cubic that overlaps less touches nothing
_AT_ONCE = 20_000  # times x lanes in one evaluation of the gaps


class UnresolvedContact(NamedTuple):
    """The first contact of a lane that its steps do not show.

    message   the contact, and when it occurs
    substeps  number of steps that should stand for one
    fails     whether the lane has failed: its motion is the one without this contact
    """

    message: str
    substeps: int
    fails: bool


@dataclass(frozen=True)
class _ContactGaps:
    """Gaps of a contact; `inputs`: where its inputs are among s | s' of all actions."""

    control: ContactControl
    inputs: Tensor

    @property
    def labels(self) -> list[str]:
        return self.control.count * [f"{self.control.label} of {self.control.what}"]

    def __call__(self, data: Mapping[str, Tensor], s: Tensor) -> tuple[Tensor, Tensor]:
        """Gaps and rates [gaps, lanes] for s | s' of all actions."""
        p = data[law_key(self.control.name)][:, 0] if self.control.variables is not None else s[:0]
        return self.control.gaps(self.control.numbers(p), s[self.inputs])


@dataclass(frozen=True)
class _LawGap:
    """The gap of a law `Gap` of an action; `inputs`: where its s and s' are among those of all actions."""

    law: Gap
    inputs: tuple[int, int]

    @property
    def labels(self) -> list[str]:
        return [f"contact by Gap(limit={self.law.limit:g}, sign={self.law.sign:g})"]

    def __call__(self, data: Mapping[str, Tensor], s: Tensor) -> tuple[Tensor, Tensor]:
        i, j = self.inputs
        return self.law.sign * (s[i : i + 1] - self.law.limit), self.law.sign * s[j : j + 1]


def _law_gaps(actions: Sequence[Action]) -> list[_LawGap]:
    """The gaps of all laws `Gap`, also of those that are scaled."""
    laws: list[Any] = []
    for action in actions:
        laws += action.laws if len(action.laws) > 1 else len(action.members[0]) * action.laws
    gaps = []
    for i, law in enumerate(laws):
        while isinstance(law, (Scaled, ParametricLaw)):
            law = law.law
        if isinstance(law, Gap):
            gaps.append(_LawGap(law, (i, len(laws) + i)))
    return gaps


class ContactWatch:
    """Gaps and their rates along a motion, of all lanes."""

    def __init__(self, dynamics: Dynamics, steps: int):
        """dynamics: of the whole system;  steps: intervals between times of the motion."""
        self.dynamics, self.steps = dynamics, steps
        actions = dynamics.topology.actions
        links = dynamics.topology.links.each if actions else []
        contacts = [_ContactGaps(x.control, x.read) for x in links if isinstance(x.control, ContactControl)]
        self.gaps = [*contacts, *_law_gaps(actions)]
        self.gaps_and_rates: Tensor | None = None  # so far [2, gaps, times, lanes]; nan where nothing is known yet

    @property
    def idle(self) -> bool:
        """True if the system has no contacts."""
        return not self.gaps

    @torch.no_grad()
    def update(self, first: int, times: Tensor, q: Tensor, v: Tensor, counted: Tensor | None = None) -> None:
        """Note states q, v [times, n, 1, lanes] of the whole system at times [s], the first of number `first`.

        counted   which lanes have these states [times, lanes]; None: all
        """
        size = max(_AT_ONCE // q.shape[-1], 1)
        for start in range(0, len(times), size):
            part = slice(start, start + size)
            new = torch.stack(self._gaps_and_rates(times[part], q[part], v[part]))
            if self.gaps_and_rates is None:
                self.gaps_and_rates = new.new_full((*new.shape[:2], self.steps + 1, new.shape[-1]), torch.nan)
            of_times = self.gaps_and_rates[:, :, first + start : first + start + new.shape[2]]
            of_times.copy_(new if counted is None else torch.where(counted[part], new, of_times))

    def unresolved(self, h: float, by_steps: bool = True) -> dict[int, UnresolvedContact]:
        """The first contact of each lane that states h [s] apart do not show; no entry where they show all.

        by_steps   the states are those of all steps; False: outputs of a method with steps of its own, which may have missed
                   no contact, and are long enough
        """
        if self.gaps_and_rates is None:
            return {}
        gaps, rates = self.gaps_and_rates
        labels = [label for gap in self.gaps for label in gap.labels]
        result: dict[int, UnresolvedContact] = {}
        for lane in range(gaps.shape[-1]):
            contacts = [
                contact
                for k, label in enumerate(labels)
                for contact in _unresolved(label, gaps[k, :, lane], rates[k, :, lane], h, by_steps)
            ]
            if contacts:
                result[lane] = min(contacts, key=lambda contact: contact[0])[1]
        return result

    def _gaps_and_rates(self, times: Tensor, q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """Gaps and their rates [gaps, times, lanes]: times are further lanes of one evaluation."""
        T, lanes, count = self.dynamics.topology, q.shape[-1], len(times)
        plain = {name: value(x).detach() for name, x in self.dynamics.data.items()}
        data = {name: x if x.shape[-1] == 1 else x.repeat(*(1,) * (x.dim() - 1), count) for name, x in plain.items()}
        q, v = (x.movedim(0, -2).flatten(-2) for x in (q, v))
        at = equations.placement(T, data, q, as_lanes(T.schedule(times, plain), lanes))
        states = equations.action_states(T, data, at, v)
        inputs = torch.cat([value(x[k]) for k in range(2) for x in states])[:, 0]
        parts = [gap(data, inputs) for gap in self.gaps]
        gaps, rates = (torch.cat(x).unflatten(-1, (count, lanes)) for x in zip(*parts, strict=True))
        return gaps, rates


Contacts = list[tuple[int, UnresolvedContact]]  # each with the number of the time at which it begins


def _unresolved(label: str, gap: Tensor, rate: Tensor, h: float, by_steps: bool) -> Contacts:
    """The first missed and the first short contacts of a gap [times] of one lane."""
    closed, speed = gap < 0.0, rate.abs()
    faster_end = torch.maximum(speed[:-1], speed[1:])
    counts = faster_end > _SLOW * speed.nan_to_num().max()  # steps in which the contact would change the motion
    contacts = _missed(label, closed, counts & (lowest(gap, rate, h) < -_SHALLOW * h * faster_end), h, by_steps)
    if by_steps:
        contacts += _short(label, closed, counts, h) + _cut_off(label, gap, rate, counts, h)
    return contacts


def _missed(label: str, closed: Tensor, overlaps: Tensor, h: float, by_steps: bool) -> Contacts:
    """The first step in which the bodies touch, but at neither end."""
    for i in torch.nonzero(~closed[:-1] & ~closed[1:] & overlaps)[:1, 0].tolist():
        fault = (
            f"is passed over by a step of {h:.3g} s"
            if by_steps
            else "is not seen in its outputs: more steps may show it"
        )
        message = f"{label} between t = {i * h:.6g} s and {(i + 1) * h:.6g} s {fault}"
        return [(i, UnresolvedContact(message, _MISSED_SUBSTEPS, by_steps))]
    return []


def _short(label: str, closed: Tensor, counts: Tensor, h: float) -> Contacts:
    """The first contact of fewer than STEPS steps between times at which the bodies are apart."""
    last_open = torch.where(closed, -1, torch.arange(len(closed))).cummax(0).values
    ends = torch.nonzero(closed[:-1] & ~closed[1:])[:, 0]
    begins = last_open[ends]
    length = ends - begins
    short = (begins >= 0) & (length < STEPS) & (counts[begins.clamp_min(0)] | counts[ends])
    for i, n in zip(begins[short][:1].tolist(), length[short][:1].tolist(), strict=True):
        message = f"{label} from t = {i * h:.6g} s on lasts {n} steps of {h:.3g} s: must last {STEPS} steps or more"
        return [(i, UnresolvedContact(message, 2 ** math.ceil(math.log2(STEPS / n)), False))]
    return []


def _cut_off(label: str, gap: Tensor, rate: Tensor, counts: Tensor, h: float) -> Contacts:
    """A contact that the end of the motion cuts off, and that slows down in too few steps."""
    is_open = torch.nonzero(gap >= 0.0)[:, 0]
    n = len(gap) - 1 - int(is_open[-1]) if len(is_open) else 0
    if not 0 < n < _FIRST:
        return []
    i = int(is_open[-1])
    closing = torch.stack([rate[i], rate[i + 1], (gap[i + 1] - gap[i]) / h]).min()
    if not bool(counts[i] & (rate[-1] > 0.5 * closing)):
        return []
    message = f"{label} from t = {i * h:.6g} s on stops within {n} steps of {h:.3g} s: must last {STEPS} steps"
    return [(i, UnresolvedContact(message, 2 ** math.ceil(math.log2(STEPS / 3.0 / n)), False))]


def lowest(gap: Tensor, rate: Tensor, h: float) -> Tensor:
    """Least value of the Hermite cubics between consecutive times, of gaps and rates [times] -> [times - 1]."""
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
