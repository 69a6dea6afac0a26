"""Public files that are too large for the repository: in folders that environment variables name."""

from __future__ import annotations

from pathlib import Path

import pytest

from experiments.peers import robots


def public_file(variable: str, path: str | Path) -> Path:
    """The file `path` in the folder that `variable` names; the test is skipped where there is none."""
    base = robots.folder(variable)
    if base is None:
        pytest.skip(f"{variable} names no folder")
    return base / path
