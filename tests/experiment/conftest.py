"""A valid experiment file, and variations of it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

VALID = """
# What is the best lay-up of the test rod?
model: rod_model.py:build
options: {layers: 2}
design:
  rod.laminate.angles: {start: [45, -45], lower: -90, upper: 90, unit: deg}
simulate: {duration: 0.01, steps: 60}
minimize: {integral: {strain_energy: rod}}
subject_to:
  - {max: {strain_energy: rod}, at_most: initial}
optimizer: {name: mmfd, max_iterations: 2}
starts: {sampler: sobol, count: 2, seed: 7}
tracking: {experiment: test}
"""


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
