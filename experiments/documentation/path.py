"""Files and functions of torchmbd that one start and one iteration of a study enter: `python -m experiments.documentation.path`

The study is the first of the paper's with short motions and a coarse mesh, from its file to its report, in an empty store.
"""

from __future__ import annotations

import inspect
import os
import sys
import tempfile
import threading
from pathlib import Path
from types import FrameType

import torchmbd
from torchmbd.cli import main as torchmbd_main

ROOT = Path(__file__).parents[2]
PACKAGE = Path(torchmbd.__file__ or "").parent
FILE = ROOT / "configs" / "slider_crank" / "l1_energy_integral.yaml"
SHORT = ["simulate.steps=200", "starts.count=1", "optimizer.max_iterations=1", "options.cells=[6, 2]"]


def entered(words: list[str]) -> set[tuple[str, str, int]]:
    """File, name and line of every function that a command enters, in all threads of this process."""
    functions: set[tuple[str, str, int]] = set()

    def note(frame: FrameType, event: str, argument: object) -> None:
        code = frame.f_code
        if event == "call" and code.co_flags & inspect.CO_OPTIMIZED and code.co_filename.startswith(str(PACKAGE)):
            functions.add((code.co_filename, code.co_name, code.co_firstlineno))

    threading.setprofile(note)
    sys.setprofile(note)
    try:
        code = torchmbd_main(words)
    finally:
        sys.setprofile(None)
        threading.setprofile(None)  # pyright: ignore[reportArgumentType]
    if code:
        raise SystemExit(code)
    return functions


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        store = Path(folder)
        os.environ |= {"TORCHMBD_STORE": str(store / "state"), "MLFLOW_TRACKING_URI": f"sqlite:///{store / 'runs.db'}"}
        functions = entered(["run", str(FILE), *SHORT])
    files = {file for file, _, _ in functions}
    lines = sum(len(Path(file).read_text(encoding="utf-8").splitlines()) for file in files)
    named = sum(not name.startswith("<") for _, name, _ in functions)
    print(f"{len(files)} files of {lines:,} lines, {named:,} functions")


if __name__ == "__main__":
    main()
