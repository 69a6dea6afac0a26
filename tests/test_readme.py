"""The README's Python examples and experiment file are run as they stand there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

README = (Path(__file__).parent.parent / "README.md").read_text()


def blocks(language: str) -> list[str]:
    """The blocks of a language."""
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def test_python_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    first, _ = blocks("python")
    exec(compile(first, "README.md", "exec"), names)
    assert names["laminate"].angles.grad.shape == (3,)
    start = names["mbd"].Integral(names["energy"])(names["motion"])
    assert names["result"].value < float(start.detach())
    assert (tmp_path / "rod.html").stat().st_size > 10_000


def test_feedback_example_runs() -> None:
    names: dict = {}
    _, second = blocks("python")
    exec(compile(second, "README.md", "exec"), names)
    assert all(bool(p.grad.abs().max() > 0.0) for p in names["network"].parameters())


def test_experiment_file_is_the_shipped_one() -> None:
    shipped = Path(__file__).parent.parent / "configs/slider_crank/l3_energy_integral.yaml"
    assert blocks("yaml")[0] == shipped.read_text()
