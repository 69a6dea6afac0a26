"""Chains of 5 to 50 laminated links and a mechanism with closed loops, beside the peer; time until native code is there.

chain_N, closed_loops   how many times as fast as Exudyn at equal accuracy, per design: "values_x1" and "values_x8" of batches
                        of one and eight designs, "gradient_x8" of peak and integral of the energy by three angles of each link
build_s, cached_s       from nothing in the cache, and from libraries in the cache, to native steps: the slowest of the chain of
                        50 and the closed loops, in fresh processes

Accuracy as in motion.py, of one design. A gradient costs the peer n + 1 simulations; here it is that by the numbers
of the reduced models, as the structure stage is counted for neither.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from functools import partial

import torch

from experiments.benchmark.cases import (
    Case,
    compilation,
    compiled_ready,
    interleaved,
    loops,
    measures,
    motion,
    motion_backwards,
    pendulum,
)
from experiments.benchmark.motion import accuracy
from experiments.benchmark.report import Cell, Grid, Result, Settings, ratio
from torchmbd.extensions.native.codegen.compiler import unavailable
from torchmbd.math.pair import Pair

LINKS = (5, 10, 20, 50)
LADDER, CONVERGED = (200, 300, 400, 600, 800, 1000), 2000
LANES = 8
KEYS = ("values_x1", "values_x8", "gradient_x8")


def chains(settings: Settings) -> Result:
    """chain_5 to chain_50."""
    names = [f"chain_{links}" for links in LINKS]
    return _all(dict(zip(names, (partial(pendulum, links) for links in LINKS), strict=True)), settings)


def closed(settings: Settings) -> Result:
    """closed_loops."""
    return _all({"closed_loops": loops}, settings)


def _all(cases: dict[str, Callable[[], Case]], settings: Settings) -> Result:
    if settings.quick or unavailable() is not None:
        return Result(dict.fromkeys(cases))
    result, rows = Result(), []
    with compilation(True):
        for name, build in cases.items():
            case = build()
            accuracies, steps, seconds = _beside(case, settings)
            result.figures[name] = accuracies if settings.peer else None
            for key in KEYS:
                ours = 1e3 * seconds[key] / (LANES if key.endswith("8") else 1)
                other = (
                    1e3 * seconds["peer"] * (case.count + 1 if key == "gradient_x8" else 1) if settings.peer else None
                )
                rows.append([name, key, *steps, ours, other, ratio(other, ours)])
    columns = ["mechanism", "what", "steps", "steps of Exudyn", "torchmbd", "Exudyn", "Exudyn / torchmbd"]
    result.tables.append(Grid("milliseconds per design", columns, rows))
    return result


def _beside(case: Case, settings: Settings) -> tuple[dict[str, float | None], list[Cell], dict[str, float]]:
    """Ratios by name, steps of both codes, and seconds of batches here and of one simulation there."""
    single, many = (case.dynamics(lanes, gradients=False) for lanes in (1, LANES))
    assert compiled_ready(single), case.title
    ours = accuracy(lambda steps: motion(single, case.duration, steps)[0], LADDER, CONVERGED)
    functions: dict[str, Callable[[], object]] = {
        "values_x1": lambda: motion(single, case.duration, ours.steps) and None,
        "values_x8": lambda: motion(many, case.duration, ours.steps) and None,
        "gradient_x8": lambda: motion_backwards(many, case.duration, ours.steps, _varying()) and None,
    }
    steps: list[Cell] = [ours.steps, None]
    if settings.peer:
        (run,) = case.peer(case.system, case.designs(1))

        def measured(steps: int) -> torch.Tensor:
            peer_run = run(case.duration, steps)
            return measures(
                torch.tensor(peer_run.t, dtype=torch.float64), torch.tensor(peer_run.U, dtype=torch.float64)[None]
            )

        peer = accuracy(measured, LADDER, CONVERGED)
        functions["peer"], steps = lambda: run(case.duration, peer.steps).seconds, [ours.steps, peer.steps]
    for function in functions.values():
        function()
    seconds = interleaved(functions, min(settings.repeat, 3))
    other = seconds.get("peer")
    return (
        {
            "values_x1": ratio(other, seconds["values_x1"]),
            "values_x8": ratio(other, seconds["values_x8"] / LANES),
            "gradient_x8": ratio(other and other * (case.count + 1), seconds["gradient_x8"] / LANES),
        },
        steps,
        seconds,
    )


def _varying() -> tuple[str, ...]:
    """Data of a chain that its angles change."""
    data = pendulum(1, modes=2, cells=(6, 2)).dynamics(1, gradients=True).data
    return tuple(name for name, x in data.items() if isinstance(x, Pair))


def build(settings: Settings) -> Result:
    """build_s and cached_s."""
    from experiments.benchmark.costs import fresh_process

    figures: dict[str, float | None] = dict.fromkeys(("build_s", "cached_s"))
    if settings.quick or unavailable() is not None:
        return Result(figures)
    rows: list[list[Cell]] = []
    for name in ("chain", "loops"):
        with tempfile.TemporaryDirectory() as cache:
            both = [
                fresh_process("ready", name, TORCHMBD_COMPILE="1", TORCHMBD_CACHE=cache)["seconds"] for _ in range(2)
            ]
        rows.append([name, *both])
    figures = {"build_s": max(row[1] for row in rows), "cached_s": max(row[2] for row in rows)}  # type: ignore[type-var]
    return Result(figures, [Grid("seconds to native steps", ["mechanism", "nothing cached", "library at hand"], rows)])
