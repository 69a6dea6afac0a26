"""The process that writes a run, as a tag of the run: whoever reads the store next ends the runs of one that was killed.

    machine, boot, namespace of process numbers, process, when it began: "node 6f0c... pid:[4026531836] 4711 183729"

Whether a process has ended is known on its own machine only; another machine leaves its runs as they are.
Checked in tests/tracking/test_run_process.py.
"""

from __future__ import annotations

import os
import platform
from pathlib import Path
from typing import TYPE_CHECKING

from torchmbd.errors import warn
from torchmbd.tracking.store import all_runs, first_line

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

PROCESS = "process"  # the tag
_STATE, _BEGAN = 0, 19  # of /proc/PID/stat behind the name, see proc(5)


def process_tag() -> str:
    """Return the tag of this process, "" where the system has no /proc."""
    place = _place()
    return place and f"{place} {os.getpid()} {_began(os.getpid())}"


def has_ended(tag: str) -> bool:
    """True if the process of a tag has ended; False if this machine cannot know it."""
    machine, _, rest = tag.partition(" ")
    here = _place().split(" ")
    if len(rest.split(" ")) != 4 or machine != here[0]:
        return False
    boot, space, number, began = rest.split(" ")
    if boot != here[1]:
        return True
    return space == here[2] and number.isdigit() and _began(int(number)) != began


def _place() -> str:
    """Return machine, boot and namespace of process numbers, "" where the system has no /proc."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{platform.node().replace(' ', '-')} {boot} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return ""


def _began(process: int) -> str:
    """Return when a process began (in ticks since the boot), "" if it has ended."""
    try:
        stat = Path(f"/proc/{process}/stat").read_text(encoding="utf-8", errors="replace").rpartition(") ")[2].split()
    except OSError:
        return ""
    return "" if stat[_STATE] in "ZX" else stat[_BEGAN]


def end_killed(client: MlflowClient, experiments: list[str]) -> None:
    """End the runs of some experiments (ids) whose process was killed, at the time of their last metric."""
    from mlflow.exceptions import MlflowException

    for run in all_runs(client, experiments, "attributes.status = 'RUNNING'"):
        if has_ended(run.data.tags.get(PROCESS, "")):
            try:
                client.set_terminated(run.info.run_id, "KILLED", _last(client, run))
            except MlflowException as error:  # of a store that can only be read
                warn(
                    f"run {run.info.run_id[:8]} was killed, but MLflow could not mark it as killed: {first_line(error)}"
                )


def _last(client: MlflowClient, run: Run) -> int:
    """Return the time of the last metric of a run, else that of its begin [ms since 1970]."""
    names = list(run.data.metrics)[:1]  # all are logged together
    return max(
        [run.info.start_time, *(x.timestamp for n in names for x in client.get_metric_history(run.info.run_id, n))]
    )
