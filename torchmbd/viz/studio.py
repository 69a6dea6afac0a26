"""Figures drawn by another process while the study goes on: nobody waits for matplotlib.

    study                                          the studio's process
    STUDIO.open()                                  imports matplotlib, draws a first figure for itself
    STUDIO.draw("convergence", files, ...)   ->    save(convergence(...), file)
    STUDIO.finish()                          <-    what was drawn, or why it was not

Orders and answers are lines of JSON. One process serves all studies of this one and ends with it; one that dies costs
its pictures and is replaced. Ctrl-C in the terminal does not reach it. Checked in tests/viz/test_studio.py.
"""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchmbd.bare import command
from torchmbd.process import come_forward, give_way
from torchmbd.viz.design_map import design_map
from torchmbd.viz.figures import convergence, criterion, energy_over_time, save

FIGURES = {figure.__name__: figure for figure in (convergence, criterion, design_map, energy_over_time)}


@dataclass(frozen=True)
class Drawn:
    """Files of one figure, or why there are none."""

    files: tuple[Path, ...]
    trouble: str | None = None


class Studio:
    """Draws figures of torchmbd.viz in a process of its own."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None
        self._owner = 0
        self._orders: list[tuple[Path, ...]] = []

    def open(self) -> None:
        """Start the process, unless there is one: it gets ready while others work. Forget orders nobody waits for."""
        if self._orders:
            self.close()
        self._require_process()

    def _require_process(self) -> None:
        if self._process is None or self._owner != os.getpid() or self._process.poll() is not None:
            self._owner, self._orders = os.getpid(), []
            self._process = subprocess.Popen(
                command(__name__),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
                text=True,
            )

    def draw(self, figure: str, files: Sequence[Path], **arguments: Any) -> None:
        """Order a figure by its name in torchmbd.viz, with its arguments, in one file or several; returns at once."""
        self._require_process()
        assert self._process is not None
        assert self._process.stdin is not None
        order = {"figure": figure, "files": [str(file) for file in files], "arguments": arguments}
        self._orders.append(tuple(files))
        try:
            self._process.stdin.write(json.dumps(order, default=_plain) + "\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            self._process.kill()  # its silence is the answer

    def finish(self) -> list[Drawn]:
        """Wait for the figures that were ordered."""
        drawn, answer = [], "null"
        try:
            for files in self._orders:
                assert self._process is not None
                assert self._process.stdout is not None
                answer = self._process.stdout.readline()
                trouble = json.loads(answer) if answer else "the process that draws has died"
                drawn.append(Drawn(files if trouble is None else (), trouble))
            self._orders = []
        finally:
            if self._orders or not answer:
                self.close()  # answers that nobody has read would be taken for later ones
        return drawn

    def close(self) -> None:
        """End the process; a later order starts another."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None
        self._orders = []


STUDIO = Studio()


def main() -> int:
    """Carry out the orders on the standard input; an answer is null, or the reason of a failure."""
    give_way()
    _warm_up()
    for line in sys.stdin:
        come_forward()
        order = json.loads(line)
        trouble = None
        try:
            figure = FIGURES[order["figure"]](**order["arguments"])
            for file in order["files"]:
                save(figure, file)
        except Exception as error:  # matplotlib's, the disk's: no picture, and the reason
            trouble = str(error) or type(error).__name__
        print(json.dumps(trouble), flush=True)
    return 0


def _warm_up() -> None:
    """Draw what nobody sees while nothing is ordered yet: imports, fonts and backends are at hand then."""
    figure = convergence({"start 0": [2.0, 1.0], "start 1": [2.0, 1.0]}, {}, best="start 0")
    for kind in ("png", "pdf"):
        figure.savefig(io.BytesIO(), format=kind)


def _plain(x: Any) -> Any:
    return x.tolist()
