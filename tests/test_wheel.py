"""The wheel: one package, its data, and a study that is made and run without the repository."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import torchmbd

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The unpacked wheel."""
    result = tmp_path_factory.mktemp("wheel")
    shutil.copytree(ROOT / "torchmbd", result / "source" / "torchmbd", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md"):
        shutil.copy(ROOT / name, result / "source")
    command = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--quiet",
        "--no-deps",
        "--wheel-dir",
        str(result),
        str(result / "source"),
    ]
    subprocess.run(command, check=True)
    (file,) = result.glob("*.whl")
    assert file.name.startswith(f"torchmbd-{torchmbd.__version__}-py3-none-any")
    with zipfile.ZipFile(file) as wheel:
        wheel.extractall(result / "site")
    return result / "site"


@pytest.mark.slow
def test_it_has_one_package_and_its_data(wheel):
    tops = {path.name for path in wheel.iterdir()}
    assert tops == {"torchmbd", f"torchmbd-{torchmbd.__version__}.dist-info"}
    package = ROOT / "torchmbd"
    data = [path for path in package.rglob("*") if path.suffix in (".cpp", ".html") or path.name == "py.typed"]
    assert len(data) > 5
    for path in [*data, *package.rglob("*.py")]:
        assert (wheel / path.relative_to(ROOT)).read_bytes() == path.read_bytes(), path


@pytest.mark.slow
def test_a_study_is_begun_and_run_without_the_repository(wheel, tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(wheel), "TORCHMBD_COMPILE": "0"}

    def torchmbd_(*words: str) -> str:
        command = [sys.executable, "-P", "-m", "torchmbd.cli", *words]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr + done.stdout
        return done.stdout

    where = "import torchmbd; print(torchmbd.__file__)"
    result = subprocess.run(
        [sys.executable, "-P", "-c", where], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert result.stdout.startswith(str(wheel))
    torchmbd_("new", "study.yaml")
    torchmbd_("check", "study.yaml")
