"""One card of Nastran's bulk data: its name, its data fields, and the line where it stands.

Data fields are counted from 1 after the name, eight to a line, as they stand in the manual's pictures without their first and
last columns.
Source: MSC Nastran Quick Reference Guide, section 8 (bulk data format).
Checked in tests/extensions/nastran/test_cards.py.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection
from dataclasses import dataclass

from torchmbd.errors import InputError, wrong_entry

_EXPONENT = re.compile(r"([0-9.])([+-][0-9]+)$")
_REAL = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)(E[+-]?[0-9]+)?")
_INTEGER = re.compile(r"[+-]?[0-9]{1,18}")


@dataclass(frozen=True)
class Card:
    """One card; `fields` are the data fields in order, without names and continuation marks."""

    name: str
    fields: tuple[str, ...]
    where: str

    def __str__(self) -> str:
        number = self.fields[0] if self.fields else ""
        return f"{self.name} {number} ({self.where})"

    def text(self, position: int) -> str:
        """Data field `position`, counted from 1 after the name, "" where blank or missing."""
        return self.fields[position - 1] if position <= len(self.fields) else ""

    def real(self, position: int, name: str, default: float | None = None) -> float:
        """Read a number; 1.5+3 and 1.5D3 are 1500. InputError names card, line and field."""
        text = self.text(position)
        if not text and default is not None:
            return default
        plain = _EXPONENT.sub(r"\1E\2", text.upper().replace("D", "E"))
        if not _REAL.fullmatch(plain) or not math.isfinite(value := float(plain)):
            raise InputError((str(self), name), text, "a number", noun=f"{self}: {name}")
        return value

    def integer(self, position: int, name: str, default: int | None = None) -> int:
        """Read an integer. InputError names card, line and field."""
        text = self.text(position)
        if not text and default is not None:
            return default
        if not _INTEGER.fullmatch(text):
            raise InputError((str(self), name), text, "an integer", noun=f"{self}: {name}")
        return int(text)

    def integers(self, start: int, known: Collection[int]) -> list[int]:
        """Read the list of integers from `start` on; `1 THRU 9 BY 2` is a range, of which only `known` numbers count."""
        result: list[int] = []
        words = [word for word in self.fields[start - 1 :] if word]
        k = 0
        while k < len(words):
            if words[k].upper() == "THRU":
                if not result or k + 1 >= len(words):
                    raise wrong_entry(self, "THRU stands without its two ends", key="THRU")
                end = _integer(self, words[k + 1])
                by, k = 1, k + 2
                if k + 1 < len(words) and words[k].upper() == "BY":
                    by, k = _integer(self, words[k + 1]), k + 2
                if by < 1:
                    raise InputError((str(self), "BY"), by, "1 or more", noun=f"{self}: BY", shown=f"{by}")
                inside = range(result[-1] + by, end + 1, by)
                smaller, other = (inside, known) if len(inside) < len(known) else (known, inside)
                result.extend(sorted(x for x in smaller if x in other))
            else:
                result.append(_integer(self, words[k]))
                k += 1
        return result


def _integer(card: Card, word: str) -> int:
    if not _INTEGER.fullmatch(word):
        raise wrong_entry(card, f"{word!r} stands in a list of numbers", "an integer or THRU")
    return int(word)
