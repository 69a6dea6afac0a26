"""Disks that fill up and disks that lose their power, each a real file system; needs the right to mount one."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from torchmbd.study.run import UNVERIFIED
from torchmbd.tracking.store import open_store

pytestmark = pytest.mark.slow


@contextlib.contextmanager
def mounted(folder: Path, *arguments: object) -> Iterator[Path]:
    """A file system below a folder for as long as the block lasts."""
    folder.mkdir()
    if subprocess.run(["mount", *map(str, arguments), str(folder)], capture_output=True).returncode:
        pytest.skip("mounting is not allowed here")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def command(file: Path) -> list[str]:
    return [sys.executable, "-u", "-m", "torchmbd.cli", "run", file.name]


def environment(**more: str) -> dict[str, str]:
    kept = {key: value for key, value in os.environ.items() if key not in ("TORCHMBD_STORE", "MLFLOW_TRACKING_URI")}
    return {**kept, "PYTHONPATH": str(Path(__file__).parents[3]), **more}


def table(output: str) -> list[str]:
    """The lines of the final table: start, objective, ..., status."""
    return [
        " ".join(line.split()[:9]) for line in output.splitlines() if re.match(r" +\d+ +[\d.e-]+ +-?[\d.]+ %", line)
    ]


def statuses(folder: Path) -> list[str]:
    """Of all runs in a folder's store."""
    return [run.info.status for run in open_store(f"sqlite:///{folder / 'mlflow.db'}").search_runs(["1"])]


@pytest.fixture
def study(write, folder) -> Path:
    return write(
        starts={"sampler": "sobol", "count": 12, "seed": 7},
        optimizer={"name": "mmfd", "max_iterations": 6},
        tracking={"experiment": "disk"},
    )


@pytest.mark.parametrize("size", ["60k", "400k", "1100k"])
def test_a_disk_without_room(study, folder, size):
    """The evaluations, the tracking store or the pictures do not fit; with room, the same command makes up for it."""
    with mounted(folder / "disk", "-t", "tmpfs", "-o", f"size={size}", "tmpfs") as disk:
        for file in (study, folder / "rod_model.py"):
            shutil.copy(file, disk)
        full = subprocess.run(
            command(study), cwd=disk, env=environment(TORCHMBD_PATIENCE="1"), capture_output=True, text=True
        )
        assert "Traceback" not in full.stderr, full.stderr
        assert len(table(full.stdout)) == 12 or "evaluations.db cannot be opened" in full.stderr, (
            full.stdout + full.stderr
        )
        subprocess.run(["mount", "-o", "remount,size=64m", str(disk)], check=True)
        again = subprocess.run(command(study), cwd=disk, env=environment(), capture_output=True, text=True)
        assert again.returncode in (0, UNVERIFIED), again.stdout + again.stderr
        assert not table(full.stdout) or table(again.stdout) == table(full.stdout)
        assert set(statuses(disk)) == {"FINISHED"}


def test_a_power_cut(study, folder):
    """What the disk itself holds in the middle of a study, its caches lost: the same command goes on from there."""
    image, copy = folder / "disk.img", folder / "copy.img"
    with image.open("wb") as file:
        file.truncate(64 * 2**20)
    if subprocess.run(["mkfs.ext4", "-q", str(image)], capture_output=True).returncode:
        pytest.skip("no file system can be made here")
    with mounted(folder / "disk", "-o", "loop", image) as disk:
        for file in (study, folder / "rod_model.py"):
            shutil.copy(file, disk)
        os.sync()
        process = subprocess.Popen(command(study), cwd=disk, env=environment(), stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        seen = [next(line for line in process.stdout if f"iteration {k} " in line) for k in (1, 2)]
        process.send_signal(signal.SIGSTOP)
        shutil.copy(image, copy)
        process.send_signal(signal.SIGCONT)
        undisturbed = process.communicate()[0]
        assert process.returncode in (0, UNVERIFIED)
    with mounted(folder / "later", "-o", "loop", copy) as disk:
        later = subprocess.run(command(study), cwd=disk, env=environment(), capture_output=True, text=True)
        assert later.returncode in (0, UNVERIFIED), later.stdout + later.stderr
        known, total = map(int, re.findall(r"(\d+) of (\d+) evaluations known", later.stdout)[0])
        assert 24 <= known < total, seen  # every start's first two evaluations at least
        assert table(later.stdout) == table(undisturbed)
        assert len(table(later.stdout)) == 12
        assert set(statuses(disk)) == {"FINISHED"}
