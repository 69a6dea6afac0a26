"""A run of the store as objects again, and what is refused on the way."""

from __future__ import annotations

import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

import torchmbd as mbd
from tests.refused import ANY, refused, warned
from torchmbd.tracking.catalog import find

pytestmark = pytest.mark.usefixtures("compiled")


@pytest.mark.thorough
def test_system_and_motion_are_rebuilt(finished):
    study = mbd.load(finished.runs[0][:10], finished.uri, finished.folder / "rod_model.py")
    assert "best" in repr(study)
    assert "name" in repr(study.study)
    metrics = find(finished.uri, finished.runs[0]).metrics
    assert study.value == metrics["objective"]
    shown = [metrics[f"design/angle_{k}_deg"] for k in (1, 2)]
    assert_allclose(np.degrees(study.x), shown, rtol=1e-12)
    angles = dict(study.system.named_parameters())["rod.laminate.angles"]
    assert_allclose(angles.detach().numpy(), study.x)
    value = mbd.Integral(mbd.StrainEnergy("rod")).value(study.motion)
    assert float(value[0]) == pytest.approx(study.value, rel=1e-12)
    with torch.no_grad():  # the system alone, without the problem
        motion = mbd.simulate(study.system, 0.002, steps=8)
    assert_allclose(motion.q, study.motion.q, rtol=1e-9, atol=1e-12)


@pytest.mark.thorough
def test_a_name_is_its_latest_run(finished):
    assert mbd.load("short", finished.uri, finished.folder / "rod_model.py").entry.run_id == finished.runs[1]


def test_an_unknown_run_names_what_there_is(finished):
    with refused("run", "shrt", meant="short"):
        mbd.load("shrt", finished.uri)


def test_a_model_that_is_not_here_is_named(finished, tmp_path):
    with pytest.raises(mbd.InputError, match=r"rod_model\.py' does not exist"):
        mbd.load("short", finished.uri, tmp_path / "rod_model.py")


@pytest.mark.parametrize(
    ("named", "executed"),
    [((), "rod_model.py"), ("evil.py", "rod_model.py"), (".", "rod_model.py"), ("rod_model", "rod_model.py")],
)
def test_a_model_that_the_caller_does_not_name_is_not_executed(finished, monkeypatch, named, executed):
    monkeypatch.chdir(finished.folder)
    with refused("model", ANY, f"executes '{executed}'"):
        mbd.load("short", finished.uri, named)


@pytest.mark.parametrize(
    ("old", "new", "executed"),
    [
        ("model: rod_model.py:build", "model: evil.py:build", "evil.py"),
        ("model: rod_model.py:build", "model: evil:build", "evil"),
        ("model: rod_model.py:build", "model: ../rod_model.py:build", "../rod_model.py"),
        ("duration: 0.002", "duration: 0.002\n  phases: evil.py:phases", "evil.py"),
    ],
)
def test_a_store_that_was_changed_cannot_name_what_is_executed(finished, monkeypatch, old, new, executed):
    monkeypatch.chdir(finished.folder)
    monkeypatch.syspath_prepend(finished.folder)
    proof = finished.folder / "proof"
    (finished.folder / "evil.py").write_text(f"open({str(proof)!r}, 'w')\n")
    file = finished.folder / "mlartifacts" / finished.runs[0] / "artifacts" / "config.yaml"
    good = file.read_text()
    assert old in good
    try:
        file.write_text(good.replace(old, new))
        with refused("model", ANY, f"executes '{executed}'"):
            mbd.load(finished.runs[0], finished.uri, "rod_model.py")
    finally:
        file.write_text(good)
    assert not proof.exists()


@pytest.mark.thorough
def test_a_model_that_has_changed_is_reported(finished, tmp_path):
    model = shutil.copy(finished.folder / "rod_model.py", tmp_path)
    Path(model).write_text(Path(model).read_text().replace("modes=4", "modes=3"))
    with warned("rod_model.py:build", "torchmbd or torch", "run"):
        mbd.load("short", finished.uri, model)


class Touch:
    """Unpickled, it writes a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("design", "message"),
    [
        ("!!python/object/apply:os.system ['touch {proof}']", "without the tag"),
        ("pickle", "is not UTF-8 text"),
        ("rod.laminate.angles: [0.1]", "must be a list of 2 numbers"),
        ("rod.laminate.angles: [a, b]", "must be a list of 2 numbers"),
        ("[]", "must be a list of 2 numbers"),
    ],
)
def test_a_bad_artifact_is_refused_and_not_executed(finished, tmp_path, design, message):
    proof = tmp_path / "proof"
    file = finished.folder / "mlartifacts" / finished.runs[0] / "artifacts" / "design.yaml"
    good = file.read_bytes()
    try:
        file.write_bytes(pickle.dumps(Touch(proof)) if design == "pickle" else design.format(proof=proof).encode())
        with pytest.raises(mbd.InputError, match=message):
            mbd.load(finished.runs[0], finished.uri, finished.folder / "rod_model.py")
    finally:
        file.write_bytes(good)
    assert not proof.exists()
