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
from torchmbd.tracking.catalog import find


def test_system_and_motion_are_rebuilt(finished):
    study = mbd.load(finished.runs[0][:10], finished.uri, finished.folder)
    metrics = find(finished.uri, finished.runs[0]).metrics
    assert study.value == metrics["objective"]
    shown = [metrics[f"angle_{k}_deg"] for k in (1, 2)]
    assert_allclose(np.degrees(study.x), shown, rtol=1e-12)
    angles = dict(study.system.named_parameters())["rod.laminate.angles"]
    assert_allclose(angles.detach().numpy(), study.x)
    value = mbd.Integral(mbd.StrainEnergy("rod")).value(study.motion)
    assert float(value[0]) == pytest.approx(study.value, rel=1e-12)
    with torch.no_grad():  # the system alone, without the problem
        motion = mbd.simulate(study.system, 0.002, steps=8)
    assert_allclose(motion.q, study.motion.q, rtol=1e-9, atol=1e-12)


def test_a_name_is_its_latest_run(finished):
    assert mbd.load("short", finished.uri, finished.folder).entry.run_id == finished.runs[1]


def test_an_unknown_run_names_what_there_is(finished):
    with pytest.raises(mbd.InputError, match=r"run 'shrt' is not in .*did you mean 'short'"):
        mbd.load("shrt", finished.uri)


def test_a_model_that_is_not_here_is_named(finished, tmp_path):
    with pytest.raises(mbd.InputError, match=r"rod_model\.py does not exist"):
        mbd.load("short", finished.uri, tmp_path)


def test_a_model_that_has_changed_is_told(finished, tmp_path):
    model = shutil.copy(finished.folder / "rod_model.py", tmp_path)
    Path(model).write_text(Path(model).read_text().replace("modes=4", "modes=3"))
    with pytest.warns(
        UserWarning, match=r"rod_model.py:build or what it reads, torchmbd or torch has changed since run"
    ):
        mbd.load("short", finished.uri, tmp_path)


class Touch:
    """Unpickled, it writes a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


@pytest.mark.parametrize(
    ("design", "message"),
    [
        ("!!python/object/apply:os.system ['touch {proof}']", "is not allowed"),
        ("pickle", "is not UTF-8 text"),
        ("rod.laminate.angles: [0.1]", "must be a list of 2 numbers"),
        ("rod.laminate.angles: [a, b]", "must be a list of 2 numbers"),
        ("[]", "must be a list of 2 numbers"),
    ],
)
def test_a_bad_artifact_is_refused_and_not_executed(finished, tmp_path, design, message):
    proof = tmp_path / "proof"
    file = Path(finished.client.get_run(finished.runs[0]).info.artifact_uri) / "design.yaml"
    good = file.read_bytes()
    try:
        file.write_bytes(pickle.dumps(Touch(proof)) if design == "pickle" else design.format(proof=proof).encode())
        with pytest.raises(mbd.InputError, match=message):
            mbd.load(finished.runs[0], finished.uri, finished.folder)
    finally:
        file.write_bytes(good)
    assert not proof.exists()
