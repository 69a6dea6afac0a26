"""The case control of a Nastran file, as far as it changes the structure: which sets of mass and which matrices it chooses.

    NSM = 5                     the set of mass without stiffness
    K2GG, M2GG = NAME, ...      matrices (DMIG) that are added to stiffness and mass; with factors, 2.0*NAME
    TEMP = 7                    temperatures, of which materials may depend; TEMP(LOAD) = 7 is a load alone
    PARAM, WTMASS, ...          parameters, which may stand here, too, and are cards of the bulk data

Source: MSC Nastran Quick Reference Guide, section 4 (case control).
Checked in tests/extensions/nastran/test_refusal.py, test_nsm.py.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

Lines = list[tuple[str, str]]
#: Commands that add matrices to mass and stiffness, of the whole structure (GG) and of the points that a response has (PP).
MATRICES = ("K2GG", "M2GG", "K42GG", "K2PP", "M2PP")
#: The command that gives materials a temperature: without a word, or INITIAL, MATERIAL, BOTH in parentheses.
TEMPERATURE = "TEMP"
_COMMAND = re.compile(
    r"\s*(NSM|K4?2GG|M2GG|K2PP|M2PP|TEMP)[A-Z]*\s*(?:\(\s*(?!LOAD)[A-Z]+[^)]*\))?\s*=\s*(.+)", re.IGNORECASE
)


@dataclass(frozen=True)
class Control:
    """What commands of a case control choose: command -> words, each with the place of its first line."""

    chosen: dict[str, dict[str, str]]

    @classmethod
    def of(cls, lines: Lines) -> Control:
        """Read the commands; a list that ends in a comma goes on in the next line."""
        chosen: dict[str, dict[str, str]] = {}
        words = None
        for where, line in lines:
            match = _COMMAND.fullmatch(line)
            if match:
                words = chosen.setdefault(match[1].upper(), {})
            if words is None:
                continue
            text = match[2] if match else line
            for word in filter(None, (part.rpartition("*")[2].strip().upper() for part in text.split(","))):
                words.setdefault(word, where)
            words = words if text.rstrip().endswith(",") else None
        return cls(chosen)
