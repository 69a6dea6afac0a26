"""The main job as a user starts it: a command in a fresh process, without and then with compiled code at hand, by stages.

study_cold_s   seconds from the command to the table of results, with empty caches and an empty store
study_warm_s   the same with --fresh in the place where it has run before

Rows are processor seconds of the main thread; those of all other threads and "idle", what the main thread waits for them, for
the compiler and for other programs of the machine, are rows of their own.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

from experiments.benchmark.processes import ROOT, lines
from experiments.benchmark.report import Cell, Grid, Result, Settings
from torchmbd.extensions.native.codegen.compiler import unavailable
from torchmbd.study.run import UNVERIFIED

JOB = ROOT / "configs" / "slider_crank" / "l3_energy_integral.yaml"
STAGES = (
    "imports",
    "compile",
    "structure",
    "steps",
    "adjoint",
    "responses",
    "optimizer",
    "tracking",
    "pictures",
    "other",
)
QUICK = ["starts.count=2", "optimizer.max_iterations=1", "simulate.steps=50", "options.cells=[6, 2]", "options.modes=3"]
MARKS = {"first line": "", "first iteration": "iteration", "table": " converged"}  # what a line contains


def study(settings: Settings) -> Result:
    """See the module header."""
    compiled = not settings.quick and unavailable() is None
    with tempfile.TemporaryDirectory() as folder:
        runs = [_run(Path(folder), settings.quick, compiled) for _ in ("cold", "warm")]
    rows: list[list[Cell]] = [[name, *(run[name] for run in runs)] for name in runs[0]]
    table = Grid(f"the main job, {JOB.stem}", ["what", "cold s", "warm s"], rows)
    seconds = [run["table"] if compiled else None for run in runs]
    figures = {"study_cold_s": seconds[0], "study_warm_s": seconds[1]}
    return Result(figures, [table])


def _run(folder: Path, quick: bool, compiled: bool) -> dict[str, float]:
    """Wall seconds until marks of the output, and processor seconds of the stages."""
    environment = {
        "TORCHMBD_CACHE": str(folder / "cache"),
        "TORCHMBD_STORE": str(folder / "store"),
        "MLFLOW_TRACKING_URI": f"sqlite:///{folder}/runs.db",
        "TORCHMBD_COMPILE": "1" if compiled else "0",
        "OMP_NUM_THREADS": "1",
    }
    job = ["run", str(JOB), *(QUICK if quick else []), "--fresh"]
    *shown, (_, last) = lines("experiments.benchmark.stages", *job, folder=folder, codes=(0, UNVERIFIED), **environment)
    marks = {mark: next(at for at, line in shown if text in line) for mark, text in MARKS.items()}
    marks["last line"] = shown[-1][0]
    stages = json.loads(last)
    marks |= {name: stages.get(name, (0.0, 0.0))[0] for name in (*STAGES, "threads")}
    wall, processor = (sum(x[k] for name, x in stages.items() if name != "threads") for k in (1, 0))
    return marks | {"idle": wall - processor}
