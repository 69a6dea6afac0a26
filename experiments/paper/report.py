"""The report: one HTML file that needs nothing else, with a table of every part and its figures.

What rows say is text, never markup: it is escaped. Checked in tests/experiments/test_paper.py.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path

from experiments.paper.part import Finding, Row

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 64rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.1rem; margin-top: 2.5rem; } .quiet { color: #666; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 0.9em; }
th, td { text-align: left; padding: 0.15rem 0.7rem; vertical-align: top; } th { border-bottom: 1px solid #888; }
td.number { text-align: right; } img { max-width: 32rem; } figure { margin: 1rem 0; } figcaption { color: #666; }
"""
_HEAD = """
<p>Ambrosio, Neto, Leal, Optimization of a complex flexible multibody systems with composite materials, Multibody Syst.
Dyn. 18 (2007). Labels tell what our numbers rest on: <b>given</b> is printed in the paper; <b>inferred</b> was fitted to
its numbers; <b>chosen</b> is free, as the antenna's joint positions and trusses are, which were picked after seeing two of
the paper's numbers: agreement there is no reproduction. The paper prints u'Ku = 2U; its energies of the slider-crank are
halved here.</p>
"""


def write(findings: Sequence[Finding], path: Path) -> Path:
    """Write the report and return its path."""
    contents = "".join(
        f'<li><a href="#{escape(f.part.name)}">{escape(f.part.title)}</a> <span class="quiet">{f.seconds:.0f} s</span></li>'
        for f in findings
    )
    body = "\n".join(["<h1>The paper beside torchmbd</h1>", _HEAD, f"<ul>{contents}</ul>", *map(_part, findings)])
    head = f'<meta charset="utf-8"><title>The paper beside torchmbd</title><style>{_STYLE}</style>'
    path.write_text(f'<!doctype html><html lang="en"><head>{head}</head><body>\n{body}\n</body></html>\n', "utf-8")
    return path


def _part(finding: Finding) -> str:
    part = finding.part
    settings = ", ".join(f"{key} = {value}" for key, value in part.settings.items())
    command = f"python -m experiments.paper {part.name}" + (f"; {settings}" if settings else "")
    head = "".join(f"<th>{name}</th>" for name in ("", "paper", "ours", "ratio", "label", ""))
    rows = "".join(map(_row, finding.rows))
    return (
        f'<h2 id="{escape(part.name)}">{escape(part.title)}</h2><p class="quiet">{escape(command)}</p>'
        f"<table><tr>{head}</tr>{rows}</table>{''.join(map(_figure, finding.figures))}"
    )


def _row(row: Row) -> str:
    ratio = "" if row.ratio is None else f"{row.ratio:.3f}"
    numbers = "".join(
        f'<td class="number">{escape(text)}</td>' for text in (number_text(row.paper), number_text(row.ours), ratio)
    )
    return f"<tr><td>{escape(row.what)}</td>{numbers}<td>{row.label}</td><td>{escape(row.note)}</td></tr>"


def number_text(x: float | str | None) -> str:
    """A number or a word of a row as text."""
    return "" if x is None else x if isinstance(x, str) else f"{x:.6g}"


def _figure(file: Path) -> str:
    data = base64.b64encode(file.read_bytes()).decode("ascii")
    name = file.stem.replace("figure", "Fig. ").replace("_", ", ")
    picture = f'<img alt="{escape(name)}" src="data:image/png;base64,{data}">'
    return f"<figure>{picture}<figcaption>{escape(name)}</figcaption></figure>"
