"""Arguments of a wrong kind are refused by name, with their value and what is allowed: no other exception."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

import torchmbd as mbd
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
    *((lambda x=x: mbd.BeamLine.straight(x), "length of BeamLine.straight is .*; allowed: a number") for x in NUMBERS),
    *((lambda x=x: mbd.BeamLine.arc(1.0, x), "angle of BeamLine.arc is .*; allowed: a number") for x in NUMBERS),
    *(
        (lambda x=x: mbd.GivenSection.isotropic(**METAL | {"nu": x}), "nu of .* is .*; allowed: a number")
        for x in NUMBERS
    ),
    *((lambda x=x: mbd.AtTime(mbd.StrainEnergy("rod"), x), "time is .*; allowed: zero or positive") for x in NUMBERS),
    *(
        (lambda x=x: mbd.Laminate(PLY, mbd.deg([0.0]), 1e-3, shear_correction=x), "shear_correction = .*; allowed: 0 <")
        for x in NUMBERS
    ),
    *((lambda x=x: ENERGY.value(x), "motion is .*; allowed: a motion") for x in NUMBERS),
    *((lambda x=x: mbd.SectionHistory(x, "rod"), "motion is .*; allowed: a motion") for x in NUMBERS),
    *((lambda x=x: mbd.DesignSpace(x), "system is .*; allowed: a System") for x in NUMBERS),
    *((lambda x=x: build().with_joints([x]), "joints has .*; allowed: joints") for x in NUMBERS),
    *((lambda x=x: mbd.RobustProblem(BOX, 0.1, x), "kind .* does not exist; allowed: expected") for x in NUMBERS),
    *((lambda x=x: mbd.RobustProblem(BOX, x), "tolerance is .*; allowed: ") for x in NUMBERS[2:]),
    *((lambda x=x: mbd.optimize(BOX, x), "method .* does not exist; allowed: ") for x in NUMBERS),
    *(
        (lambda x=x: mbd.Laminate(x, mbd.deg([0.0]), 1e-3), r"Laminate: ply.* = .*; allowed: a Ply")
        for x in NUMBERS[5:]
    ),
    *((lambda x=x: ENERGY.value_and_gradient(x), "motion is .*; allowed: a motion") for x in NUMBERS),
    *((lambda x=x: mbd.PlyHistory(x, "rod"), "motion is .*; allowed: a motion") for x in NUMBERS),
    *((lambda x=x: mbd.Differences(x), "problem is .*; allowed: a problem") for x in NUMBERS),
    *(
        (lambda x=x: mbd.Differences(BOX, x), "step is .*; allowed: numbers")
        for x in ("x", {}, object(), [[1], [1, 2]])
    ),
    *((lambda x=x: mbd.DesignSpace(build(), links=x), "links is .*; allowed: entry") for x in NUMBERS[5:8]),
    (
        lambda: mbd.optimize_discrete(BOX, 1e-9),
        "allowed of x = 1e-09 .* 2e[+]09 values, .* bytes; allowed: up to 1000000 values",
    ),
    *((lambda x=x: mbd.problem_of(x), "file is .*; allowed: the path of a file") for x in [None, [], 3, b"x"]),
]


@pytest.mark.parametrize(("call", "words"), CASES, ids=[str(k) for k in range(len(CASES))])
def test_it_is_refused_by_name(call, words):
    with pytest.raises(InputError, match=words):
        call()
