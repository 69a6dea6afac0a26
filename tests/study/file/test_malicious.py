"""Files that want more than to describe an experiment are refused, and nothing of them is carried out."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from torchmbd import cli
from torchmbd.study.file.faults import StudyError
from torchmbd.study.file.load import load
from torchmbd.study.file.model import find_function
from torchmbd.study.file.yaml_file import parse_yaml
from torchmbd.tracking.server import QUIET


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "layers: 2",
            "layers: !!python/object/apply:os.system ['touch {proof}']",
            "must be a plain value, without the tag",
        ),
        (
            "layers: 2",
            "layers: !!python/object/new:os.system ['touch {proof}']",
            "must be a plain value, without the tag",
        ),
        ("model: rod_model.py:build", "model: !!python/name:os.system", "must be a plain value, without the tag"),
        ("model: rod_model.py:build", "model: ../outside.py:build", "lies outside the folder of the experiment file"),
        ("model: rod_model.py:build", "model: {outside}:build", "lies outside the folder of the experiment file"),
        ("model: rod_model.py:build", "model: link.py:build", "lies outside the folder of the experiment file"),
        (
            "model: rod_model.py:build\noptions: {layers: 2}",
            "model: os:system\noptions: {command: touch {proof}}",
            "os",
        ),
        (
            "model: rod_model.py:build\noptions: {layers: 2}",
            "model: subprocess:run\noptions: {args: [touch, {proof}]}",
            "says nothing about what it returns",
        ),
        (
            "model: rod_model.py:build\noptions: {layers: 2}",
            "model: subprocess:check_output\noptions: {args: [touch, {proof}]}",
            "subprocess",
        ),
    ],
)
def test_nothing_of_it_is_carried_out(folder, tmp_path_factory, old, new, message):
    proof, outside = folder / "proof", tmp_path_factory.mktemp("outside") / "outside.py"
    outside.write_text(f"open({str(proof)!r}, 'w')\n")
    (folder.parent / "outside.py").write_text(outside.read_text())
    (folder / "link.py").symlink_to(outside)
    text = Path(__file__).parents[1].joinpath("study.yaml").read_text()
    file = folder / "study.yaml"
    file.write_text(text.replace(old, new.replace("{proof}", str(proof)).replace("{outside}", str(outside))))
    with pytest.raises(StudyError) as caught:
        load(file)
    assert message in str(caught.value)
    assert not proof.exists()


def test_a_file_beside_the_model_hides_no_module_of_pythons(folder):
    """The folder comes last where modules are looked for, and only while the model is imported."""
    proof = folder / "proof"
    (folder / "colorsys.py").write_text(f"open({str(proof)!r}, 'w')\n")
    (folder / "ply_table.py").write_text("layers = 2\n")
    model = folder / "rod_model.py"
    model.write_text(model.read_text() + "\nimport colorsys, ply_table\nassert colorsys.rgb_to_hsv\n")
    before = list(sys.path)
    sys.modules.pop("colorsys", None)
    load(folder_study(folder))
    assert sys.path == before
    assert not proof.exists()
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("rod_model")
    (folder / "ply_table.py").write_text("layers = 3\n")
    load(folder_study(folder))
    assert sys.modules["ply_table"].layers == 3  # as it is now, within the same second too


def test_models_of_two_folders_have_their_own_modules(tmp_path):
    result = []
    for name in ("one", "two"):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "ply_table.py").write_text(f"word = {name!r}\n")
        (folder / "m.py").write_text("import ply_table\ndef words() -> list:\n    return [ply_table.word]\n")
        result.append(find_function("m.py:words", folder)())
    assert result == [["one"], ["two"]]


@pytest.mark.thorough
def test_modules_in_the_current_folder_are_not_executed_by_the_server_of_ui(tmp_path):
    """With the environment that `ui` gives it, its workers too."""
    proof = tmp_path / "proof"
    for name in ("random.py", "signal.py", "pickle.py"):
        (tmp_path / name).write_text(f"open({str(proof)!r}, 'w')\nraise RuntimeError('mine')\n")
    served = [sys.executable, "-m", "mlflow", "--version"]
    server = subprocess.run(served, cwd=tmp_path, env={**os.environ, **QUIET}, capture_output=True, text=True)
    assert server.returncode == 0, server.stderr
    assert not proof.exists()


def folder_study(folder: Path) -> Path:
    file = folder / "study.yaml"
    file.write_text(Path(__file__).parents[1].joinpath("study.yaml").read_text())
    return file


def test_a_file_that_multiplies_itself_is_refused():
    bomb = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
        f"{chr(98 + k)}: &{chr(98 + k)} [{', '.join(['*' + chr(97 + k)] * 9)}]\n" for k in range(9)
    )
    with pytest.raises(StudyError, match="anchors"):
        parse_yaml(bomb)


@pytest.mark.thorough
def test_a_deep_file_is_refused():
    with pytest.raises(StudyError, match="nested more than"):
        parse_yaml("a: " + "[" * 5000)


def test_the_server_is_bound_to_loopback_unless_asked():
    assert (cli.ui.__kwdefaults__ or {})["host"] == "127.0.0.1"
