"""A valid experiment file, variations of it, and a study that has run."""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from rich.console import Console

from torchmbd.study.file.load import load_study
from torchmbd.study.run import UNVERIFIED, run_study
from torchmbd.tracking.mlflow_tracker import MlflowTracker
from torchmbd.tracking.store import open_store

VALID = Path(__file__).with_name("study.yaml").read_text()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a model beside the experiment files."""
    shutil.copy(Path(__file__).with_name("rod_model.py"), tmp_path)
    return tmp_path


@pytest.fixture
def write(folder: Path) -> Callable[..., Path]:
    """Write the valid file with sections replaced (None: left out) or with another text."""

    def write(text: str | None = None, **sections: Any) -> Path:
        if text is None:
            data = yaml.safe_load(VALID) | sections
            text = yaml.safe_dump({key: value for key, value in data.items() if value is not None}, sort_keys=False)
        file = folder / "study.yaml"
        file.write_text(text)
        return file

    return write


@pytest.fixture(scope="session")
def finished(tmp_path_factory, empty_store):
    """A short study that has run twice, with other options the second time: folder, store, run ids, final designs."""
    folder = tmp_path_factory.mktemp("finished")
    shutil.copy(Path(__file__).with_name("rod_model.py"), folder)
    file, uri = folder / "short.yaml", f"sqlite:///{shutil.copy(empty_store, folder)}"
    file.write_text(VALID)
    runs = []
    for steps in (8, 10):
        tracker = MlflowTracker("finished", uri)
        plan = load_study(file, ["simulate.duration=0.002", f"simulate.steps={steps}"])
        assert run_study(plan, Console(file=io.StringIO()), tracker) in (0, UNVERIFIED)  # few steps and modes
        runs.append(tracker.record.runs["study"])
    return SimpleNamespace(folder=folder, file=file, uri=uri, runs=runs, client=open_store(uri))
