"""Texts with accidents, for readers: each must make an InputError that names the file, or a result."""

from __future__ import annotations

import random
import re

ALPHABET = "0123456789.,+-*$' <>/\"\\ABEGijl:[]{}\t\x00é"
WORDS = ("", "0", "-1", "0.", "1e999", "NaN", "999999999999", "-7.", "x", "1e-320", "THRU", "3.5", "[]", "{}", "null")
_NUMBER = re.compile(r"[-+]?[0-9]+[0-9.eE+-]*")


def spoilt(text: str, seed: int) -> bytes:
    """One to four accidents: characters, numbers, words or lines that are changed, lost, twice, out of turn or cut off."""
    draw = random.Random(seed)
    for _ in range(draw.randint(1, 4)):
        lines = text.splitlines() or [""]
        k, place = draw.randrange(len(lines)), draw.randrange(len(text) + 1)
        kind = draw.randrange(9)
        if kind == 0:
            text = text[:place] + draw.choice(ALPHABET) + text[place + 1 :]
        elif kind == 1 and (result := list(_NUMBER.finditer(text))):
            number = draw.choice(result)
            text = text[: number.start()] + draw.choice(WORDS) + text[number.end() :]
        elif kind == 2 and len(words := re.split(r"(\W+)", lines[k])) > 1:
            words[draw.randrange(len(words))] = draw.choice(WORDS)
            text = "\n".join([*lines[:k], "".join(words), *lines[k + 1 :]])
        elif kind == 3:
            text = "\n".join(lines[:k] + lines[k + 1 :])
        elif kind == 4:
            text = "\n".join([*lines[:k], draw.choice(lines), *lines[k:]])
        elif kind == 5:
            other = draw.randrange(len(lines))
            lines[k], lines[other] = lines[other], lines[k]
            text = "\n".join(lines)
        elif kind == 6:
            text = text[:place]
        elif kind == 7:
            text = text[:place] + text[place + draw.randrange(1, 40) :]
    data = text.encode()
    if draw.random() < 0.15:
        place = draw.randrange(len(data) + 1)
        data = data[:place] + bytes(draw.randrange(256) for _ in range(3)) + data[place:]
    return data
