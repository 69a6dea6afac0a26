"""What do the experiment layer, its logging and its workers cost? `python -m experiments.benchmark_tracking`

    overhead   a study of some ten seconds (the three-layer rod, 32 starts) through `torchmbd run`'s own path, beside the same
               multistart called in Python, both in this process, by turns; the writer and the figures have the other core
    logging    200 starts of 30 iterations told to a journal, and the writer beside it that brings them into MLflow's
               SQLite, as shares of a study whose evaluations take 0.1 s each, as those of the slider-crank do
    table      seconds until Chromium shows the table of these 200 runs, from MLflow's own server (`--table`: playwright)
    start      seconds from `torchmbd run` to the first iteration on the screen (`--start FILE`)
    scaling    128 designs on one Dask worker and on two (`--scaling`, nothing else then)

Wall time on whatever else the machine does; processor time of this process beside it.
"""

from __future__ import annotations

import argparse
import io
import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rich.console import Console

from torchmbd.experiment.assemble import problem_of, starts_of
from torchmbd.experiment.farm import LANES, Farm
from torchmbd.experiment.journal import Journal
from torchmbd.experiment.load import load_study
from torchmbd.experiment.place import problem_key
from torchmbd.experiment.run import run_plan
from torchmbd.optimizers import multistart
from torchmbd.optimizers.optimizer import Iterate
from torchmbd.process import settle
from torchmbd.tracking import ProcessTracker, Record
from torchmbd.tracking.links import view_link
from torchmbd.tracking.server import serving

STUDY = """
model: experiments.slider_crank:build
options: {layers: 3}
design:
  rod.laminate.angles: {start: [45, -45, 45], lower: -90, upper: 90, unit: deg}
simulate: {duration: 0.04, steps: 500}
minimize: {integral: {strain_energy: rod}}
subject_to:
  - {max: {strain_energy: rod}, at_most: initial}
optimizer: {name: mmfd, max_iterations: 30}
starts: {sampler: sobol, count: 32, seed: 7}
tracking: {experiment: benchmark}
"""
STARTS, ITERATIONS, EVALUATION = 200, 30, 0.1  # seconds for one design in a batch
ROUNDS = 2


def timed(action: Callable[[], object]) -> tuple[float, float]:
    """Wall and processor time [s] of an action."""
    wall, processor = time.perf_counter(), time.process_time()
    action()
    return time.perf_counter() - wall, time.process_time() - processor


def overhead(file: Path) -> None:
    """The study in Python alone, and through the whole layer."""
    plan = load_study(file)
    problem = problem_of(plan)
    optimizer = plan.study.optimizer
    assert optimizer is not None
    points = starts_of(plan, problem.start).points(problem)

    def alone() -> None:
        multistart(problem_of(plan), optimizer.name, list(points), max_iterations=optimizer.max_iterations)

    def whole() -> None:
        run_plan(plan, Console(file=io.StringIO()), fresh=True)

    timed(alone)  # what is done once per process
    turns = [(timed(alone)[0], timed(whole)[0]) for _ in range(ROUNDS)]
    for bare, layered in turns:
        print(
            f"overhead: multistart alone {bare:.2f} s, whole study {layered:.2f} s: {100 * (layered / bare - 1):.1f} %"
        )


def logging(file: Path, table: bool) -> None:
    """A journal of many iterates, and the writer's catching up; then perhaps the table of the runs in a browser."""
    plan = load_study(file)
    n = len(plan.columns.names)
    with tempfile.TemporaryDirectory() as folder:
        uri = f"sqlite:///{folder}/runs.db"
        tracker = ProcessTracker("logging", uri, Path(folder) / "study")
        journal = Journal(plan, tracker, tracker.files)

        def tell() -> None:
            journal.begin("study")
            x = np.full(n, 0.1)
            for k in range(STARTS):
                journal.begin_start(k, x)
            for iteration in range(ITERATIONS + 1):
                for k in range(STARTS):
                    journal.iterate(Iterate(k, iteration, x, 1.0 / (1 + iteration), 0.0, np.zeros(1), iteration + 1))

        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        told = timed(tell)
        began = time.perf_counter()
        journal.end_all("FINISHED")
        record = tracker.close()
        caught = time.perf_counter() - began
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        writer = used.ru_utime + used.ru_stime - before.ru_utime - before.ru_stime
        if table:
            shown(uri, record)
    study = STARTS * ITERATIONS * EVALUATION
    shares = [100 * seconds / study for seconds in (told[1], writer)]
    print(
        f"logging: {STARTS} starts x {ITERATIONS} iterations told in {told[1]:.2f} s of processor, {shares[0]:.2f} %",
        end="",
    )
    print(f" of a study of {study:.0f} s; the writer {writer:.1f} s, {shares[1]:.1f} %; ", end="")
    print(f"in MLflow {told[0] + caught:.1f} s after the first word")


def shown(uri: str, record: Record) -> None:
    """Open the table of a study's runs twice: a browser that has never seen the UI, and one that has."""
    from playwright.sync_api import sync_playwright  # pyright: ignore[reportMissingImports]

    with serving(uri, port=50733), sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1600, "height": 1000})
        link = view_link("http://127.0.0.1:50733", record.experiment_id, record.runs["study"])
        for what in ("first", "second"):
            began = time.perf_counter()
            page.goto("about:blank")
            page.goto(link)
            page.get_by_text("matching runs").wait_for()
            page.get_by_text(re.compile(r"^start \d+$")).first.wait_for()
            print(f"table: {STARTS} runs on the screen after {time.perf_counter() - began:.1f} s ({what} time)")
        browser.close()


def start(file: Path) -> None:
    """Wait for the first iteration of a real command."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-u", "-m", "torchmbd.cli", "run", str(file.absolute())]
        environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
        began = time.perf_counter()
        with subprocess.Popen(command, cwd=folder, env=environment, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            next(line for line in process.stdout if "iteration" in line)
            print(f"start: first iteration of {file.name} after {time.perf_counter() - began:.1f} s")
            process.terminate()
            process.stdout.read()


def scaling(file: Path) -> None:
    """Starts for two full batches, on one worker and on two."""
    plan = load_study(
        file, ["options.cells=[24, 4]", "options.modes=8", "simulate.duration=0.06", "simulate.steps=300"]
    )
    problem = problem_of(plan)
    rng = np.random.default_rng(1)
    X = rng.uniform(problem.lower, problem.upper, (2 * LANES, len(problem.lower)))
    seconds = []
    for workers in (1, 2):
        with Farm(plan, problem_key(plan), 1, workers) as farm:
            farm.evaluate(X[: 2 * workers], True)  # the model is built, the limits are known
            batches = np.array_split(X, 2 // workers)
            seconds.append(timed(lambda farm=farm, batches=batches: [farm.evaluate(x, True) for x in batches])[0])
    print(
        f"scaling: {len(X)} designs on 1 worker {seconds[0]:.1f} s, on 2 {seconds[1]:.1f} s: {seconds[0] / seconds[1]:.2f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--start", type=Path, help="an experiment file whose first iteration is waited for")
    parser.add_argument("--scaling", action="store_true", help="one and two workers, alone")
    parser.add_argument("--table", action="store_true", help="also the table of the runs in a browser")
    arguments = parser.parse_args()
    settle()  # as the command line does
    with tempfile.TemporaryDirectory() as folder:
        os.environ["TORCHMBD_STORE"] = f"{folder}/place"
        os.environ["MLFLOW_TRACKING_URI"] = f"sqlite:///{folder}/runs.db"
        file = Path(folder) / "study.yaml"
        file.write_text(STUDY, encoding="utf-8")
        if arguments.scaling:
            scaling(file)
            return
        overhead(file)
        logging(file, arguments.table)
        if arguments.start:
            start(arguments.start)


if __name__ == "__main__":
    main()
