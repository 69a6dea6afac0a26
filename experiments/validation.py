"""The page docs/validation/paper.md: every row of the paper beside ours. `python -m experiments.validation`

Rows come from experiments/paper, parts that are done from its store; so the page is as old as the oldest part, which it says.
Checked in tests/experiments/test_documentation.py.
"""

from __future__ import annotations

import argparse
import datetime
import platform
from collections.abc import Sequence
from pathlib import Path

import torch

from experiments.paper.part import Finding, Row
from experiments.paper.parts import chosen, run
from experiments.paper.report import told
from torchmbd.study.paths import place

PAGE = Path(__file__).parents[1] / "docs" / "validation" / "paper.md"
HEAD = """\
# The paper, row by row

Ambrosio, Neto and Leal, *Optimization of a complex flexible multibody systems with composite materials*, Multibody System
Dynamics 18 (2007): every table and every figure that has data, each number beside ours. Written by
`python -m experiments.validation` on {date}, with torch {torch} and Python {python}.

Labels tell what our numbers rest on: *given* is printed in the paper; *inferred* was fitted to its numbers; *chosen* is free.
The antenna's joint positions and trusses were chosen after two of the paper's numbers had been seen: agreement there is no
reproduction. The paper prints u'Ku = 2U; its energies of the slider-crank are halved here.
"""


def page(findings: Sequence[Finding]) -> str:
    """The page as Markdown."""
    done = datetime.datetime.now(datetime.UTC).date()
    head = HEAD.format(date=done, torch=torch.__version__.partition("+")[0], python=platform.python_version())
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
    cells = (row.what, told(row.paper), told(row.ours), ratio, row.label, row.note)
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "parts", nargs="*", help="parts of experiments.paper; default: all but those of more than ten minutes"
    )
    parser.add_argument("--page", type=Path, default=PAGE)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    findings = run(chosen(arguments.parts), place() / "paper")
    arguments.page.write_text(page(findings), encoding="utf-8")
    print(arguments.page)


if __name__ == "__main__":
    main()
