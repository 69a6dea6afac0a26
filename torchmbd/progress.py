"""Progress bars of motions, optimizations and multistarts: in a terminal and in notebooks, on standard error.

Other work that may take long, such as compiling, is a stage (`stage`): the command line shows its name (`stages_told`); in a
script it is a line on standard error, where it takes longer than `PATIENCE`.

Checked in tests/test_progress.py.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any

from torchmbd.errors import true_or_false

if TYPE_CHECKING:
    from rich.progress import Progress
    from torch import Tensor

DELAY = 3.0  # [s] of a motion before its bar appears: a motion that takes less has none
PATIENCE = 2.0  # [s] of a stage before its line appears in a script
_LONG = 20_000  # steps that are announced
_silent: ContextVar[bool] = ContextVar("silent", default=False)  # motions have no bars of their own
_quiet: ContextVar[bool] = ContextVar("quiet", default=False)  # progress=False: stages have no lines
_reached: ContextVar[Callable[[float], None] | None] = ContextVar("reached", default=None)
_stage: ContextVar[Callable[[str], None] | None] = ContextVar("stage", default=None)


def wanted(progress: bool | None) -> bool:
    """Whether to show a bar; None: in a terminal or a notebook."""
    return (
        sys.stderr.isatty() or "ipykernel" in sys.modules if progress is None else true_or_false("progress", progress)
    )


@contextmanager
def without_bars() -> Iterator[None]:
    """No bars of motions inside: optimizers have their own, the command line has tables."""
    token = _silent.set(True)
    try:
        yield
    finally:
        _silent.reset(token)


def announce(steps: int, lanes: int) -> None:
    """Print a line on standard error when a long motion begins, if it has a bar of its own by default or on request."""
    if steps >= _LONG and not _silent.get() and _reached.get() is not None:
        of_lanes = f", of {lanes} designs" if lanes > 1 else ""
        print(f"torchmbd: a motion of {steps} steps begins{of_lanes}", file=sys.stderr)


@contextmanager
def stages_told(tell: Callable[[str], None]) -> Iterator[None]:
    """Call `tell` with the name of every stage that begins inside."""
    token = _stage.set(tell)
    try:
        yield
    finally:
        _stage.reset(token)


def begin_stage(name: str) -> None:
    """Tell that a stage begins."""
    begin = _stage.get()
    if begin is not None:
        begin(name)


@contextmanager
def stage(name: str) -> Iterator[None]:
    """Work that may take long: its name is told, or shown on standard error where it takes longer than `PATIENCE`.

    A stage within a stage has no line of its own, nor has one of a call with progress=False.
    """
    if _stage.get() is not None or _quiet.get():
        begin_stage(name)
        yield
        return
    line = threading.Timer(PATIENCE, lambda: print(f"torchmbd: {name} ...", file=sys.stderr, flush=True))
    line.daemon = True
    line.start()
    try:
        with quietly():
            yield
    finally:
        line.cancel()


@contextmanager
def quietly(quiet: bool = True) -> Iterator[None]:
    """Stages inside have no lines, if `quiet`."""
    token = _quiet.set(quiet or _quiet.get())
    try:
        yield
    finally:
        _quiet.reset(token)


@contextmanager
def shown(progress: bool | None, what: str, total: int) -> Iterator[Callable[[int, float], None]]:
    """A bar of `total` parts; what is yielded is called with the parts that are done and the best objective so far.

    The motions inside have no bars.
    """
    with without_bars(), quietly(progress is False):
        if not wanted(progress):
            yield lambda done, objective: None
            return
        with _bar("{task.completed}/{task.total}", "{task.fields[best]}") as bar:
            task = bar.add_task(what, total=total, best="")
            yield lambda done, objective: bar.update(task, completed=done, best=f"objective {objective:.6g}")


@contextmanager
def motion_shown(progress: bool | None, duration: float) -> Iterator[None]:
    """A bar of simulated time [s], which `reach` moves; it appears after `DELAY`, or at once where it is asked for."""
    if _silent.get() or not wanted(progress):
        with quietly(progress is False):
            yield
        return
    with _bar("{task.completed:.4g}/{task.total:.4g} s") as bar:
        task = bar.add_task("simulate", total=duration, visible=bool(progress))
        began = time.monotonic()

        def reached(t: float) -> None:
            bar.update(task, completed=t, visible=bool(progress) or time.monotonic() - began > DELAY)

        token = _reached.set(reached)
        try:
            yield
        finally:
            _reached.reset(token)


def reach(t: Tensor) -> None:
    """Move the bar of a motion, if there is one, to time t [s]."""
    move = _reached.get()
    if move is not None:
        move(float(t.max()))


def both(first: Callable[[Any], None], second: Callable[[Any], None] | None) -> Callable[[Any], None]:
    """A callback that calls two."""

    def call(x: Any) -> None:
        first(x)
        if second is not None:
            second(x)

    return call


def _bar(*texts: str) -> Progress:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = TextColumn("{task.description}"), BarColumn(), *map(TextColumn, texts), TimeElapsedColumn()
    return Progress(*columns, console=Console(stderr=True))
