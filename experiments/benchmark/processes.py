"""How benchmarks run: what a module prints in a process of its own; parts one after the other, also where one fails."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]


class ChildFailure(RuntimeError):
    """A process that failed; its message has what that wrote to standard error."""


def lines(
    module: str, *arguments: str, folder: Path = ROOT, codes: Sequence[int] = (0,), **environment: Any
) -> list[tuple[float, str]]:
    """Lines that `python -m module *arguments` prints, each with its seconds from the start of the process.

    codes  exit codes that are no failure; any other: ChildFailure, with its standard error
    """
    command = [sys.executable, "-W", "ignore", "-u", "-m", module, *arguments]
    known = os.environ | {"PYTHONPATH": str(ROOT)} | environment
    began = time.perf_counter()
    with tempfile.TemporaryFile("w+") as errors:
        with subprocess.Popen(
            command, cwd=folder, env=known, stdout=subprocess.PIPE, stderr=errors, text=True
        ) as child:
            assert child.stdout is not None
            lines = [(time.perf_counter() - began, line.rstrip("\n")) for line in child.stdout]
        errors.seek(0)
        if child.returncode not in codes:
            raise ChildFailure(f"{' '.join(command)} ended with {child.returncode}\n{errors.read().strip()}")
    return lines


def fresh(module: str, *arguments: str, folder: Path = ROOT, **environment: str) -> dict[str, Any]:
    """The JSON object in the last of these lines."""
    return json.loads(lines(module, *arguments, folder=folder, codes=(0,), **environment)[-1][1])


def resident_mb() -> float:
    """Largest so far. Not by getrusage: what that tells of a fresh process includes the process that began it."""
    (peak,) = (line.split()[1] for line in Path("/proc/self/status").read_text().splitlines() if "VmHWM" in line)
    return float(peak) / 1024


def run_each(names: Iterable[str], run: Callable[[str], object]) -> list[str]:
    """Run every name; one that fails is printed with its error, and is among the names that are returned."""
    failed = []
    for name in names:
        try:
            run(name)
        except Exception:  # whatever it is: the others do not depend on it
            failed.append(name)
            print(f"{name!r} failed:\n{traceback.format_exc()}", file=sys.stderr, flush=True)
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return failed
