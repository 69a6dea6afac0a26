"""A part of the paper: what is printed there beside what comes out here, and what is kept of it on the disk.

    <store>/<part>/<key>/rows.json      rows, and the seconds that they took; written last: it says that the part is done
    <store>/<part>/<key>/*.png          figures

key    hash of the settings, of the part's own modules, of torchmbd's source and of torch's version: what was computed
       with other code is computed again, nothing else is
Checked in tests/experiments/test_paper.py.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import torch

import torchmbd as mbd

LABELS = ("given", "inferred", "chosen")
_UNCONCERNED = ("cli.py", "study", "tracking", "viz")  # of torchmbd: no number depends on them
_DONE = "rows.json"


@dataclass(frozen=True)
class Row:
    """One comparison.

    what    the quantity, with its unit
    paper   as printed, in our unit; None: the paper draws it, or does not have it
    ours    what came out here
    label   of the data that ours depends on: the weakest of "given", "inferred", "chosen"
    note    where the difference comes from, if there is one
    """

    what: str
    paper: float | str | None
    ours: float | str
    label: str
    note: str = ""

    def __post_init__(self) -> None:
        if self.label not in LABELS:
            raise mbd.InputError("label", self.label, LABELS, noun=f"label of {self.what!r}")

    @property
    def ratio(self) -> float | None:
        """Ours over the paper's, where both are numbers."""
        if isinstance(self.paper, str) or isinstance(self.ours, str) or not self.paper:
            return None
        return self.ours / self.paper


@dataclass(frozen=True)
class Part:
    """A part that can run alone.

    find      draws figures (`figure8.png`) into a folder, and returns rows
    modules   whose source the rows depend on, beside torchmbd
    minutes   about how long it takes on one core
    settings  keyword arguments of `find`
    """

    name: str
    title: str
    find: Callable[..., list[Row]]
    modules: tuple[str, ...]
    minutes: float
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def key(self) -> str:
        """Hash of everything that the rows depend on."""
        parts = [json.dumps(dict(self.settings), sort_keys=True), torch.__version__, _library()]
        return hashlib.sha256("".join([*parts, *map(_source, self.modules)]).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Finding:
    """A part that is done: its rows, its figures, the seconds that it took, and whether it was done before."""

    part: Part
    rows: list[Row]
    figures: list[Path]
    seconds: float
    kept: bool


def find(part: Part, store: Path, fresh: bool = False) -> Finding:
    """The part from the store, or computed and kept there; `fresh`: computed again."""
    folder = store / part.name / part.key
    stored = (folder / _DONE).exists() and not fresh
    if not stored:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        began = time.perf_counter()
        rows = [asdict(row) for row in part.find(folder, **part.settings)]
        text = json.dumps({"seconds": time.perf_counter() - began, "rows": rows}, indent=1)
        unfinished = folder / f"{_DONE}.part"
        unfinished.write_text(text, encoding="utf-8")
        unfinished.replace(folder / _DONE)
    record = json.loads((folder / _DONE).read_text(encoding="utf-8"))
    rows = [Row(**row) for row in record["rows"]]
    return Finding(part, rows, sorted(folder.glob("*.png"), key=_number), record["seconds"], stored)


def _number(file: Path) -> tuple[int, str]:
    """Figures in the order of their numbers."""
    digits = "".join(c if c.isdigit() else " " for c in file.stem).split()
    return int(digits[0]) if digits else 0, file.stem


@cache
def _library() -> str:
    package = Path(mbd.__file__).parent
    digest = hashlib.sha256()
    for file in sorted(package.rglob("*.py")):
        if file.relative_to(package).parts[0] not in _UNCONCERNED:
            digest.update(file.read_bytes())
    return digest.hexdigest()


def _source(module: str) -> str:
    source = importlib.util.find_spec(module)
    if source is None or source.origin is None:
        raise mbd.InputError("module", module, "a module of this repository", noun="module of a part")
    return hashlib.sha256(Path(source.origin).read_bytes()).hexdigest()
