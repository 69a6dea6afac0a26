"""The motion stage beside the peer: gradients and values of batches of designs, at equal accuracy.

Both codes take the smallest number of steps of a ladder with which peak and integral of the strain energy of several
designs are within 5e-4 of their own converged values. A gradient costs the peer n + 1 simulations (forward differences).
Structure stage and model building are counted for neither.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from experiments.benchmark.cases import (
    Case,
    compilation,
    compiled_ready,
    crank3,
    crank8,
    interleaved,
    measures,
    motion,
    motion_backwards,
    pendulum,
)
from experiments.benchmark.report import Grid, Result, Settings, ratio

ACCURACY = 5e-4
LADDER = (200, 300, 400, 500, 600, 800, 1000, 1400, 2000)
CONVERGED = 8000
LOOKED_AT = 4  # designs


@dataclass(frozen=True)
class Accuracy:
    """Steps that reach the accuracy, the largest relative errors there, and the converged [2, designs]."""

    steps: int
    peak: float
    integral: float
    converged: Tensor


def accuracy(
    run: Callable[[int], Tensor],
    ladder: tuple[int, ...] = LADDER,
    converged: int = CONVERGED,
    tolerance: float = ACCURACY,
) -> Accuracy:
    """Climb the ladder with `run`: steps -> peak and integral [2, designs]; the last rung where none is enough."""
    exact = run(converged)
    result = Accuracy(0, float("nan"), float("nan"), exact)
    for steps in ladder:
        error = (run(steps) / exact - 1.0).abs().amax(1)
        result = Accuracy(steps, float(error[0]), float(error[1]), exact)
        if float(error.max()) <= tolerance:
            break
    return result


def peer_runs(case: Case, lanes: int) -> list[Callable[[float, int], Any]]:
    """The peer's simulations of the first designs."""
    return case.peer(case.system, case.designs(lanes))


def both_accuracies(case: Case, settings: Settings) -> tuple[Accuracy, Accuracy | None]:
    """Of this code and of the peer."""
    values = case.dynamics(LOOKED_AT, gradients=False)
    with compilation(compiled_ready(values, build=not settings.quick)):
        ours = accuracy(lambda steps: motion(values, case.duration, steps)[0])
    if not settings.peer:
        return ours, None
    runs = peer_runs(case, LOOKED_AT)

    def peer(steps: int) -> Tensor:
        peers = [run(case.duration, steps) for run in runs]
        return torch.stack(
            [measures(torch.tensor(x.t, dtype=torch.float64), torch.tensor(x.U, dtype=torch.float64)) for x in peers], 1
        )

    return ours, accuracy(peer)


@dataclass(frozen=True)
class Row:
    """One batch: lanes, with gradients or not, compiled or not; `figure` is its name in the JSON object.

    back   gradients by the adjoint, as a problem has them by itself where there are at least as many variables as responses;
           else by tangents of the whole motion
    """

    figure: str
    lanes: int
    gradients: bool = True
    compiled: bool = True
    back: bool = True

    @property
    def what(self) -> str:
        kind = "adjoint" if self.back and self.compiled else "tangents"
        return f"{f'gradient, {kind}' if self.gradients else 'values'}, {'compiled' if self.compiled else 'eager'}"


ROWS = (
    Row("gradient_3x32", 32),
    Row("tangents_3x32", 32, back=False),
    Row("gradient_3x1", 1),
    Row("values_x32", 32, gradients=False),
    Row("eager_3x128", 128, compiled=False),
)


def measured(case: Case, rows: tuple[Row, ...], settings: Settings) -> Result:
    """Time this code and the peer in turns, row by row."""
    todo = []
    for row in rows:
        dynamics = case.dynamics(row.lanes, row.gradients)
        if not row.compiled or compiled_ready(dynamics, build=not settings.quick):
            todo.append((row, dynamics))
    result = Result({row.figure: None for row in rows})
    if settings.quick and len(todo) < len(rows):
        return result  # no compiled code at hand: the accuracies alone would take minutes
    ours, peer = both_accuracies(case, settings)
    runs = peer_runs(case, LOOKED_AT) if peer else []
    lines = []
    for row, dynamics in todo:
        functions: dict[str, Callable[[], object]] = {}
        with compilation(row.compiled):
            run = _run(dynamics, case.duration, ours.steps, row)
            functions["ours"] = run
            if peer:
                functions["peer"] = lambda: sum(run(case.duration, peer.steps).seconds for run in runs) / len(runs)
            if row.compiled:
                run()  # loads the library
            seconds = interleaved(functions, settings.repeat if row.compiled else min(settings.repeat, 3))
        mine = seconds["ours"] / row.lanes
        other = seconds["peer"] * (case.count + 1 if row.gradients else 1) if peer else None
        result.figures[row.figure] = ratio(other, mine)
        lines.append([row.what, row.lanes, 1e3 * mine, None if other is None else 1e3 * other, ratio(other, mine)])
    title = f"{case.title}: milliseconds per design"
    result.tables.append(Grid(title, ["what", "lanes", "torchmbd", "Exudyn", "Exudyn / torchmbd"], lines))
    result.tables.append(_accuracies(case, ours, peer))
    return result


def _run(dynamics: Any, duration: float, steps: int, row: Row) -> Callable[[], object]:
    run = motion_backwards if row.gradients and row.back and row.compiled else motion
    return lambda: run(dynamics, duration, steps) and None


def _accuracies(case: Case, ours: Accuracy, peer: Accuracy | None) -> Grid:
    lines = []
    for name, accuracy in (("torchmbd", ours), ("Exudyn", peer)):
        if accuracy is not None:
            apart = (accuracy.converged / ours.converged - 1.0).abs().amax(1)
            lines.append([name, accuracy.steps, accuracy.peak, accuracy.integral, float(apart[0]), float(apart[1])])
    columns = ["code", "steps", "error of max U", "of integral of U", "converged max U: apart", "integral: apart"]
    return Grid(f"{case.title}: accuracy ({LOOKED_AT} designs, worst)", columns, lines)


def slider_crank_part(settings: Settings) -> Result:
    """Three angles: gradient_3x32, gradient_3x1, values_x32, eager_3x128."""
    return measured(crank3(), ROWS, settings)


def eight_part(settings: Settings) -> Result:
    """Four layers, angles and thicknesses: gradient_8x32."""
    return measured(crank8(), (Row("gradient_8x32", 32), Row("tangents_8x32", 32, back=False)), settings)


def pendulum_part(settings: Settings) -> Result:
    """Another mechanism: a double pendulum of two laminated links, six angles."""
    return measured(pendulum(2), (Row("pendulum_6x32", 32), Row("pendulum_values_x32", 32, gradients=False)), settings)
