"""The pages of docs/validation, from runs. `python -m experiments.documentation.validation`

    paper    every row of the paper next to ours (experiments/paper; parts that are done come from its store)
    others   the output of each command that the page names (recorded.py), with date, seconds and machine; among them is
             docs/reference/optimization.md

    --list   print the commands of the pages;    --only COMMAND   this one alone;    PAGE ...   these pages

Without names all pages are written; that takes about an hour. A command that fails says why, and the others go on; the exit
code is then 1. Checked in tests/experiments/test_documentation.py.
"""

from __future__ import annotations

import argparse
import datetime
import platform
import sys
from collections.abc import Sequence
from pathlib import Path

import torch

from experiments.benchmark.processes import run_each
from experiments.benchmark.report import machine
from experiments.documentation import recorded
from experiments.paper.part import Finding, Row
from experiments.paper.parts import chosen, run
from experiments.paper.report import number_text
from torchmbd.study.record.paths import studies_folder

FOLDER = Path(__file__).parents[2] / "docs" / "validation"
ELSEWHERE = (FOLDER.parent / "reference" / "optimization.md",)  # a page of another folder with recorded outputs
HEAD = """\
# The paper, row by row

Ambrosio, Neto and Leal, *Optimization of a complex flexible multibody systems with composite materials*, Multibody System
Dynamics 18 (2007): every table and every figure that has data, each number next to ours. Written by
`python -m experiments.documentation.validation paper` on {date}, with torch {torch} and Python {python}, on {machine}.

Labels say what our numbers depend on: *given* is printed in the paper, *inferred* was fitted to its numbers, *chosen* is free.
The antenna's joint positions and trusses were chosen after two of the paper's numbers had been seen: agreement there is no
reproduction. The paper prints u'Ku = 2U; its energies of the slider-crank are halved here.
"""


def page(findings: Sequence[Finding]) -> str:
    """The page as Markdown."""
    done = datetime.datetime.now(datetime.UTC).date()
    head = HEAD.format(
        date=done,
        torch=torch.__version__.partition("+")[0],
        python=platform.python_version(),
        machine=machine(),
    )
    return "\n".join([head, *map(_section, findings)])


def _section(finding: Finding) -> str:
    command = f"python -m experiments.paper {finding.part.name}"
    rows = "\n".join(map(_row, finding.rows))
    return (
        f"## {finding.part.title}\n\n`{command}`, {finding.seconds:.0f} s\n\n"
        f"| quantity | paper | ours | ratio | label | note |\n|---|---|---|---|---|---|\n{rows}\n"
    )


def _row(row: Row) -> str:
    ratio = "" if row.ratio is None else f"{row.ratio:.3f}"
    cells = (row.what, number_text(row.paper), number_text(row.ours), ratio, row.label, row.note)
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    pages = {path.stem: path for path in (*sorted(FOLDER.glob("*.md")), *ELSEWHERE)}
    names = list(pages)
    parser.add_argument("pages", nargs="*", choices=[[], *names], help="default: all")
    parser.add_argument("--only", help="this command alone, as --list prints it")
    parser.add_argument("--parts", nargs="*", default=[], help="paper: of experiments.paper; default: all shorter ones")
    parser.add_argument("--list", action="store_true", help="print the commands of the pages, run nothing")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    known = [x for name in arguments.pages or names for x in recorded.commands(pages[name])]
    if arguments.only not in (None, *known):
        parser.error(f"--only = {arguments.only!r}: must be one of {known}")
    sections = [(name, x) for name in arguments.pages or names for x in recorded.commands(pages[name])]
    todo = {f"{name}: {x}": (name, x) for name, x in sections if arguments.only in (None, x)}

    def record(line: str) -> None:
        print(line, flush=True)
        name, command = todo[line]
        recorded.record(pages[name], command)

    if arguments.list:
        print("\n".join(todo))
        return 0
    failed = run_each(todo, record)
    if "paper" in (arguments.pages or names) and arguments.only is None:
        failed += run_each(["paper"], lambda name: _write_paper(arguments.parts))
    return 1 if failed else 0


def _write_paper(parts: Sequence[str]) -> None:
    text = page(run(chosen(parts), studies_folder() / "paper"))
    (FOLDER / "paper.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
