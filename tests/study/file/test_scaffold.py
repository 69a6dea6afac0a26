"""`torchmbd new`: what it writes is valid and runs."""

from __future__ import annotations

import io
import shutil

import numpy as np
import pytest
from rich.console import Console

from tests.refused import refused
from torchmbd.optimization import OPTIMIZERS
from torchmbd.optimization.optimizer import DEFAULT_METHOD
from torchmbd.study.file.config_index import question
from torchmbd.study.file.load import load_study
from torchmbd.study.file.scaffold import EXAMPLE_PARTS, TEXT, parts_of, write_experiment
from torchmbd.study.run import UNVERIFIED, run_study
from torchmbd.tracking.mlflow_tracker import MlflowTracker


@pytest.mark.thorough
def test_the_example_runs(tmp_path, empty_store):
    file, model = write_experiment(tmp_path / "arm.yaml")
    assert model.name == "arm_model.py"
    assert "?" in question(file)
    overrides = ["simulate.duration=0.01", "simulate.steps=20", "optimizer.max_iterations=1", "starts.count=1"]
    plan = load_study(file, overrides)
    assert plan.columns.names == ("angle_1_deg", "angle_2_deg")
    tracker = MlflowTracker("new", f"sqlite:///{shutil.copy(empty_store, tmp_path)}")
    assert run_study(plan, Console(file=io.StringIO()), tracker) in (0, UNVERIFIED)


def test_what_is_written_of_the_example_is_so(tmp_path):
    write_experiment(tmp_path / "arm.yaml")
    built = parts_of("arm_model.py:build", tmp_path)
    assert (built.body, built.options) == (EXAMPLE_PARTS.body, EXAMPLE_PARTS.options)
    np.testing.assert_equal(built.parameters, EXAMPLE_PARTS.parameters)
    named = TEXT.partition(f"name: {DEFAULT_METHOD}")[2].partition("or ")[2].partition("\n")[0]
    assert {DEFAULT_METHOD, *named.split(", ")} == set(OPTIMIZERS)


def test_a_model_of_the_users_names_its_own_parts(folder):
    (file,) = write_experiment(folder / "mine.yaml", "rod_model.py:build")
    plan = load_study(file)
    assert plan.origin.data.minimize == {"integral": {"strain_energy": "rod"}}
    assert plan.origin.data.options == {"layers": 2, "cells": 4, "payload": 0.0}
    assert plan.origin.data.design["rod.laminate.angles"].start == [45.0, -45.0]


MODEL = """
import torch
import torchmbd as mbd

def build() -> mbd.System:
    laminate = mbd.Laminate(mbd.examples.carbon(), mbd.deg([135.0, -100.0]), thickness=1e-3)
    arm = mbd.FlexibleBody.plate("arm", mbd.mesh.rectangle(0.5, 0.05, (4, 2)), laminate, modes=2)
    center = torch.nn.Parameter(torch.tensor([0.0, -0.1, 0.2], dtype=torch.float64))
    tool = mbd.RigidBody("tool", mbd.variable(0.2), (1e-3, 1e-3, 1e-3), center=center, position=(0.25, 0, 0))
    hinge = mbd.Revolute(mbd.Ground().at(0, 0, 0), arm.at("left"), axis="z")
    return mbd.System([arm, tool], [hinge, mbd.Fixed(arm.at("right"), tool.at(0, 0, 0))])
"""


def test_bounds_enclose_values_of_any_sign_and_angles_of_any_size(tmp_path):
    (tmp_path / "mine.py").write_text(MODEL)
    (file,) = write_experiment(tmp_path / "study.yaml", "mine.py:build")
    design = load_study(file).origin.data.design
    bounds = {name: (variable.lower, variable.upper) for name, variable in design.items()}
    assert bounds == {
        "arm.laminate.angles": ([45.0, -190.0], [225.0, -10.0]),
        "tool.mass": ([0.1], [0.4]),
        "tool.center": ([-0.2, -0.2, 0.1], [0.2, -0.05, 0.4]),
    }


def test_nothing_is_overwritten(folder):
    write_experiment(folder / "mine.yaml", "rod_model.py:build")
    with refused("file"):
        write_experiment(folder / "mine.yaml", "rod_model.py:build")
    with refused("file"):
        write_experiment(folder / "mine.txt")
    with refused("model", "rod_model.py:buld"):
        write_experiment(folder / "other.yaml", "rod_model.py:buld")
    assert not (folder / "other.yaml").exists()


def test_a_model_that_cannot_be_named_so_is_refused_with_what_can(folder):
    with refused("model", "rod_model", "package.module:function"):
        write_experiment(folder / "other.yaml", "rod_model")
    with refused("model", "nothing:build", "must be an importable module"):
        write_experiment(folder / "other.yaml", "nothing:build")
