"""What an optimum is worth: start and best design with the errors of their responses, and whether the gain holds.

    f(finer) = f + e            e: estimated true value minus value, see response_error.py
    gain     = f(start) - f(best), its error e(start) - e(best): errors that both designs share cancel

    verified   |e(start) - e(best)| <= GAIN gain; no constraint beyond its limit by more than LIMIT of its size in the finer
               model; what that depends on is resolved; no other end of the search is better in the finer model

A search of which more than a tenth of the evaluations failed is not called verified: an optimum may have been missed.

Plain data, which commands read from the store without torch.
Made by design/verification.py; checked in tests/design/test_verification.py.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from torchmbd.summary import Summary

GAIN = 0.1  # of the gain: its largest error
LIMIT = 0.01  # of the size of a constraint: the largest violation in the finer model
_ROUNDING = 1e-12  # of a value: an error below it is not told
VERIFIED, NOT_VERIFIED, MANY_FAILURES = "verified", "not verified", "many evaluations failed"  # beginnings of a status


@dataclass(frozen=True)
class Number:
    """A response of a design: its value, the estimated error (true value minus value), why it is not resolved ("": it is)."""

    value: float
    error: float
    reason: str = ""

    @property
    def finer(self) -> float:
        return self.value + self.error

    def __str__(self) -> str:
        text = f"{self.value:.6g}" + (f" ({self.error:+.1g})" if abs(self.error) > _ROUNDING * abs(self.value) else "")
        return f"{text} not resolved" if self.reason else text


@dataclass(frozen=True)
class Answer:
    """A response at the start and at the best design.

    goal    "minimize", "maximize", "at most", "at least", "equal to"; "": told beside what was asked
    words   what it is
    unit    of all numbers; degrees for angles
    limit   of a constraint, at the best design; None: no constraint
    margin  to the limit at the best design, a share of it, negative beyond the limit; None: no constraint
    finer   the margin in the finer model
    active  whether the constraint holds the best design
    """

    goal: str
    words: str
    unit: str
    start: Number
    best: Number
    limit: float | None = None
    margin: float | None = None
    finer: float | None = None
    active: bool = False

    @property
    def heading(self) -> str:
        """`max of ply failure of rod`, `mass of rod [kg]`."""
        return f"{self.words} [{self.unit}]" if self.unit else self.words

    @property
    def margin_text(self) -> str:
        """`12 %`, `0 %, active`, `-3 %, violated`; "" of what is not a constraint."""
        if self.margin is None:
            return ""
        text = f"{100.0 * self.margin:z.2f} %"
        note = "violated" if self.margin < 0.0 and not self.active else "active" if self.active else ""
        return f"{text}, {note}" if note else text


@dataclass(frozen=True, repr=False)
class Verification(Summary):
    """Start and best design with the errors of their responses.

    answers   the objective, every constraint, masses and first frequencies of the bodies that are designed
    change    of the objective from start to best, in percent of its size at the start
    finer     the same in the finer model
    faults    why the best design is not verified; none: it is
    advice    what to do then
    notes     what the estimates are worth
    search    how the search ended, whether the best design is better than the start, how many evaluations failed; "": no search
    failing   how many evaluations failed and why, where more than a tenth did; else ""
    """

    answers: tuple[Answer, ...]
    change: float
    finer: float
    faults: tuple[str, ...]
    advice: str = ""
    notes: tuple[str, ...] = ()
    search: str = ""
    failing: str = ""

    @property
    def verified(self) -> bool:
        """True if gain and constraints hold in the finer model, and at most a tenth of the evaluations failed."""
        return not self.faults and not self.failing

    @property
    def status(self) -> str:
        """`verified: ...`, `not verified: ...` with what to do, or `many evaluations failed: ...`; then what the search did."""
        search = f". Search: {self.search}" if self.search else ""
        if self.faults:
            advice = f". Try: {self.advice}" if self.advice else ""
            return f"{NOT_VERIFIED}: {'; '.join(self.faults)}{advice}{search}"
        change = f"the objective changed by {self.change:z.2f} %, in a finer model by {self.finer:z.2f} %"
        if self.failing:
            return f"{MANY_FAILURES}: {self.failing}; {change}{search}"
        return f"{VERIFIED}: {change}{search}"

    def _summary(self) -> list[tuple[str, Any]]:
        rows = [(f"{row.goal} {row.heading}".strip(), f"{row.start} -> {row.best}") for row in self.answers]
        return [("status", self.status), *rows]

    def to_json(self) -> str:
        """The text that `from_json` reads."""
        return json.dumps(asdict(self), indent=1)

    @classmethod
    def from_json(cls, text: str) -> Verification:
        """The verification of a text of `to_json`."""
        data = json.loads(text)
        answers = [
            Answer(**{**row, "start": Number(**row["start"]), "best": Number(**row["best"])}) for row in data["answers"]
        ]
        tuples: dict[str, Sequence[Any]] = {key: tuple(data[key]) for key in ("faults", "notes")}
        return cls(**{**data, **tuples, "answers": tuple(answers)})
