"""The command line: torchmbd new, check, schema, run, sync; list, best, compare, report, ui; cache.

Exit codes: 0 done, 1 something failed that was not the input, 2 bad input (every fault named), 3 a study is finished and its
best design is not verified, or the start of `check` not resolved by the steps, 130 interrupted. Of several studies the highest.
Torch, MLflow, Dask and the experiment layer are imported when a command needs them: the command line answers at once.
"""

from __future__ import annotations

import json
import os
import shlex
import signal
import sys
import threading
from pathlib import Path
from typing import Annotated

from cyclopts import App, CycloptsError, Parameter
from rich.console import Console
from rich.markup import escape

from torchmbd import __version__
from torchmbd.errors import InputError, MbdError
from torchmbd.process import brief_warnings, imports, use_one_thread
from torchmbd.progress import without_bars

EXIT_UNVERIFIED, EXIT_INTERRUPTED = 3, 130

app = App(
    name="torchmbd",
    help="Optimization of flexible multibody systems made of composite materials.",
    version=__version__,
    default_parameter=Parameter(negative=""),
    suppress_keyboard_interrupt=False,  # main says it
)
Uri = Annotated[str | None, Parameter(help="The MLflow store; default: MLFLOW_TRACKING_URI, else ./mlflow.db.")]


@app.command
def run(file: Path, /, *assignments: str, workers: int = 1, scheduler: str | None = None, fresh: bool = False) -> int:
    """Run an experiment file; the same command goes on with a study that was interrupted or killed.

    Parameters
    ----------
    file
        The experiment file (YAML).
    assignments
        Overrides of single values: optimizer.max_iterations=5 starts.count=4; several values, one study for each:
        options.layers=1,2,3
    workers
        Processes that evaluate designs; 0: one for each core.
    scheduler
        Address of a Dask scheduler whose workers evaluate, tcp://host:8786, or a cluster file:
        docs/how-to/cluster/slurm.yaml
    fresh
        Forget the evaluations of this problem, and begin anew.
    """
    with imports():
        use_one_thread()
        from torchmbd.study.file.load import load
        from torchmbd.study.file.overrides import combinations

    console = Console()
    experiments = [load(file, chosen) for chosen in combinations(assignments)]  # all are checked before the first runs
    codes = []
    for (kind, experiment), chosen in zip(experiments, combinations(assignments), strict=True):
        if len(experiments) > 1:
            console.rule(escape(" ".join(chosen)))
        codes.append(kind.run(experiment, console, workers=workers, scheduler=scheduler, fresh=fresh))
        if codes[-1] == EXIT_INTERRUPTED:
            break
    return max(codes)


@app.command
def check(file: Path, /, *assignments: str) -> int:
    """Say everything that is wrong with an experiment file, or what it will cost; nothing is run or logged.

    Parameters
    ----------
    file
        The experiment file (YAML).
    assignments
        Overrides, as in run.
    """
    with imports():
        use_one_thread()
        from torchmbd.study.file.load import load
        from torchmbd.study.file.overrides import combinations

    console = Console()
    return max(kind.check(x, console) for kind, x in [load(file, chosen) for chosen in combinations(assignments)])


@app.command
def new(file: Path, /, *, model: str | None = None) -> int:
    """Write a first experiment file with every section explained.

    Parameters
    ----------
    file
        Its name: study.yaml
    model
        Your model, path/to/file.py:function or package.module:function; default: an example beside the file.
    """
    from torchmbd.study.file.scaffold import write_experiment

    for written in write_experiment(file, model):
        print(f"wrote {written}")
    print(f"next: {shlex.join(['torchmbd', 'check', str(file)])}")
    return 0


@app.command
def schema() -> int:
    """Print the JSON schema of experiment files, for editors."""
    from torchmbd.study.file.json_schema import json_schema

    print(json.dumps(json_schema(), indent=1))
    return 0


@app.command
def best(run: str | None = None, /, *, count: int = 5, uri: Uri = None) -> int:
    """Print the best designs of a study.

    Parameters
    ----------
    run
        Run id, its beginning, or the name of a study; default: the latest study.
    count
        How many.
    """
    from torchmbd.study.report.compare import print_best

    print_best(run, uri, count, Console())
    return 0


@app.command
def compare(a: str, b: str, /, *, uri: Uri = None) -> int:
    """Print in what the files of two studies differ, and how they ended.

    Parameters
    ----------
    a
        Run id, its beginning, or the name of a study (its latest run).
    b
        The other one.
    """
    from torchmbd.study.report.compare import print_comparison

    print_comparison(a, b, uri, Console())
    return 0


@app.command
def report(run: str, /, *, output: Path | None = None, uri: Uri = None) -> int:
    """Write the report of a study: one HTML file that needs nothing else.

    Parameters
    ----------
    run
        Run id, its beginning, or the name of a study.
    output
        Name of the file; default: the study's name and run id.
    """
    from torchmbd.study.report.html import write_report

    print(f"wrote {write_report(run, output, uri)}")
    return 0


@app.command(name="list")
def list_(folder: Path | None = None, *, uri: Uri = None) -> int:
    """List the experiment files at hand and the studies so far.

    Parameters
    ----------
    folder
        Where the experiment files are; default: configs, else this folder.
    """
    from torchmbd.study.report.listing import print_configs, print_studies

    if folder is not None and not folder.is_dir():
        raise InputError(
            "folder",
            str(folder),
            "a folder that exists",
            hint="`torchmbd list` without a folder, which lists the folder configs or this folder",
        )
    console = Console()
    print_configs(folder or (path if (path := Path("configs")).is_dir() else Path()), console)
    print_studies(uri, console)
    return 0


@app.command
def cache(*, clear: bool = False) -> int:
    """List the compiled libraries on disk, or clear them.

    Parameters
    ----------
    clear
        Remove them all; other files of the folder stay.
    """
    from torchmbd.integrate.backend import BACKENDS
    from torchmbd.process import cache_folder

    console = Console()
    for backend in [BACKENDS[name]() for name in BACKENDS]:
        for path, size, ready in backend.files():
            console.print(f"{path.name}  {size / 2**20:6.1f} MiB  {'ready' if ready else 'left over'}", soft_wrap=True)
        if clear:
            backend.clear_files()
    console.print(f"{'cleared' if clear else 'in'} {cache_folder()}", soft_wrap=True)
    return 0


@app.command
def ui(
    *,
    uri: Uri = None,
    host: str = "127.0.0.1",
    port: Annotated[int, Parameter(name=["--port", "-p"])] = 5000,
) -> int:
    """Serve the MLflow UI and print the links that open the right views; Ctrl-C ends it.

    Parameters
    ----------
    host
        Address to listen on; the default is reachable from this machine only.
    port
        Port to listen on.
    """
    from torchmbd.study.report.listing import print_links
    from torchmbd.tracking.server import serving
    from torchmbd.tracking.store import store_uri

    console = Console()
    store = store_uri(uri)
    if store.file is not None and not store.file.exists():
        raise InputError(
            "uri",
            store,
            "a store that contains studies",
            shown=repr(store),
            state="does not contain a study yet",
            hint="`torchmbd run`, which makes one",
        )
    if store.served:
        console.print(f"{store} is a server already.", soft_wrap=True)
        print_links(store, store.page, console)
        return 0
    with serving(store, host, port) as server:
        print_links(store, f"http://{host}:{port}", console)
        console.print("Ctrl-C ends the server.")
        try:
            server.wait()
        except KeyboardInterrupt:
            return 0
    raise MbdError(f"the MLflow server ended with exit code {server.returncode}")


@app.command
def sync() -> int:
    """Send again the studies that are not in their MLflow store: it was away, or the study was killed.

    Nothing is computed: the record of their runs is on disk.
    """
    from torchmbd.study.record.sync import send_unsent

    return min(send_unsent(Console()), 1)


@without_bars()
def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    brief_warnings()
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends as Ctrl-C does: with what was computed
    try:
        code = app(arguments, result_action="return_value", exit_on_error=False, print_error=True)
        sys.stdout.flush()
        return int(code or 0)
    except (InputError, CycloptsError) as error:
        if isinstance(error, InputError):  # cyclopts has printed its own
            print(error, file=sys.stderr)
        return 2
    except MbdError as error:
        print(f"failed: {error}", file=sys.stderr)
        return 1
    except BrokenPipeError:  # the reader of the output has closed it: torchmbd list | head -3
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        print(f"failed: {error.filename or ''}: {error.strerror or error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        runs = (sys.argv[1:] if arguments is None else arguments)[:1] == ["run"]
        print("interrupted" + "; what was evaluated is on disk: the same command goes on" * runs, file=sys.stderr)
        return EXIT_INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
