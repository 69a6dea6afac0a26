"""`torchmbd report RUN`: a study in one self-contained HTML file: question, outcome, starts, pictures, motion.

Everything is read from the store: metrics and tags of the runs, and their files. Texts from the store are escaped; the
animation runs in a frame without access to the page.
Checked in tests/study/report/test_html.py.
"""

from __future__ import annotations

import base64
import tempfile
from html import escape
from pathlib import Path

from torchmbd.errors import InputError
from torchmbd.study.file.config_index import question
from torchmbd.study.record.metric_names import (
    CONVERGED,
    EVALUATIONS,
    FAILED,
    INCREASE,
    REDUCTION,
    STARTS,
    cell_text,
    number_text,
)
from torchmbd.study.report.answers import answers_page, stored_verification
from torchmbd.study.report.compare import Start, goal_sign, start_cells, start_headings
from torchmbd.summary import few, plural
from torchmbd.tracking.catalog import ACTIVE, SEARCH_TEXT, Entry, children, fetch, files, find, tables
from torchmbd.tracking.mlflow_tracker import FILES
from torchmbd.tracking.store import store_uri
from torchmbd.tracking.uri import StoreURI, hidden

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.1rem; margin-top: 2rem; } .quiet { color: #666; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 0.9em; display: block; overflow-x: auto; }
th, td { text-align: right; padding: 0.15rem 0.7rem; } th { border-bottom: 1px solid #888; }
td:first-child, th:first-child { text-align: left; } td { white-space: nowrap; } tr.best { font-weight: 600; }
.warning { color: #b00020; font-weight: 600; }
img { max-width: 100%; } iframe { width: 100%; height: 34rem; border: 1px solid #ddd; }
pre { background: #f6f6f6; padding: 0.8rem; overflow-x: auto; }
@media (max-width: 40rem) {
  body { margin: 1rem auto; padding: 0 0.6rem; } h1 { font-size: 1.2rem; } table { font-size: 0.72em; }
  th, td { padding: 0.15rem 0.25rem; } td { white-space: normal; }
}
"""
_OUTCOME = {
    "best_objective": "best objective",
    REDUCTION: "reduction [%]",
    INCREASE: "increase [%]",
    "violation": "largest violation",
    STARTS: "starts",
    CONVERGED: "of them converged",
    EVALUATIONS: "evaluations",
    FAILED: "of them failed",
}
_PROVENANCE = ("git_commit", "version.torchmbd", "version.torch", "version.python", "machine", "seed", "overrides")


def write_report(run: str, path: Path | None = None, uri: str | StoreURI | None = None) -> Path:
    """Write the report of a study and return its path; `run` as in torchmbd.load."""
    store = store_uri(uri)
    entry = find(store, run)
    path = path or Path(f"{entry.name}_{entry.run_id[:8]}.html")
    if path.suffix not in (".html", ".htm"):
        raise InputError("output", str(path), "a name that ends in .html")
    if not path.parent.is_dir():
        raise InputError(
            "output",
            str(path),
            "a file in a folder that exists",
            shown=repr(str(path)),
            state=f"is in the folder {str(path.parent)!r}, which does not exist",
        )
    with tempfile.TemporaryDirectory(prefix="torchmbd-") as scratch:
        path.write_text(_page(store, entry, Path(scratch)), encoding="utf-8")
    return path


def _page(store: StoreURI, entry: Entry, scratch: Path) -> str:
    original = fetch(store, entry, "config_as_given.yaml", scratch)
    config = fetch(store, entry, "config.yaml", scratch)
    _require_files(store, entry)
    text = entry.tags.get("question") or (question(original) if original else "")
    took = "" if entry.seconds is None else f", {entry.seconds:.0f} s"
    parts = [
        f"<h1>{escape(text or entry.name)}</h1>",
        f'<p class="quiet">{escape(entry.name)}, {entry.began:%d %b %Y %H:%M}{took}, '
        f"{escape(entry.status.lower())}, run {escape(entry.run_id)}</p>",
    ]
    if (note := entry.tags.get("mlflow.note.content")) and note != text:
        parts.append(f"<p>{escape(note)}</p>")
    if verified := stored_verification(store, entry, scratch):
        parts += ["<h2>Answer</h2>", answers_page(verified)]
    tags = [tag for tag in (SEARCH_TEXT, ACTIVE) if tag in entry.tags and not (tag == SEARCH_TEXT and verified)]
    parts += [f"<p>{escape(tag)}: {escape(entry.tags[tag])}</p>" for tag in tags]
    parts.append(
        _rows({label: number_text(key, entry.metrics[key]) for key, label in _OUTCOME.items() if key in entry.metrics})
    )
    parts += [_children(store, entry), *_tables(store, entry, scratch), *_pictures(store, entry, scratch)]
    shapes = sorted(name for name in files(store, entry, "") if name.startswith("mode_best_"))
    headings = {"motion_best.html": "Motion of the best design"} | dict.fromkeys(
        shapes, "A vibration of the best design"
    )
    for name, heading in headings.items():
        if motion := fetch(store, entry, name, scratch):
            page = escape(motion.read_text(encoding="utf-8"), quote=True)
            parts += [f"<h2>{heading}</h2>", f'<iframe sandbox="allow-scripts" srcdoc="{page}"></iframe>']
    if config:
        parts += [
            "<h2>Experiment</h2>",
            f"<pre>{escape(hidden((original or config).read_text(encoding='utf-8')))}</pre>",
        ]
    parts += ["<h2>Where it comes from</h2>", _rows({k: hidden(entry.tags[k]) for k in _PROVENANCE if k in entry.tags})]
    head = '<!doctype html><html lang="en"><head><meta charset="utf-8">'
    head += f'<meta name="viewport" content="width=device-width"><title>{escape(entry.name)}</title>'
    return f"{head}<style>{_STYLE}</style></head><body>\n" + "\n".join(parts) + "\n</body></html>\n"


def _require_files(store: StoreURI, entry: Entry) -> None:
    """InputError for a run whose store lacks files that the study has written: its report would be incomplete."""
    written = entry.tags.get(FILES, "config.yaml").splitlines()
    present = {name for folder in {name.rpartition("/")[0] for name in written} for name in files(store, entry, folder)}
    if missing := [name for name in written if name not in present]:
        text = few(missing)
        raise InputError(
            "run",
            entry.run_id,
            "a store with the whole of its folder mlartifacts beside it",
            noun=f"run {entry.run_id[:8]}",
            state=f"lacks {text} in {store}",
        )


def _rows(values: dict[str, str]) -> str:
    rows = "".join(f"<tr><td>{escape(key)}</td><td>{escape(value)}</td></tr>" for key, value in values.items())
    return f"<table>{rows}</table>"


def _children(store: StoreURI, entry: Entry) -> str:
    """Return a table of the starts or points, the best first."""
    runs = children(store, entry)
    if not runs:
        return ""
    starts, sign = list(map(Start.of, runs)), goal_sign(entry)
    headings = start_headings(starts, sign)
    head = "".join(f"<th>{escape(heading)}</th>" for heading in ("run", *headings.values(), "status"))
    rows = []
    for start in starts:
        cells = "".join(f"<td>{escape(cell)}</td>" for cell in start_cells(start, headings, sign))
        rows.append(f"<tr{' class=best' * start.best}>{cells}</tr>")
    return f"<h2>{plural(len(runs), 'run')}</h2><table><tr>{head}</tr>{''.join(rows)}</table>"


def _tables(store: StoreURI, entry: Entry, scratch: Path) -> list[str]:
    """Return the tables that the study says it has."""
    parts = []
    for title, (head, *rows) in tables(store, entry, scratch).items():
        cells = "".join(f"<tr>{''.join(f'<td>{escape(cell_text(x))}</td>' for x in row)}</tr>" for row in rows)
        heads = "".join(f"<th>{escape(x.replace('_', ' '))}</th>" for x in head)
        parts += [f"<h2>{escape(title)}</h2>", f"<table><tr>{heads}</tr>{cells}</table>"]
    return parts


def _pictures(store: StoreURI, entry: Entry, scratch: Path) -> list[str]:
    names = [name for name in files(store, entry, "figures") if name.endswith(".png")]
    parts = ["<h2>Figures</h2>"] if names else []
    for name in sorted(names):
        if file := fetch(store, entry, name, scratch):
            data = base64.b64encode(file.read_bytes()).decode("ascii")
            parts.append(f'<p><img alt="{escape(Path(name).stem)}" src="data:image/png;base64,{data}"></p>')
    return parts
