"""Numbers and cards as text of Nastran's large fields: sixteen columns, at least eleven digits.

    0.000125        .000125
    -1.23456789e-7  -1.23456789-7       no E: its column holds another digit

Source: MSC Nastran Quick Reference Guide, section 8 (bulk data format, large field format).
Checked in tests/extensions/nastran/test_field_text.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from torchmbd.errors import InputError

WIDTH = 16
_FIELDS = 4  # of a line


def number_text(x: float) -> str:
    """Return the shortest text of a number with the most digits that a field holds; InputError unless it is finite."""
    if not math.isfinite(x):
        raise InputError("value", x, "a finite number", noun="a field of a card")
    for digits in range(17, 0, -1):
        text = min(_with_point(x, digits), _with_exponent(x, digits), key=len)
        if len(text) <= WIDTH:
            return text
    raise InputError("value", x, "must have an exponent of at most three digits", noun="a field of a card")


def _with_exponent(x: float, digits: int) -> str:
    mantissa, _, exponent = f"{x:.{digits - 1}E}".partition("E")
    whole, _, fraction = mantissa.partition(".")
    return f"{whole}.{fraction.rstrip('0')}{int(exponent):+d}"


def _with_point(x: float, digits: int) -> str:
    size = 0 if x == 0.0 else math.floor(math.log10(abs(x)))
    if not -5 <= size <= 14:
        return _with_exponent(x, digits)
    whole, _, fraction = f"{x:.{max(digits - 1 - size, 0)}f}".partition(".")
    fraction = fraction.rstrip("0")
    sign, whole = ("-", whole[1:]) if whole[0] == "-" else ("", whole)
    return f"{sign}{whole if whole != '0' or not fraction else ''}.{fraction}"


def card_lines(name: str, fields: Sequence[str | int | float]) -> list[str]:
    """Return the lines of a card; texts and whole numbers as they are. Lines of large fields come in pairs."""
    texts = [x if isinstance(x, str) else str(x) if isinstance(x, int) else number_text(x) for x in fields]
    texts += [""] * (-len(texts) % (2 * _FIELDS))
    heads = [f"{name}*", *["*"] * (len(texts) // _FIELDS - 1)]
    rows = (texts[k : k + _FIELDS] for k in range(0, len(texts), _FIELDS))
    return [
        f"{head:<8}{''.join(f'{text:>{WIDTH}}' for text in row)}".rstrip()
        for head, row in zip(heads, rows, strict=True)
    ]
