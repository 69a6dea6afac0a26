"""Arguments of a wrong kind are refused by name, with their value and what is must be no other exception."""

from __future__ import annotations

import re
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.refused import refused
from tests.study.rod_model import build
from torchmbd.errors import InputError
from torchmbd.fem.mesh import rectangle

ENERGY = mbd.Integral(mbd.StrainEnergy("rod"))
PLY = mbd.Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=5.36e9, nu12=0.23, density=1586.0)
METAL = {"E": 70e9, "nu": 0.3, "density": 2700.0, "area": 1e-4, "Iyy": 1e-9, "Izz": 1e-9, "J": 2e-9}
BOX = SimpleNamespace(
    names=["x"], start=np.zeros(1), lower=-np.ones(1), upper=np.ones(1), evaluate=lambda X, gradients: []
)
MESH = rectangle(length=0.3, width=0.06, cells=(4, 2))
NUMBERS = [None, "1", [], [1.0, 2.0], {}, b"1", object(), int, 1j, torch.zeros(3), np.array(["a"])]

CASES = [
    *((lambda x=x: mbd.BeamLine.straight(x), "length") for x in NUMBERS),
    *((lambda x=x: mbd.BeamLine.arc(1.0, x), "angle") for x in NUMBERS),
    *((lambda x=x: mbd.GivenSection.isotropic(**METAL | {"nu": x}), "nu") for x in NUMBERS),
    *((lambda x=x: mbd.AtTime(mbd.StrainEnergy("rod"), x), "time") for x in NUMBERS),
    *((lambda x=x: mbd.Laminate(PLY, mbd.deg([0.0]), 1e-3, shear_correction=x), "shear_correction") for x in NUMBERS),
    *((lambda x=x: ENERGY.value(x), "motion") for x in NUMBERS),
    *((lambda x=x: mbd.SectionHistory(x, "rod"), "motion") for x in NUMBERS),
    *((lambda x=x: mbd.DesignSpace(x), "system") for x in NUMBERS),
    *((lambda x=x: build().with_joints([x]), "joints") for x in NUMBERS),
    *((lambda x=x: mbd.optimization.RobustProblem(BOX, 0.1, x), "kind") for x in NUMBERS),
    *((lambda x=x: mbd.optimization.RobustProblem(BOX, x), "tolerance") for x in NUMBERS[2:]),
    *((lambda x=x: mbd.optimize(BOX, x), "method") for x in NUMBERS),
    *((lambda x=x: mbd.Laminate(x, mbd.deg([0.0]), 1e-3), "ply") for x in NUMBERS[5:]),
    *((lambda x=x: ENERGY.value_and_gradient(x), "motion") for x in NUMBERS),
    *((lambda x=x: mbd.PlyHistory(x, "rod"), "motion") for x in NUMBERS),
    *((lambda x=x: mbd.Differences(x), "problem") for x in NUMBERS),
    *((lambda x=x: mbd.Differences(BOX, x), "step") for x in ("x", {}, object(), [[1], [1, 2]])),
    *((lambda x=x: mbd.DesignSpace(build(), links=x), "links") for x in NUMBERS[5:8]),
    *((lambda x=x: mbd.problem_of(x), "file") for x in [None, [], 3, b"x"]),
]


@pytest.mark.parametrize(("call", "argument"), CASES, ids=[str(k) for k in range(len(CASES))])
def test_it_is_refused_with_the_path_of_the_argument(call, argument):
    with pytest.raises(InputError) as error:
        call()
    assert argument in re.split(r"\W+", error.value.argument), error.value
    assert error.value.allowed or error.value.hint, error.value


def test_a_grid_of_too_many_values_is_refused_with_their_number():
    with refused("allowed.x"):
        mbd.optimization.optimize_discrete(BOX, 1e-9)
