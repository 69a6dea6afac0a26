"""The core alone: a study of the paper runs on a copy of the tree without torchmbd/extensions."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parents[1]
SHORT = ["simulate.steps=400", "starts.count=1", "optimizer.max_iterations=2", "options.cells=[6, 2]"]


@pytest.fixture
def core(tmp_path, empty_store):
    """A function that runs Python on the copy, in a folder with an empty tracking store."""
    leave = shutil.ignore_patterns("__pycache__", "extensions")
    for folder in ("torchmbd", "configs/slider_crank"):
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=leave)
    shutil.copy(empty_store, tmp_path / "mlflow.db")
    path = os.pathsep.join([str(tmp_path), str(Path(torch.__file__).parents[1])])
    environment = {**os.environ, "PYTHONPATH": path, "TORCHMBD_COMPILE": "0"}

    def run(*words: str) -> str:
        done = subprocess.run(
            [sys.executable, "-S", *words],  # -S: an editable install would find the folder where it stands
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    return run


@pytest.mark.thorough
def test_a_study_runs_without_extensions(core):
    file = "configs/slider_crank/l1_energy_integral.yaml"
    assert "finished after" in core("-m", "torchmbd", "run", file, *SHORT)
    code = "import torchmbd as m; print(len([getattr(m, name) for name in m.__all__]), hasattr(m, 'fatigue'))"
    assert core("-c", code).split()[1] == "False"
