"""The parts of the paper, in its order, and how some of them run.

Figs. 1, 2, 12-15 are drawings, Fig. 3 shows the slider-crank without dimensions: nothing to compare.
Checked in tests/experiments/test_paper.py.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from experiments.paper import antenna, antenna_deployed, report, rod
from experiments.paper.part import Finding, Part, find
from torchmbd.errors import unknown
from torchmbd.study.record.paths import studies_folder

LONG = 10.0  # minutes
PARTS: tuple[Part, ...] = (*rod.PARTS, *antenna.PARTS, *antenna_deployed.PARTS)


def chosen(names: Sequence[str] = (), long: bool = False) -> list[Part]:
    """Parts by their names; none: all, the long ones only if `long`."""
    by_name = {part.name: part for part in PARTS}
    for name in names:
        if name not in by_name:
            raise unknown("part", name, by_name)
    return [by_name[name] for name in names] or [part for part in PARTS if long or part.minutes <= LONG]


def run(parts: Sequence[Part], store: Path, fresh: bool = False) -> list[Finding]:
    """Find the parts one after the other, and say what is going on."""
    findings = []
    for part in parts:
        print(f"{part.name}: about {part.minutes:g} min if it is not done yet", flush=True)
        findings.append(find(part, store, fresh))
        print(f"{part.name}: {'done before' if findings[-1].kept else f'{findings[-1].seconds:.0f} s'}", flush=True)
    return findings


def figures(folder: Path, parts: Sequence[str] = (), long: bool = False) -> dict[str, float | str]:
    """Report and figures into the folder; returns the ratios to the paper, and what they say in a sentence."""
    findings = run(chosen(parts, long), studies_folder() / "paper")
    report.write(findings, folder / "paper.html")
    for finding in findings:
        for file in finding.figures:
            shutil.copy(file, folder / file.name)
    ratios = {_name(f, row.what): row.ratio for f in findings for row in f.rows if row.ratio is not None}
    rows = sum(len(f.rows) for f in findings)
    sentence = (
        f"{len(findings)} parts of the paper, {rows} rows, {len(ratios)} of them beside a printed number: paper.html"
    )
    return {**ratios, "sentence": sentence}


def _name(finding: Finding, what: str) -> str:
    """A name that the tracking store takes."""
    plain = "".join(c if c.isascii() and (c.isalnum() or c in "./- ") else "_" for c in what)
    return f"{finding.part.name}/{plain.replace('/', '_')}"[:200]
