"""A progress bar of an optimization or a multistart: in a terminal and in notebooks, on standard error.

Checked in tests/optimization/test_progress.py.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn


def wanted(progress: bool | None) -> bool:
    """Whether to show a bar; None: in a terminal or a notebook."""
    return sys.stderr.isatty() or "ipykernel" in sys.modules if progress is None else progress


@contextmanager
def shown(progress: bool | None, what: str, total: int) -> Iterator[Callable[[int, float], None]]:
    """A bar of `total` parts; what is yielded is called with the parts that are done and the best objective so far."""
    if not wanted(progress):
        yield lambda done, objective: None
        return
    columns = (
        TextColumn(what),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[best]}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(what, total=total, best="")
        yield lambda done, objective: bar.update(task, completed=done, best=f"objective {objective:.6g}")


def both(first: Callable[[Any], None], second: Callable[[Any], None] | None) -> Callable[[Any], None]:
    """A callback that calls two."""

    def call(x: Any) -> None:
        first(x)
        if second is not None:
            second(x)

    return call
