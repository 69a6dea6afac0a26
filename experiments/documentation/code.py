"""The page docs/read_the_code.md: `python -m experiments.documentation.code` renews its counts, its table and its drawing.

    **`integrate/step.py`** (206 lines). One step ...     a paragraph of a file below torchmbd/; the number is counted
    <!-- lines --> ... <!-- end -->                       the table of `PARTS`
    read_the_code.svg                                     the drawing of `PATH`

`faults` names what the page says and the source does not have: files, names in backticks, counts that are off by more than
`SHARE`. Checked in tests/experiments/test_read_the_code.py.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from html import escape
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
PACKAGE, PAGE = ROOT / "torchmbd", ROOT / "docs" / "read_the_code.md"
DRAWING = PAGE.with_suffix(".svg")
# By which a count may be off, and lines by which it always may: not every commit renews the page.
SHARE, FEW = 0.10, 30
# Folders and files below torchmbd/ by what they are for; everything else is the core.
PARTS = {
    "extensions": ("extensions",),
    "studies, tracking, pictures, command line": ("study", "tracking", "viz", "cli.py", "__main__.py"),
    "examples": ("examples",),
}
LARGEST = 7  # extensions that have a line of their own
_FILE = re.compile(r"\*\*`(?P<path>[\w/]+\.py)`\*\* \((?P<lines>[\d,]+) lines\)")
_TABLE = re.compile(r"(?<=<!-- lines -->\n).*?(?=<!-- end -->)", re.DOTALL)
_WORD = re.compile(r"`([^`\n]+)`")


class Stage(NamedTuple):
    """A level of the drawing: what happens on the way out and on the way back, as (file, name), and what is handed on.

    titles   of both sides
    out      passed to the stage below;  back: passed to the stage above
    """

    titles: tuple[str, str]
    forward: tuple[tuple[str, str], ...]
    out: str
    backward: tuple[tuple[str, str], ...]
    back: str


PATH = (
    Stage(
        ("Experiment file", "Tracker"),
        (("cli.py", "run"), ("study/file/load.py", "load"), ("study/file/model.py", "find_model")),
        "System, bounds, starts",
        (("study/record/journal.py", "Journal"), ("tracking/mlflow_tracker.py", "MlflowTracker")),
        "",
    ),
    Stage(
        ("Search", "Search"),
        (
            ("study/run.py", "run_study"),
            ("optimization/multistart/run.py", "multistart"),
            ("optimization/search.py", "Search"),
        ),
        "designs b of all starts [lanes, n]",
        (("optimization/search.py", "Search"), ("optimization/methods/mmfd.py", "mmfd")),
        "iterate: angle, objective, violation",
    ),
    Stage(
        ("Problem", "Problem"),
        (
            ("optimization/cache.py", "CachedProblem"),
            ("design/problem.py", "Problem"),
            ("design/space.py", "DesignSpace"),
        ),
        "rod.laminate.angles [lanes, plies]",
        (("design/problem_parts.py", "evaluation_of"), ("optimization/optimizer.py", "Evaluation")),
        "dJ/db [lanes, n]",
    ),
    Stage(
        ("Structure", "Structure: the modes; the rest by torch"),
        (
            ("simulation/simulation.py", "Simulation"),
            ("multibody/system/system.py", "System"),
            ("multibody/bodies/flexible.py", "FlexibleBody"),
            ("fem/materials/laminate.py", "Laminate"),
            ("fem/elements/plate.py", "PlateMatrices"),
            ("fem/reduction/basis.py", "modal_basis"),
            ("fem/reduction/invariants.py", "inertia_invariants"),
        ),
        "data: Kr, S1, C1 ... [component, 1, lanes]",
        (("fem/reduction/transport.py", "cotangent"), ("fem/materials/laminate.py", "Laminate")),
        "dJ/d angles [lanes, plies]",
    ),
    Stage(
        ("Motion", "Motion: the adjoint of the steps"),
        (
            ("integrate/motion.py", "Motion"),
            ("integrate/one_step.py", "OneStep"),
            ("integrate/stepper.py", "EagerStepper"),
            ("integrate/step.py", "Step"),
            ("multibody/equations/equations.py", "dynamic_residual"),
        ),
        "q, v, a, lam [lanes, times, n]",
        (
            ("integrate/motion.py", "Motion"),
            ("integrate/reverse_integration.py", "ReverseIntegration"),
            ("integrate/adjoint.py", "Adjoint"),
            ("integrate/phases/adjoint.py", "RunAdjoint"),
            ("integrate/pullback.py", "StepPullback"),
        ),
        "dJ/d data",
    ),
    Stage(
        ("Response", "Response: by torch"),
        (("results/trajectory.py", "Trajectory"), ("design/measures.py", "Integral")),
        "J [lanes]",
        (("design/differentiate.py", "differentiate"),),
        "dJ/dq, dJ/dv, dJ/da, dJ/dlam",
    ),
)


def lines_of(file: Path) -> int:
    """Lines of a file."""
    return len(file.read_text(encoding="utf-8").splitlines())


def files() -> Iterator[tuple[str, Path]]:
    """Part and path of every file of source in the package."""
    first = {folder: part for part, folders in PARTS.items() for folder in folders}
    for file in sorted(PACKAGE.rglob("*")):
        if file.suffix in (".py", ".cpp"):
            yield first.get(file.relative_to(PACKAGE).parts[0], "core"), file


def table(text: str) -> str:
    """Files and lines of the parts of the package, and of the files that the text of the page has a paragraph for."""
    counts: dict[str, list[int]] = {"core": []}
    for part, file in files():
        counts.setdefault(part, []).append(lines_of(file))
    read = [lines_of(PACKAGE / m["path"]) for m in _FILE.finditer(text)]
    rows = [(part, len(x), sum(x)) for part, x in counts.items()]
    rows.insert(1, ("of it, the files of this page", len(read), sum(read)))
    extensions: dict[str, list[int]] = {}
    for part, file in files():
        if part == "extensions":
            name = file.relative_to(PACKAGE / "extensions").parts[0].removesuffix(".py")
            extensions.setdefault(name, []).append(lines_of(file))
    largest = sorted(extensions, key=lambda name: -sum(extensions[name]))[:LARGEST]
    rows += [(f"of them, `extensions/{name}`", len(extensions[name]), sum(extensions[name])) for name in largest]
    rows.append(("all", sum(map(len, counts.values())), sum(map(sum, counts.values()))))
    body = "".join(f"| {part} | {count:,} | {lines:,} |\n" for part, count, lines in rows)
    return f"| part | files | lines |\n|---|---|---|\n{body}"


def renewed(text: str) -> str:
    """The page with the counts of today."""

    def counted(m: re.Match[str]) -> str:
        return f"**`{m['path']}`** ({lines_of(PACKAGE / m['path']):,} lines)"

    return _TABLE.sub(lambda _: table(text), _FILE.sub(counted, text))


def faults(text: str) -> list[str]:
    """What the page, or the drawing, says and the source does not have."""
    wrong = [f"`{word}` is nowhere" for word in _WORD.findall(text) if not _exists(word)]
    for stage in PATH:
        for path, name in (*stage.forward, *stage.backward):
            if not (PACKAGE / path).is_file() or name not in _defined(PACKAGE / path):
                wrong.append(f"drawing: {path} has no {name}")
    pairs = zip(_numbers(text), _numbers(renewed(text)), strict=True) if not wrong else ()
    for (what, on_page), (_, count) in pairs:
        if abs(on_page - count) > max(SHARE * count, FEW):
            wrong.append(f"{what}: {on_page} lines on the page, {count} in the source")
    return wrong


def _numbers(text: str) -> list[tuple[str, int]]:
    rows = re.findall(r"^\| ([a-z][^|]+) \| [\d,]+ \| ([\d,]+) \|$", text, re.MULTILINE)
    rows += [(m["path"], m["lines"]) for m in _FILE.finditer(text)]
    return [(what, int(number.replace(",", ""))) for what, number in rows]


def _exists(word: str) -> bool:
    """Whether a word in backticks is a file, a command, or a name that the package has, perhaps of a class."""
    if "/" in word or word.endswith((".py", ".cpp")):
        return any((folder / word).exists() for folder in (PACKAGE, ROOT, ROOT / "docs"))
    if word.startswith("torchmbd ") or re.fullmatch(r"rod(\.\w+)+|[\w ]*\(.*", word):
        return True
    return all(part in _names() for part in word.split("."))


@cache
def _names() -> frozenset[str]:
    """Names of classes, functions, arguments, fields and constants of the package."""
    return frozenset(name for _, file in files() if file.suffix == ".py" for name in _defined(file)) | {"torchmbd"}


@cache
def _defined(file: Path) -> frozenset[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            names.add(node.name)
        elif isinstance(node, ast.arg):
            names.add(node.arg)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
    return frozenset(names)


_WIDTH, _BOX, _LEFT, _ROW, _FONT = 980, 430, 15, 18, 13  # [px]


def drawing() -> str:
    """The path as SVG: down on the left side, up on the right."""
    right, parts, top = _WIDTH - _LEFT - _BOX, [], 40
    parts += [_text(_LEFT + _BOX / 2, 24, "values", "head"), _text(right + _BOX / 2, 24, "gradients", "head")]
    for k, stage in enumerate(PATH):
        height = 34 + _ROW * max(len(stage.forward), len(stage.backward))
        for x, title, names in zip((_LEFT, right), stage.titles, (stage.forward, stage.backward), strict=True):
            parts.append(f'<rect x="{x}" y="{top}" width="{_BOX}" height="{height}" rx="6"/>')
            parts.append(_text(x + 12, top + 20, title, "title"))
            for i, (path, name) in enumerate(names):
                parts.append(_text(x + 12, top + 40 + _ROW * i, path, "path"))
                parts.append(_text(x + _BOX - 12, top + 40 + _ROW * i, name, "name"))
        if stage.back:
            parts += _arrow(right + 60, top, top - 36, stage.back)
        if k + 1 < len(PATH):
            parts += _arrow(_LEFT + 60, top + height, top + height + 36, stage.out)
            top += height + 36
        else:
            middle = top + height / 2
            parts.append(f'<path d="M{_LEFT + _BOX},{middle} H{right - 8}" marker-end="url(#tip)"/>')
            parts.append(_text(_WIDTH / 2, middle - 8, stage.out, "head"))
            top += height + 16
    style = (
        f"text{{font:{_FONT}px system-ui,sans-serif;fill:#263238}} rect{{fill:#eceff1;stroke:#90a4ae}}"
        "path{stroke:#455a64;stroke-width:1.5;fill:none} .head{text-anchor:middle;font-weight:600}"
        ".title{font-weight:600} .path{font-family:monospace;font-size:12px;fill:#546e7a} .name{text-anchor:end}"
        ".tip{fill:#455a64;stroke:none} .passed{fill:#d84315}"
    )
    tip = (
        '<marker id="tip" viewBox="0 0 8 8" refX="4" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        '<path class="tip" d="M0,0 L8,4 L0,8 z"/></marker>'
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {top}" width="{_WIDTH}" height="{top}">\n'
        f'<style>{style}</style><defs>{tip}</defs>\n<rect style="fill:white;stroke:none" width="{_WIDTH}" height="{top}"/>\n'
        + "\n".join(parts)
        + "\n</svg>\n"
    )


def _text(x: float, y: float, text: str, kind: str) -> str:
    return f'<text class="{kind}" x="{x:g}" y="{y:g}">{escape(text)}</text>'


def _arrow(x: float, start: float, end: float, text: str) -> list[str]:
    """An arrow, and beside it what is handed on."""
    tip = end + (6 if end < start else -6)
    return [
        f'<path d="M{x:g},{start:g} V{tip:g}" marker-end="url(#tip)"/>',
        _text(x + 12, (start + end) / 2 + 5, text, "passed"),
    ]


def main() -> None:
    PAGE.write_text(renewed(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    DRAWING.write_text(drawing(), encoding="utf-8")
    print("\n".join(faults(PAGE.read_text(encoding="utf-8"))) or f"{PAGE.relative_to(ROOT)} is up to date")


if __name__ == "__main__":
    main()
