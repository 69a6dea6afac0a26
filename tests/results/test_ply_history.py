"""Plies along a motion: against direct recovery, and the gradient of the failure index against differences."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import SOFT, pendulum
from tests.refused import refused, warned
from torchmbd.design.ply_failure import PlyFailure, PlyStress
from torchmbd.fem.elements import ply_basis
from torchmbd.fem.materials import CRITERIA, Ply, Strength
from torchmbd.integrate import Trajectory
from torchmbd.math.variable import LayerNumbers
from torchmbd.results.ply_history import PlyHistory

STRENGTH = Strength(Xt=1.5e6, Xc=1.2e6, Yt=4e4, Yc=2.5e5, S12=7e4, S13=6e4, S23=5e4)
STEP = 1e-5


def system() -> mbd.System:
    """The pendulum with a strength given to its plies, upper and lower one different."""
    result = pendulum()
    laminate: Any = result.body("rod").laminate
    weaker = dataclasses.replace(STRENGTH, Yt=3e4)
    laminate._plies = LayerNumbers(laminate, "ply", (Ply(**SOFT, strength=STRENGTH), Ply(**SOFT, strength=weaker)))
    return result


@pytest.fixture(scope="module")
def motions() -> tuple[Trajectory, Trajectory]:
    """Two designs with sensitivities, and their neighbors as lanes."""
    result, options = system(), {"steps": 40, "iterations": (6, 6), "refresh": 1}
    angles = mbd.deg([[20.0, -50.0], [70.0, 15.0]])
    steps = STEP * torch.eye(2, dtype=torch.float64)
    near = torch.cat([angles[:, None] + steps, angles[:, None] - steps], 1).flatten(0, 1)
    return tuple(
        mbd.simulate(result, 0.04, gradients=way, designs={"rod.laminate.angles": x}, **options).require_ok()
        for way, x in (("forward", angles), ("none", near))
    )


@pytest.mark.thorough
def test_the_basis_gives_the_plies_of_the_displacements(motions):
    """Stress by the modal basis is the stress of the deformed mesh, in a lane with its own angles."""
    motion, lane, time = motions[0], 1, 17
    plies, view = PlyHistory(motion, "rod"), motion.body("rod")
    body = motion.system.body("rod")
    field = torch.einsum("nim,m->ni", view.psi[lane], view.w[lane, time])[..., None]
    own = pendulum(torch.rad2deg(motion.designs["rod.laminate.angles"][lane]).tolist()).body("rod").laminate
    direct = ply_basis(body.matrices, own, field)
    scale = float(direct.stress.detach().abs().max())
    assert scale > 0
    assert_close(plies.stress()[lane, time], direct.stress[..., 0].detach(), rtol=1e-9, atol=1e-9 * scale)
    assert_close(plies.stress(slice(15, 20))[lane, 2], plies.stress()[lane, time])
    assert_close(plies.strain()[lane, time], direct.strain[..., 0].detach(), rtol=1e-9, atol=1e-18)


@pytest.mark.parametrize("criterion", CRITERIA)
def test_the_failure_index_is_the_largest_of_all_points(criterion, motions):
    plies = PlyHistory(motions[0], "rod")
    everywhere = CRITERIA[criterion](plies.stress(), plies.strength[:, None])
    assert_close(plies.indices(criterion, slice(3, 5)), everywhere[:, 3:5])
    assert_close(plies.failure(criterion), everywhere.amax(-1), rtol=1e-12, atol=1e-15)
    place = plies.critical(criterion)
    assert plies.points[place].shape == (2, 41, 3)
    assert float(everywhere.amax()) > 1e-3


@pytest.mark.thorough
@pytest.mark.parametrize("criterion", CRITERIA)
def test_gradient_of_the_history_against_differences(criterion, motions):
    """Where the critical point is the same on both sides; elsewhere the index has a kink."""
    history = PlyFailure("rod", criterion)
    value, gradient = history.series(motions[0])
    up, down = history.values(motions[1]).unflatten(0, (2, 2, 2)).unbind(1)
    expected = ((up - down) / (2 * STEP)).movedim(1, -1)
    place = PlyHistory(motions[1], "rod").critical(criterion).unflatten(0, (2, 4))
    unique = (place == place[:, :1]).all(1)
    assert float(unique.double().mean()) > 0.9
    scale = float(expected[unique].abs().max())
    assert scale > 1e-3
    assert_close(gradient[unique], expected[unique], rtol=0, atol=1e-6 * scale)
    assert value.shape == (2, 41)


def test_extreme_stresses_are_those_of_all_points(motions):
    motion = motions[0]
    plies = PlyHistory(motion, "rod")
    along, shear = plies.stress()[..., 0], plies.stress()[..., 2]
    upper = plies.points[:, 1] == 1
    assert_close(PlyStress("rod", "11").values(motion), along.amax(-1), rtol=1e-12, atol=0)
    lowest = PlyStress("rod", "12", layer=1, extreme="lowest").values(motion)
    assert_close(lowest, shear[..., upper].amin(-1), rtol=1e-12, atol=0)
    assert (lowest < 0.0).any()


@pytest.mark.parametrize(
    ("given", "path"),
    [
        ({"component": "33"}, "stress component"),
        ({"component": "11", "extreme": "high"}, "extreme"),
        ({"component": "11", "layer": 2}, "layer"),
        ({"component": "11", "layer": True}, "layer"),
    ],
)
def test_stresses_that_are_not_there_are_named(given, path, motions):
    with refused(path):
        PlyStress("rod", **given).check(motions[0].system)


def test_a_constraint_on_the_peak(motions):
    measure = mbd.Max(PlyFailure("rod", "tsai_wu_irf"))
    value, gradient = measure.value_and_gradient(motions[0])
    up, down = measure.value(motions[1]).unflatten(0, (2, 2, 2)).unbind(1)
    expected = ((up - down) / (2 * STEP)).movedim(1, -1)
    assert_close(gradient, expected, rtol=0, atol=1e-5 * float(expected.abs().max()))
    assert float(value.min()) > 0


def test_the_door_names_what_is_missing(motions):
    with refused("criterion", "tsai_wo", meant="tsai_wu"):
        PlyFailure("rod", "tsai_wo").check(motions[0].system)
    with refused("body", "arm"):
        PlyFailure("arm").check(motions[0].system)
    with refused("body", "rod"):
        PlyFailure("rod").check(pendulum())
    plies = PlyHistory(motions[0], "rod")
    for criterion in ("x", ["tsai_wu"]):
        with refused("criterion"):
            plies.failure(criterion)
        with refused("criterion"):
            plies.modes(criterion)
    with refused("lane", 9):
        plies.modes(lane=9)
    with refused("component", -1):
        plies.extreme(-1)
    with refused("layer", 2):
        plies.extreme(0, layer=2)


@pytest.mark.thorough
@pytest.mark.parametrize(("layers", "thickness"), [(2, 8e-3), (4, 8e-3), (4, 1e-3)])
def test_shear_between_layers_of_a_cantilever(layers, thickness):
    """tau = 3 V / (2 w t) in the middle, three quarters of it at a quarter of the thickness, nothing at the faces."""
    strength = mbd.Strength(1.5e9, 1.2e9, 50e6, 250e6, 70e6, S13=60e6, S23=60e6)
    ply = mbd.Ply(128e9, 10.1e9, 5.36e9, 5.36e9, 3.6e9, 0.23, 1586.0, strength=strength)
    mesh = mbd.mesh.rectangle(length=0.2, width=0.05, cells=(16, 8))
    laminate = mbd.Laminate([ply] * layers, [0.0] * layers, [thickness / layers] * layers)
    ends = {"root": mbd.Interface("left_edge", rigid=True), "tip": mbd.Interface("right_edge", rigid=True)}
    options: dict = {"reduction": "craig-bampton", "reference": "center", "modes": 0, "interface": ends}
    arm = mbd.FlexibleBody.plate("arm", mesh, laminate, **options)
    joint = mbd.Fixed(mbd.Ground().at(-0.1, 0.0, 0.0), arm.at("root"))
    rest = mbd.equilibrium(mbd.System([arm], [joint], [mbd.Force(arm.at("tip"), (0.0, 0.0, 10.0))]))
    plies = mbd.PlyHistory(rest, "arm")
    index, (cell, layer, face) = plies.indices("interlaminar")[0, 0], plies.points.T
    middle = mesh.nodes[mesh.quads].mean(1)[:, 0].abs() < 0.05
    inside = middle[cell]
    expected = 1.5 * 10.0 / (0.05 * thickness) / 60e6
    height = (layer + face) / layers
    for z, share in ((0.0, 0.0), (0.25, 0.75), (0.5, 1.0), (1.0, 0.0)):
        here = index[inside & (height == z)]
        if len(here):
            assert float(here.mean()) == pytest.approx(share * expected, rel=0.02, abs=1e-9)
    index_of = mbd.PlyFailure("arm", "interlaminar")
    index_of.check(rest.system)
    assert plies.modes("interlaminar") == ["shear between layers"]
    assert float(index_of(rest)) == pytest.approx(float(index.max()), rel=1e-12)


@pytest.mark.thorough
def test_interlaminar_needs_a_strength_of_shear():
    system = mbd.examples.arm()
    motion = mbd.simulate(system, 0.01, steps=4)
    index = mbd.PlyFailure("arm", "interlaminar")
    with refused("criterion", "interlaminar"):
        index.check(system)
    assert float(mbd.Max(mbd.PlyFailure("arm", "puck"))(motion)) > 0.0


@pytest.mark.thorough
def test_long_triangles_are_warned_of():
    strength = mbd.Strength(1.5e9, 1.2e9, 50e6, 250e6, 70e6, S13=60e6)
    ply = mbd.Ply(128e9, 10.1e9, 5.36e9, 5.36e9, 3.6e9, 0.23, 1586.0, strength=strength)
    mesh = mbd.mesh.rectangle(length=0.5, width=0.05, cells=(20, 2), kind="triangle")
    body = mbd.FlexibleBody.plate("arm", mesh, mbd.Laminate([ply], [0.0], 2e-3), modes=2)
    with warned("body 'arm'", "9 times"):
        mbd.PlyFailure("arm", "interlaminar").check(mbd.System([body]))
