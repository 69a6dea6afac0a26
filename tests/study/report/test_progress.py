"""What the terminal shows: tables in its width, one line per iteration of the best where there is no terminal."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from torchmbd.optimization.optimizer import Iterate, OptimizationResult
from torchmbd.progress import begin_stage, stages_told
from torchmbd.study.report.columns import Columns
from torchmbd.study.report.progress import (
    ROWS,
    Beginning,
    Progress,
    SearchCounter,
    drop_order,
    outcome_cells,
    print_table,
    shown_rows,
    table_of,
    wrapped_heading,
)

ANGLES = 8
NAMES = tuple(f"angle_{k + 1}_deg" for k in range(ANGLES))
COLUMNS = Columns(tuple(f"arm.angles[{k}]" for k in range(ANGLES)), NAMES, ("deg",) * ANGLES, np.ones(ANGLES))


def console(width: int = 80, terminal: bool = False) -> tuple[Console, io.StringIO]:
    output = io.StringIO()
    return Console(file=output, width=width, force_terminal=terminal, color_system=None, no_color=True), output


def iterate(start: int, iteration: int, objective: float, violation: float = 0.0, status: str = "ok") -> Iterate:
    x, none = np.full(ANGLES, -123.456), np.zeros(0)
    return Iterate(start, iteration, x, objective, violation, none, iteration + 1, status)


def table() -> Any:
    headings = ["start", "objective", "change", "viol.", *COLUMNS.headings, "iter", "sims", "status"]
    result = table_of("a study of a long name: 2 starts, 1 of them converged, and its title goes on [x]", headings)
    for k in range(2):
        angles = ["-123.46"] * ANGLES
        result.add_row(str(k), "0.0123456", "12.34 %", "1e-03", *angles, "123", "1234", "max iterations", style="bold")
    return result


@pytest.mark.parametrize("width", [60, 80, 100])
def test_angles_give_way_before_objective_and_iteration(width):
    target, output = console(width)
    assert not print_table(table(), target, drop_order(4, ANGLES, [-2, 3, -3, 2]))
    title, *lines = output.getvalue().splitlines()
    assert title.endswith("goes on [x]")  # in one line, however long
    assert max(len(line.rstrip()) for line in lines) <= width
    text = "\n".join(lines)
    assert text.count("0.0123456") == text.count("max iterations") == 2
    assert text.count("...") == 3
    assert "angle 8" not in text


def test_a_table_that_fits_is_whole():
    target, output = console(200)
    assert print_table(table(), target, drop_order(4, ANGLES))
    assert output.getvalue().count("-123.46") == 2 * ANGLES


def test_headings_are_narrow():
    assert wrapped_heading("angle 1 [deg]") == "angle 1\n[deg]"
    assert wrapped_heading("integral of strain energy of rod [J s]") == "integral of\nstrain\nenergy of\nrod\n[J s]"


@pytest.mark.parametrize("terminal", [False, True])
def test_what_a_study_does_before_its_first_result_is_said_once(terminal):
    target, output = console(terminal=terminal)
    beginning = Beginning(target)
    with stages_told(beginning.stage):
        beginning.batch(1, 16)
        begin_stage("compiling")
        begin_stage("compiling")
        beginning.batch(2, 16)
    begin_stage("not heard")
    lines = [line.split("s  ", 1) for line in output.getvalue().splitlines()]
    assert [text for _, text in lines] == ["batch 1: 16 designs", "compiling"]
    assert all(0.0 <= float(seconds) < 60.0 for seconds, _ in lines)


def test_without_a_terminal_the_best_has_a_line_per_iteration():
    target, output = console()
    written = [
        iterate(0, 0, 4.0),
        iterate(1, 0, 5.0),
        iterate(0, 1, 3.0),
        iterate(1, 1, 1.0, violation=0.1),  # not feasible
        iterate(1, 2, 2.0),
        iterate(0, 2, 2.5),
        iterate(1, 3, 1.5),
        iterate(0, 3, 0.1, status="failed"),
    ]
    with Progress(COLUMNS, 2, "study", target) as progress:
        for one in written:
            progress.iterate(one)
    lines = output.getvalue().splitlines()
    assert [float(line.split("objective ")[1].split()[0]) for line in lines] == [4.0, 3.0, 2.0, 1.5]
    assert all(len(line) <= 80 for line in lines)
    assert "change -62.50 %" in lines[-1]  # than start 0 at first, as in every table and in the store


@pytest.mark.parametrize(
    ("sign", "last", "cell"), [(1.0, 5.0, "+25.00 %"), (1.0, 3.0, "-25.00 %"), (-1.0, 5.0, "+25.00 %")]
)
def test_a_change_has_the_sign_of_what_the_objective_does(sign, last, cell):
    """An objective that grew has a plus, minimized or maximized; optimizers see its negative in the second case."""
    assert outcome_cells(sign * 4.0, sign * last, 0.0, sign) == [f"{last:g}", cell, "0"]


def test_the_live_table_fits():
    target, output = console(terminal=True)
    progress = Progress(COLUMNS, 2, "study", target)
    for k in range(3):
        progress.iterate(iterate(0, k, 10.0 - k))
    target.print(progress._table())
    lines = output.getvalue().splitlines()
    assert max(map(len, lines)) <= 80
    assert "objective" in output.getvalue()


def test_what_was_not_evaluated_has_no_numbers():
    nan = float("nan")
    assert outcome_cells(nan, nan, nan) == ["-", "-", "-"]
    assert outcome_cells(nan, 2.0, 0.1) == ["2", "-", "1e-01"]
    assert outcome_cells(4.0, 2.0, 0.0) == ["2", "-50.00 %", "0"]
    assert outcome_cells(4.0, 2.0, 9e-15)[-1] == "0"  # an active constraint


def ended(status: str) -> OptimizationResult:
    return OptimizationResult(
        np.zeros(2), 1.0, np.zeros(0), 0.0, status, "", "mmfd", 7, 12, 8, 0, [], np.zeros(0), np.zeros(2), 0.0
    )


def test_the_searches_of_a_front_have_a_line_each():
    target, output = console()
    with SearchCounter("arm: front of energy, mass [kg]", target) as searches:
        searches.ended(ended("converged"))
        searches.ended(ended("max_iterations"))
    lines = output.getvalue().splitlines()
    assert len(lines) == 2
    assert lines[1].endswith("search 2   iterations 7   simulations 12   max iterations")


def test_a_terminal_counts_them():
    target, output = console(terminal=True)
    with SearchCounter("arm: front of energy, mass [kg]", target) as searches:
        searches.ended(ended("converged"))
        searches.ended(ended("failed"))
    assert "front of energy, mass [kg]: 2 searches, 24 simulations" in output.getvalue()


def test_long_tables_show_a_screen_of_rows():
    assert shown_rows(ROWS) == list(range(ROWS))
    rows = shown_rows(2000, 777)
    assert len(rows) == ROWS + 1
    assert {0, 777, 1999} <= set(rows)
    assert max(np.diff(shown_rows(2000))) <= 52  # evenly spaced
