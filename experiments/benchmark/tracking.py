"""What do the experiment layer, its logging and its workers cost? `python -m experiments.benchmark.tracking WHAT ...`

    overhead   a study of some ten seconds (the three-layer rod; `--starts`, `--iterations`) by `torchmbd run`'s own path,
               beside the same multistart called in Python, both in this process, by turns
    fresh      the same, each time in a store that is not there yet
    logging    200 starts of 30 iterations given to the tracker, whose thread brings them into MLflow's SQLite store: processor
               time of both, as a share of a study whose evaluations take 0.1 s each, as those of the slider-crank do
    table      the same, and seconds until Chromium shows the table of these 200 runs, from MLflow's own server (playwright)
    start      seconds from `torchmbd run` to the first iteration of the main job on the screen, in a store that is not there
               yet and then in that store
    scaling    128 designs on one Dask worker and on two (nothing else then), the median of several rounds
    workers    the command `torchmbd run` of that study with one worker and with two, from its start to its end; with
               `--starts 256 --iterations 30` a long one

Wall time on whatever else the machine does.
"""

from __future__ import annotations

import argparse
import io
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console

from experiments.benchmark.processes import ROOT, run_each
from torchmbd.optimization.multistart import multistart
from torchmbd.optimization.multistart.workers import LANES, Workers
from torchmbd.optimization.optimizer import Iterate
from torchmbd.process import use_one_thread
from torchmbd.study.dask_evaluator import study_workers
from torchmbd.study.file.load import load_study
from torchmbd.study.record.journal import Journal
from torchmbd.study.record.paths import problem_key
from torchmbd.study.run import run_study
from torchmbd.tracking import MlflowTracker, Record
from torchmbd.tracking.links import view_link
from torchmbd.tracking.server import serving
from torchmbd.tracking.store import open_store

STUDY = """
model: torchmbd.examples.slider_crank:build
options: {layers: 3}
design:
  rod.laminate.angles: {start: [45, -45, 45], lower: -90, upper: 90, unit: deg}
simulate: {duration: 0.04, steps: 500}
minimize: {integral: {strain_energy: rod}}
subject_to:
  - {max: {strain_energy: rod}, at_most: initial}
optimizer: {name: mmfd, max_iterations: ITERATIONS}
starts: {sampler: sobol, count: COUNT, seed: 7}
tracking: {experiment: benchmark}
"""
ROUNDS = 7  # of batches, whose median tells
STARTS, STEPS, EVALUATION = 200, 30, 0.1  # iterations of each start, seconds for one design in a batch


def timed(action: Callable[[], object]) -> tuple[float, float]:
    """Wall and processor time [s] of an action."""
    wall, processor = time.perf_counter(), time.process_time()
    action()
    return time.perf_counter() - wall, time.process_time() - processor


def overhead(file: Path, fresh: bool, pairs: int) -> None:
    """The study in Python alone, and through the whole layer; `fresh`: each time in a store of its own."""
    plan = load_study(file)
    problem = plan.simulated
    points = plan.points

    def alone() -> None:
        multistart(plan.simulated, plan.method, list(points), max_iterations=plan.max_iterations)

    def whole() -> None:
        run_study(plan, Console(file=io.StringIO()), fresh=True)

    multistart(problem, plan.method, list(points), max_iterations=1)  # what is done once per process
    if not fresh:
        place(file.parent / "store")
        run_study(load_study(file, ["optimizer.max_iterations=1"]), Console(file=io.StringIO()))
    more = []
    for k in range(pairs):
        if fresh:
            place(file.parent / f"store_{k}")
        bare, layered = timed(alone)[0], timed(whole)[0]
        more.append([layered - bare, 100 * (layered / bare - 1)])
        print(f"multistart alone {bare:.2f} s, whole study {layered:.2f} s: {more[-1][1]:.1f} %", flush=True)
    seconds, percent = np.median(more, axis=0)
    print(f"{'a fresh store' if fresh else 'a store that is there'}: median {seconds:.2f} s, {percent:.1f} % more")


def place(folder: Path) -> None:
    """Let studies keep their evaluations and runs here."""
    folder.mkdir()
    os.environ["TORCHMBD_STORE"] = str(folder / "place")
    os.environ["MLFLOW_TRACKING_URI"] = f"sqlite:///{folder}/runs.db"


def logging(file: Path, table: bool) -> None:
    """Many iterates and the thread that writes them; then perhaps the table of the runs in a browser."""
    plan = load_study(file)
    n = len(plan.columns.names)
    with tempfile.TemporaryDirectory() as folder:
        uri = f"sqlite:///{folder}/runs.db"
        open_store(uri)
        tracker = MlflowTracker("logging", uri)
        journal = Journal(plan, Console(quiet=True), tracker)

        def tell() -> None:
            journal.begin_study()
            x = np.full(n, 0.1)
            for k in range(STARTS):
                journal.begin_start(k, x)
            for iteration in range(STEPS + 1):
                for k in range(STARTS):
                    journal.iterate(Iterate(k, iteration, x, 1.0 / (1 + iteration), 0.0, np.zeros(1), iteration + 1))
            tracker.end_all("FINISHED")
            tracker.close()

        wall, processor = timed(tell)
        if table:
            shown(uri, tracker.record)
    study = STARTS * STEPS * EVALUATION
    print(
        f"logging: {STARTS} starts x {STEPS} iterations in the store after {wall:.1f} s, {processor:.1f} s of processor: ",
        end="",
    )
    print(f"{100 * processor / study:.1f} % of a study of {study:.0f} s")


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


def start() -> None:
    """Wait for the first iteration of a real command, twice."""
    file = ROOT / "configs" / "slider_crank" / "l3_energy_integral.yaml"
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-u", "-m", "torchmbd.cli", "run", str(file), "--fresh"]
        variables = ("TORCHMBD_STORE", "MLFLOW_TRACKING_URI")
        environment = {key: value for key, value in os.environ.items() if key not in variables}
        environment["PYTHONPATH"] = str(ROOT)
        for store in ("fresh store", "store that is there"):
            began = time.perf_counter()
            with subprocess.Popen(command, cwd=folder, env=environment, stdout=subprocess.PIPE, text=True) as process:
                assert process.stdout is not None
                if not any("iteration" in line for line in process.stdout):
                    raise RuntimeError(f"{' '.join(command)} ended with {process.wait()} before an iteration")
                print(f"start: first iteration of {file.name} after {time.perf_counter() - began:.1f} s, {store}")
                process.terminate()
                process.stdout.read()


def scaling(file: Path) -> None:
    """Starts for two full batches, on one worker and on two."""
    plan = load_study(
        file, ["options.cells=[24, 4]", "options.modes=8", "simulate.duration=0.06", "simulate.steps=300"]
    )
    problem = plan.simulated
    rng = np.random.default_rng(1)
    X = rng.uniform(problem.lower, problem.upper, (2 * LANES, len(problem.lower)))
    seconds = []
    for workers in (1, 2):
        with study_workers(plan, problem_key(plan.simulated), 1, workers) as pool:
            batches = np.array_split(X, 2 // workers)
            pool.evaluate(X, True)  # the model is built, the limits are known
            rounds = [timed(partial(_all, pool, batches))[0] for _ in range(ROUNDS)]
            seconds.append(float(np.median(rounds)))
    print(f"{len(X)} designs on 1 worker {seconds[0]:.2f} s, on 2 {seconds[1]:.2f} s: {seconds[0] / seconds[1]:.2f}")


def _all(pool: Workers, batches: list[np.ndarray]) -> None:
    for X in batches:
        pool.evaluate(X, True)


def workers(file: Path) -> None:
    """The whole command with one worker and with two."""
    seconds = []
    for count in (1, 2):
        command = [sys.executable, "-m", "torchmbd.cli", "run", file.name, "--fresh", "--workers", str(count)]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        seconds.append(timed(lambda command=command, environment=environment: _quietly(command, file, environment))[0])
    print(f"the whole command, 1 worker {seconds[0]:.1f} s, 2 {seconds[1]:.1f} s: {seconds[0] / seconds[1]:.2f}")


def _quietly(command: list[str], file: Path, environment: dict[str, str]) -> None:
    subprocess.run(command, cwd=file.parent, env=environment, stdout=subprocess.DEVNULL, check=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    what = {
        "overhead": lambda file: overhead(file, False, arguments.pairs),
        "fresh": lambda file: overhead(file, True, arguments.pairs),
        "logging": lambda file: logging(file, table=False),
        "table": lambda file: logging(file, table=True),
        "start": lambda file: start(),
        "scaling": scaling,
        "workers": workers,
    }
    parser.add_argument("what", nargs="+", choices=list(what), help="see the top of this file")
    parser.add_argument("--starts", type=int, default=48, help="of the study")
    parser.add_argument("--iterations", type=int, default=20, help="of every start of the study, at most")
    parser.add_argument("--pairs", type=int, default=5, help="of the study in Python and through the layer")
    arguments = parser.parse_args()
    use_one_thread()  # as the command line does

    def run(part: str) -> None:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "study.yaml"
            text = STUDY.replace("ITERATIONS", str(arguments.iterations)).replace("COUNT", str(arguments.starts))
            file.write_text(text, encoding="utf-8")
            what[part](file)

    return 1 if run_each(arguments.what, run) else 0


if __name__ == "__main__":
    sys.exit(main())
