"""Outputs of commands in pages: `<!-- recorded: COMMAND -->` and what stands below it, up to `<!-- end -->`.

    <!-- recorded: paper.gradients -->
    `python -m experiments.paper.gradients`, 2026-11-23, 41 s, AMD EPYC, 2 cores, torch 2.13.0, Python 3.11.7
    (the output, as a block of text)
    <!-- end -->

COMMAND is a module of experiments, or of tests where it begins with `tests.`, with its arguments. Checked in
tests/experiments/test_documentation.py.
"""

from __future__ import annotations

import datetime
import os
import platform
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch

from experiments.benchmark.report import machine

ROOT = Path(__file__).parents[2]
_MARK = re.compile(r"<!-- recorded: (?P<command>.+?) -->\n(?P<text>.*?)<!-- end -->", re.DOTALL)


def commands(page: Path) -> dict[str, str]:
    """Commands of a page, and what stands below each."""
    return {m["command"]: m["text"] for m in _MARK.finditer(page.read_text(encoding="utf-8"))}


def module(command: str) -> str:
    """The module that a command names."""
    name = shlex.split(command)[0]
    return name if name.startswith("tests.") else f"experiments.{name}"


def record(page: Path, command: str, output: Callable[[str], str] | None = None) -> None:
    """Run a command and put its output into the page; CalledProcessError where it fails."""
    began = time.perf_counter()
    text = (output or run)(command)
    seconds = time.perf_counter() - began
    line = f"python -m {module(command)} {' '.join(shlex.split(command)[1:])}".rstrip()
    versions = f"torch {torch.__version__.partition('+')[0]}, Python {platform.python_version()}"
    date = datetime.datetime.now(datetime.UTC).date()
    head = f"`{line}`, {date}, {seconds:.0f} s, {machine()}, {versions}"
    lines = "\n".join(row.rstrip() for row in text.strip("\n").splitlines())
    block = f"<!-- recorded: {command} -->\n{head}\n\n```text\n{lines}\n```\n<!-- end -->"
    old = page.read_text(encoding="utf-8")  # now: the page may have been edited meanwhile
    new = _MARK.sub(lambda m: block if m["command"] == command else m[0], old)
    page.write_text(new, encoding="utf-8")


def run(command: str) -> str:
    """Output of a command."""
    line = [sys.executable, "-m", module(command), *shlex.split(command)[1:]]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "COLUMNS": "110", "NO_COLOR": "1", "PYTHONPATH": str(ROOT)}
    return subprocess.run(line, cwd=ROOT, env=environment, check=True, text=True, stdout=subprocess.PIPE).stdout
