"""Laminates by lamination parameters: equal to stacks of plies, fields, bad input."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.refused import refused
from torchmbd.extensions.lamination.conditions import directions

CARBON = mbd.Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=3.6e9, nu12=0.23, density=1586.0)


def parameters_of(angles: torch.Tensor, thickness: torch.Tensor) -> dict[str, torch.Tensor]:
    """By integration over the plies."""
    h = thickness.sum()
    top = thickness.cumsum(0) - h / 2
    V, z = directions(angles), torch.stack([top - thickness, top])
    weights = {
        "membrane": (z[1] - z[0]) / h,
        "coupling": 2 * (z[1] ** 2 - z[0] ** 2) / h**2,
        "bending": 4 * (z[1] ** 3 - z[0] ** 3) / h**3,
    }
    return {name: w @ V for name, w in weights.items()}


def test_stiffness_and_mass_are_those_of_the_stack():
    angles, t = torch.tensor([0.3, -1.2, 0.9, 0.1]).double(), torch.tensor([1e-3, 2e-3, 0.5e-3, 1e-3]).double()
    stack = mbd.Laminate(CARBON, angles, t, shear_correction=5 / 6)
    own = mbd.lamination.LaminationParameters(CARBON, float(t.sum()), **parameters_of(angles, t))
    one, two = stack.stiffness(), own.stiffness()
    for name in ("A", "B", "D", "As"):
        scale = float(getattr(one, name).abs().max())
        assert_close(getattr(two, name), getattr(one, name), rtol=0, atol=1e-12 * scale)
    assert_close(own.mass_per_area, stack.mass_per_area)
    assert_close(own.rotary_inertia_per_area, stack.rotary_inertia_per_area)


def plate(laminate: mbd.Laminate, mesh: mbd.Mesh) -> mbd.FlexibleBody:
    return mbd.FlexibleBody.plate("panel", mesh, laminate, modes=3, reference="left_edge")


def squares(body: mbd.FlexibleBody) -> torch.Tensor:
    """Of the circular frequencies."""
    return body.structure()["Kr"].diagonal().detach()


@pytest.mark.thorough
def test_frequencies_are_those_of_the_stack_also_by_fields():
    mesh = mbd.mesh.rectangle(0.4, 0.2, cells=(6, 3))
    angles, t = mbd.deg([30.0, -50.0, -50.0, 30.0]), torch.full((4,), 5e-4, dtype=torch.float64)
    known = parameters_of(torch.as_tensor(angles), t)
    expected = squares(plate(mbd.Laminate(CARBON, angles, t, shear_correction=5 / 6), mesh))
    own = mbd.lamination.LaminationParameters(CARBON, 2e-3, known["membrane"], known["bending"])
    assert_close(squares(plate(own, mesh)), expected, rtol=1e-8, atol=0)
    field = mbd.fibers.FiberField(mesh, (3, 2), degree=1)
    varied = mbd.lamination.LaminationParameters(CARBON, [2e-3] * 6, known["membrane"], known["bending"], field=field)
    assert [(name, tuple(x.shape)) for name, x in plate(varied, mesh).named_parameters()] == [
        ("laminate.membrane", (6, 4)),
        ("laminate.bending", (6, 4)),
        ("laminate.thickness", (6,)),
    ]
    assert_close(squares(plate(varied, mesh)), expected, rtol=1e-8, atol=0)


def test_bending_follows_membrane_where_it_is_not_given():
    own = mbd.lamination.LaminationParameters(CARBON, 2e-3, [0.1, 0.0, 0.2, 0.0])
    X = own.stiffness()
    assert_close(X.D, X.A * 2e-3**2 / 12)
    assert list(dict(own.named_parameters())) == ["membrane", "thickness"]


def test_what_needs_plies_says_that_there_are_none():
    mesh = mbd.mesh.rectangle(0.4, 0.2, cells=(4, 2))
    panel = plate(mbd.lamination.LaminationParameters(mbd.examples.carbon(), 2e-3, [0.0] * 4), mesh)
    system = mbd.System([panel], [mbd.Fixed(mbd.Ground().at(), panel.at("left_edge"), name="wall")])
    motion = mbd.simulate(system, 1e-3, steps=2)
    with refused("laminate"):
        mbd.Max(mbd.PlyFailure("panel"))(motion)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"membrane": [0.6, 0.6, 0.6, 0.6]}, "no stack has these"),
        ({"membrane": [0.0, 0.0, -1.2, 0.0]}, "membrane = "),
        ({"membrane": [0.0] * 4, "bending": [0.9, 0.0, 0.7, 0.0]}, "bending = "),
        ({"membrane": [1.0, 0.0, 1.0, 0.0], "coupling": [0.3, 0.0, 0.0, 0.0]}, "coupling = "),
        ({"membrane": [0.0] * 3}, "[4]"),
        ({"membrane": [0.0] * 4, "thickness": 0.0}, "thickness"),
        ({"membrane": [0.0] * 4, "thickness": [1e-3, 2e-3]}, "one for each control"),
        ({"membrane": [0.0] * 4, "ply": "carbon"}, "ply"),
        ({"membrane": [0.0] * 4, "ply": dataclasses.replace(CARBON, E1=mbd.variable(128e9))}, "numbers that vary"),
        ({"membrane": [0.0] * 4, "field": 3}, "field"),
        ({"membrane": [0.0] * 4, "shear_correction": 2.0}, "shear_correction"),
        ({"membrane": [5.0, 0.0, 5.0, 0.0], "checked": False}, "positive definite"),
    ],
)
def test_bad_input(options, words):
    given = {"ply": CARBON, "thickness": 2e-3} | options
    with pytest.raises(mbd.InputError) as result:
        mbd.lamination.LaminationParameters(**given)
    assert words in str(result.value)


def test_an_infeasible_control_is_named():
    field = mbd.fibers.FiberField(mbd.mesh.rectangle(0.4, 0.2, cells=(4, 2)), (2, 1), degree=1)
    with refused("membrane.1"):
        mbd.lamination.LaminationParameters(
            CARBON, 2e-3, [[0.0] * 4, [0.0, 0.0, math.nextafter(1.1, 2), 0.0]], field=field
        )
