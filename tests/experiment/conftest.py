"""A valid experiment file, and variations of it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

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
