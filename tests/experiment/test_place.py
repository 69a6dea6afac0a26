"""Keys: what changes a number changes the key of the problem, what changes the course changes the key of the study."""

from __future__ import annotations

import pytest

from torchmbd.experiment.load import load_study
from torchmbd.experiment.place import evaluations_file, place, problem_key, study_key


def keys(file, *overrides):
    plan = load_study(file, overrides)
    return problem_key(plan), study_key(plan, "sqlite:///runs.db")


@pytest.mark.parametrize(
    ("override", "problem", "study"),
    [
        ("optimizer.max_iterations=9", False, True),
        ("starts.seed=8", False, True),
        ("design.rod.laminate.angles.upper=80", False, True),
        ("tracking.experiment=other", False, True),
        ("design.rod.laminate.angles.start=[40, -45]", True, True),
        ("simulate.steps=61", True, True),
        ("options.layers=2", False, False),  # as in the file
        ("subject_to.0.at_most=1.5", True, True),
        ("minimize={max: {strain_energy: rod}}", True, True),
    ],
)
def test_which_keys_change(write, override, problem, study):
    before = keys(write())
    after = keys(write(), override)
    assert (before[0] != after[0], before[1] != after[1]) == (problem, study)


def test_another_model_in_the_same_file_is_another_problem(write, folder):
    before = keys(write())
    model = folder / "rod_model.py"
    model.write_text(model.read_text().replace("modes=4", "modes=3"))
    after = keys(write())
    assert before[0] != after[0]
    assert before[1] != after[1]


def test_the_place_is_in_the_working_directory(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("TORCHMBD_STORE")
    assert place() == tmp_path / ".torchmbd"
    monkeypatch.setenv("TORCHMBD_STORE", str(tmp_path / "there"))
    assert evaluations_file() == tmp_path / "there" / "evaluations.db"
