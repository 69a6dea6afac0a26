"""The end of a study: a table of the starts, and its pictures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.markup import escape

from torchmbd.design import Problem
from torchmbd.design.spec import words
from torchmbd.errors import MbdError
from torchmbd.experiment.journal import Journal
from torchmbd.experiment.load import Plan
from torchmbd.experiment.progress import outcome, print_table, table_of
from torchmbd.optimizers import Study
from torchmbd.viz import animate, convergence, design_map, energy_over_time, save

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def print_results(plan: Plan, study: Study, failures: Sequence[str], console: Console) -> None:
    """Print the starts, the best first, and what failed on the way."""
    if not study.results:
        console.print("No start came to a result.")
        return
    columns = ["start", "objective", "less by", "viol.", *plan.columns.headings, "iter", "sims", "status"]
    table = table_of(f"{plan.name}: {len(study.results)} starts, {study.converged} converged", columns)
    best = study.best
    for result in sorted(study.results, key=lambda r: (not r.violation <= 1e-6, r.value)):
        first = result.history[0].objective if result.history else float("nan")
        angles = [f"{value:z.2f}" for value in plan.columns.shown(result.x).values()]
        cells = [str(result.start), *outcome(first, result.value, result.violation), *angles]
        cells += [str(result.iterations), str(result.analyses), result.status.replace("_", " ")]
        table.add_row(*cells, style="bold" if best is not None and result.start == best.start else None)
    print_table(table, console)
    if failures:
        last = f"the last: {escape(failures[-1])}"
        console.print(
            f"{len(failures)} failed evaluations, which the optimizers stepped back from; {last}", soft_wrap=True
        )


Visited = tuple[np.ndarray, np.ndarray]  # designs [m, n], objectives [m]


def study_pictures(
    plan: Plan, study: Study, problem: Problem, visited: Visited, journal: Journal, console: Console
) -> None:
    """Draw convergence, the map of a small design space, energy and motion before and after; file them."""
    histories = {f"start {r.start}": r.history for r in study.results if r.history}
    if not histories:
        return
    best = study.best
    figure = convergence(
        {name: [i.objective for i in history] for name, history in histories.items()},
        {name: [i.violation for i in history] for name, history in histories.items()},
        best=None if best is None else f"start {best.start}",
        ylabel=words(plan.study.minimize),
    )
    journal.file(save(figure, journal.folder / "convergence.png"), "figures")
    if len(plan.columns.names) <= 2:
        journal.file(save(_map(plan, study, visited), journal.folder / "design_map.png"), "figures")
    if best is None or study.interrupted:  # the motion costs two simulations more: not what Ctrl-C asks for
        return
    try:
        _motion_pictures(plan, np.stack([problem.start, best.x]), problem, journal)
    except MbdError as error:
        console.print(f"No picture of the motion: {escape(str(error))}", style="red")


def _map(plan: Plan, study: Study, visited: Visited) -> Figure:
    """Draw where the starts went, and in which of the distinct minima they ended."""
    factors = plan.columns.factors
    moved = [result for result in study.results if result.history]
    ends = {f"start {start}": k for k, minimum in enumerate(study.minima) for start in minimum.starts}
    return design_map(
        {f"start {r.start}": np.array([i.x for i in r.history]) / factors for r in moved},
        {f"start {r.start}": np.array([i.objective for i in r.history]) for r in moved},
        plan.columns.headings,
        ends,
        (visited[0] / factors, visited[1]),
        words(plan.study.minimize),
    )


def _motion_pictures(plan: Plan, designs: np.ndarray, problem: Problem, journal: Journal) -> None:
    motion = problem.simulate(designs).require_ok()
    t = motion.t.numpy()
    shown = [plan.columns.sentence(x) for x in designs]
    labels = [f"start design ({shown[0]})", f"best design ({shown[1]})"]
    for body in motion.system.bodies:
        if motion.body(body.name).mesh is None:
            continue
        energy = motion.body(body.name).strain_energy.numpy()
        figure = energy_over_time(t, dict(zip(labels, energy, strict=True)))
        for ending in ("png", "pdf"):
            journal.file(save(figure, journal.folder / f"energy_{body.name}.{ending}"), "figures")
    for lane, (name, label) in enumerate(zip(("motion_start", "motion_best"), labels, strict=True)):
        path = animate(motion, journal.folder / f"{name}.html", lane=lane, title=f"{plan.name}: {label}")
        journal.file(path)
