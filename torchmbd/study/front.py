"""A study of several criteria: the Pareto front, a child run for each of its points.

Checked in tests/study/test_study.py.
"""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.markup import escape

from torchmbd.errors import InputError
from torchmbd.optimization import Front
from torchmbd.optimization.pareto import pareto_front
from torchmbd.study.record.journal import Journal
from torchmbd.study.record.run_record import child
from torchmbd.study.report.progress import SearchCounter, print_table, shown_rows, table_of
from torchmbd.study.report.terminal import save_figure, write_points
from torchmbd.study.settings import StudySettings
from torchmbd.summary import plural
from torchmbd.tracking import Status


def run_front(
    study: StudySettings, cached: Any, lanes: int, journal: Journal, console: Console
) -> tuple[Front | None, Status]:
    """Find the front, print it, and file every point."""
    options: dict[str, Any] = {"max_lanes": lanes} | study.options
    journal.begin_study()
    title = f"{study.name}: front of {', '.join(study.problem.criteria)}"
    try:
        with SearchCounter(title, console) as searches:
            front = pareto_front(
                study.with_evaluator(cached),
                method=study.method,
                starts=list(study.points),
                ended=searches.ended,
                max_iterations=study.max_iterations,
                **options,
            )
    except InputError as error:  # no feasible design of an anchor
        console.print(f"No front: {escape(str(error))}", style="red", soft_wrap=True)
        journal.summary({}, {"message": str(error)})
        return None, "FAILED"
    for k, point in enumerate(front.points):
        journal.begin_start(k, point.x, kind="point")
        numbers = dict(zip(journal.criteria.values(), point.criteria.tolist(), strict=True))
        numbers |= {"objective": float(point.criteria[0]), "violation": point.result.violation}
        journal.tracker.metrics(child(k), numbers | journal.design_metrics(point.x))
        journal.ended(k, point.result)
        journal.tracker.end(child(k), "FINISHED")
    _show(study, front, journal, console)
    journal.summary({"points": len(front.points), "dropped_points": front.dropped, "failed_points": front.failed}, {})
    return front, "KILLED" if front.interrupted else "FINISHED"


def _show(study: StudySettings, front: Front, journal: Journal, console: Console) -> None:
    units = getattr(study.problem, "units", [None] * len(front.names))
    headings = [f"{name} [{unit}]" if unit else name for name, unit in zip(front.names, units, strict=True)]
    table = table_of(
        f"{study.name}: {plural(len(front.points), 'point')}", ["point", *headings, *study.columns.headings]
    )
    rows = shown_rows(len(front.points))
    for k, point in ((k, front.points[k]) for k in rows):
        values = [f"{value:z.2f}" for value in study.columns.by_name(point.x).values()]
        table.add_row(str(k), *(f"{value:.6g}" for value in point.criteria), *values)
    print_table(table, console)
    points = [[*point.criteria.tolist(), *study.columns.by_name(point.x).values()] for point in front.points]
    write_points("front.csv", [*front.names, *study.columns.names], points, len(rows), journal, console)
    title = study.question or study.name
    save_figure(front.plot, ["front.png", "front.pdf"], journal, console, headings=headings, title=title)
