"""The README's Python example and experiment file are run as they stand there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

README = (Path(__file__).parent.parent / "README.md").read_text()


def block(language: str) -> str:
    """The one block of a language."""
    [text] = re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)
    return text


def test_python_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(compile(block("python"), "README.md", "exec"), names)
    assert names["gradient"].shape == (1, 3)
    assert names["result"].value < float(names["value"])
    assert (tmp_path / "rod.html").stat().st_size > 10_000


def test_experiment_file_is_the_shipped_one() -> None:
    shipped = Path(__file__).parent.parent / "configs/slider_crank/l3_energy_integral.yaml"
    assert block("yaml") == shipped.read_text()
