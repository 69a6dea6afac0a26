"""Tables of measured numbers: columns of a CSV file, of a DataFrame or of arrays, as float64.

    t [ms],tip [mm]          the first line has names, with units in brackets where they are not SI
    0.0,0.01
    1.0,                     an empty field, nan or NA is a gap

Columns of a file are read by pandas, each once; those of a DataFrame and of arrays of float64 are not copied. A field that is
no number is named with its line, which is looked for only where there is one. The separator is a comma, a semicolon or a tab.
Checked in tests/extensions/identification/test_table.py.
"""

from __future__ import annotations

import csv
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchmbd.errors import InputError, unknown, wrong_entry
from torchmbd.errors import Path as Keys
from torchmbd.math.units import UNITS

SEPARATORS = ",;\t"
GAPS = ("", "nan", "NaN", "NAN", "NA", "na", "N/A", "null")
_CHUNK = 1 << 20  # bytes
_HEADING = re.compile(r"\s*(.*?)\s*(?:\[(.*)\])?\s*")


@dataclass(frozen=True)
class Table:
    """Columns by name.

    columns  name -> numbers [rows], nan where there is none
    units    name -> unit of the column's heading
    file     the file; None: of no file
    """

    columns: Mapping[str, np.ndarray]
    units: Mapping[str, str] = field(default_factory=dict)
    file: Path | None = None

    @classmethod
    def of(cls, data: Any, names: Sequence[str]) -> Table:
        """The columns `names` of a file, a DataFrame, or a mapping of arrays; InputError for one that is not there."""
        if isinstance(data, (str, os.PathLike)):
            return _read(Path(data), names)
        if not hasattr(data, "keys") or not hasattr(data, "__getitem__"):
            raise InputError("data", data, "the path of a CSV file, a DataFrame, or a mapping of arrays by name")
        columns, units = {}, {}
        texts = [str(key) for key in data]
        headings = _headings(texts)
        if len(headings) < len(texts):
            raise InputError("data", data, "must have each name once, whatever its unit", state=f"has columns {texts}")
        keys = dict(zip(headings, data, strict=True))
        for name in names:
            if name not in headings:
                raise unknown("column", name, headings, ("columns", name))
            columns[name] = _numbers(name, data[keys[name]])
            units |= {name: unit} if (unit := headings[name]) else {}
        sizes = {name: len(x) for name, x in columns.items()}
        if len(set(sizes.values())) > 1:
            raise InputError("columns", allowed="must have the same number in all", state=f"have {sizes} rows")
        return cls(columns, units)

    def row(self, index: int) -> str:
        """A row for messages: its line in the file, or its number."""
        return f"row {index}" if self.file is None else f"{self.file}, line {line_of(self.file, index)}"

    def factor(self, name: str, unit: str | None) -> tuple[float, str | None]:
        """The factor from the unit of a column to SI, and the SI unit; None where no unit is given by either."""
        heading = self.units.get(name)
        if unit is not None and heading is not None and unit != heading:
            noun, shown = f"unit of column {name!r}", f"{unit!r}, and its heading says [{heading}]"
            raise InputError(("columns", name), unit, "the same in both", noun=noun, shown=shown)
        unit = unit or heading
        return (1.0, None) if unit is None else UNITS[checked_unit(f"unit of column {name!r}", unit, ("columns", name))]


def checked_unit(what: str, unit: Any, path: Keys = ("unit",)) -> str:
    """The name of a unit; InputError for one that is not known. `what`, `path`: words for it, and the keys to it."""
    plain = str(unit).replace("²", "2").replace("³", "3").replace("·", " ").replace("µ", "u")
    if plain not in UNITS:
        raise unknown(what, unit, UNITS, path)
    return plain


def line_of(file: Path, index: int) -> int:
    """The line of a file that has the row `index` of its numbers; only for messages, it reads the file again."""
    with open(file, newline="", encoding="utf-8-sig") as text:
        rows = csv.reader(text, delimiter=_separator(file))
        next(rows)
        for count, _ in enumerate(row for row in rows if row):
            if count == index:
                return rows.line_num
    raise InputError("index", index, f"a row of {file}")


def _headings(texts: Sequence[str]) -> dict[str, str | None]:
    """Names of columns and the units in their brackets."""
    matches = [_HEADING.fullmatch(text) for text in texts]
    return {m[1]: m[2] for m in matches if m is not None}


def _separator(file: Path) -> str:
    with open(file, newline="", encoding="utf-8-sig") as text:
        heading = text.readline()
    return max(SEPARATORS, key=heading.count)


def _read(file: Path, names: Sequence[str]) -> Table:
    import pandas as pd

    try:
        separator = _separator(file)
        with open(file, newline="", encoding="utf-8-sig") as text:
            texts = next(csv.reader(text, delimiter=separator), [])
    except (OSError, UnicodeDecodeError) as error:
        raise InputError("data", str(file), "a CSV file", shown=f"{str(file)!r}: {error}") from error
    headings = _headings(texts)
    if len(headings) < len(texts):
        raise InputError(
            "headings", texts, "must have each name once", state=f"are {texts}", noun=f"{file.name}, line 1: headings"
        )
    for name in names:
        if name not in headings:
            raise unknown(f"{file.name}: column", name, headings, ("columns", name))
    places = [list(headings).index(name) for name in names]
    options: dict[str, Any] = {"sep": separator, "usecols": places, "skipinitialspace": True, "encoding": "utf-8-sig"}
    try:
        frame = pd.read_csv(file, dtype=np.float64, keep_default_na=False, na_values=list(GAPS), **options)
    except pd.errors.EmptyDataError:
        raise InputError(
            file.name, allowed="must have a line of names, and a line for each time", state="is empty"
        ) from None
    except ValueError as error:
        raise (
            _fault(file, separator, texts, places)
            or InputError("data", str(file), "a CSV file of numbers", noun=f"{file.name}:", state=f"{error}")
        ) from error
    if not _is_regular(file, separator, len(texts)) and (fault := _fault(file, separator, texts, places)):
        raise fault
    # By place: pandas has other names where spaces follow separators.
    columns = {
        name: _writable(frame.iloc[:, sorted(places).index(place)].to_numpy())
        for name, place in zip(names, places, strict=True)
    }
    return Table(columns, {name: unit for name in names if (unit := headings[name])}, file)


def _is_regular(file: Path, separator: str, fields: int) -> bool:
    """True if every line has the separators that its fields ask for: pandas drops fields that are too many, and takes those
    that are missing for gaps. Lines that are empty, and those with quotes, are left to `_fault`."""
    before = 0  # separators of a line that began in the chunk before
    with open(file, "rb") as data:
        while chunk := data.read(_CHUNK):
            array = np.frombuffer(chunk, dtype=np.uint8)
            ends = np.flatnonzero(array == ord("\n"))
            counts = np.searchsorted(np.flatnonzero(array == ord(separator)), ends)
            if len(ends) and not (np.diff(counts, prepend=-before) == fields - 1).all():
                return False
            before = chunk.count(separator.encode()) + (before if not len(ends) else -int(counts[-1]))
            last = chunk[-1:]
    return last == b"\n" or before == fields - 1


def _fault(file: Path, separator: str, texts: Sequence[str], places: Sequence[int]) -> InputError | None:
    """The error of the first line of a file that cannot be read."""
    with open(file, newline="", encoding="utf-8-sig") as text:
        rows = csv.reader(text, delimiter=separator)
        next(rows)
        for row in rows:
            if row and len(row) != len(texts):
                more = " (an empty field is a gap)" if len(row) < len(texts) else ""
                return wrong_entry(
                    f"{file.name}, line {rows.line_num}", f"has {len(row)} fields", f"must have {len(texts)}{more}"
                )
            for place in places:
                if row and not _is_number(row[place].strip()):
                    name = list(_headings(texts))[place]
                    noun = f"{file.name}, line {rows.line_num}: column {texts[place]!r}"
                    allowed = "a number, or an empty field for a gap"
                    return InputError(("columns", name), row[place], allowed, noun=noun)
    return None


def _is_number(text: str) -> bool:
    if text in GAPS:
        return True
    try:
        float(text)
    except ValueError:
        return False
    return "_" not in text  # a number of Python alone


def _numbers(name: str, x: Any) -> np.ndarray:
    """One column as float64, not copied where it is that already and can be written."""
    try:
        numbers = np.asarray(x.detach() if isinstance(x, torch.Tensor) else x)
        result = np.asarray(numbers, dtype=np.float64)
    except (TypeError, ValueError) as error:
        state, allowed = f"has entries that are not numbers ({error})", "must have numbers, nan for a gap"
        raise InputError(("columns", name), noun=f"column {name!r}", allowed=allowed, state=state) from None
    if result.ndim != 1 or numbers.dtype.kind not in "fiuO":
        state, allowed = f"has shape {numbers.shape} of {numbers.dtype}", "must have one number for each row"
        raise InputError(("columns", name), noun=f"column {name!r}", allowed=allowed, state=state)
    return _writable(result)


def _writable(x: np.ndarray) -> np.ndarray:
    """Numbers that tensors can share, which torch does with arrays that can be written: those of pandas may not be."""
    return x if x.flags.writeable else x.copy()
