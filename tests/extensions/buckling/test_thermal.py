"""Buckling by a change of temperature: closed forms, zones, gradients on both routes, along a motion, and what is refused.

S. P. Timoshenko and J. M. Gere, Theory of Elastic Stability (1961): pinned column, plate under equal compression along x and y.
"""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.multibody.statics.test_vibrations import check_gradients
from tests.refused import refused
from torchmbd.extensions.buckling.buckling import BucklingCase

STEEL = mbd.Ply.isotropic(E=210e9, nu=0.3, density=7850.0, alpha=12e-6)
CARBON = mbd.Ply(128e9, 10.1e9, 5.36e9, 5.36e9, 3.6e9, 0.23, 1586.0, alpha1=-0.3e-6, alpha2=28e-6)
WALLS = {f"{side}_edge": "u1 u2 u3" for side in ("left", "right", "top", "bottom")}
KELVIN = {"temperature": 1.0}
E, AREA, I, LENGTH, ALPHA = 210e9, 1e-4, 1e-9, 2.0, 12e-6
PINNED = {"start": "u1 u2 u3 phi1", "end": "u1 u2 u3"}
BAR_BUCKLES = math.pi**2 * I / (ALPHA * AREA * LENGTH**2)  # [K], of Euler's load


def plate(laminate: mbd.Laminate, cells: tuple[int, int], kind: str = "quad") -> mbd.FlexibleBody:
    mesh = mbd.mesh.rectangle(0.8, 0.5, cells, kind)
    return mbd.FlexibleBody.plate("plate", mesh, laminate, modes=2, reference="left_edge")


def bar(**options: Any) -> mbd.FlexibleBody:
    section = mbd.GivenSection.isotropic(E, 0.3, 7850.0, AREA, I, 4.0 * I, 3.0 * I, alpha=ALPHA)
    return mbd.FlexibleBody.beam("bar", mbd.BeamLine.straight(LENGTH, 8), section, 8, reference="start", **options)


class Factors(torch.nn.Module):
    def __init__(self, body: mbd.FlexibleBody, loads: Any, changes: Any) -> None:
        super().__init__()
        self.body, self.case = body, BucklingCase(body, loads, WALLS, changes)

    def forward(self) -> torch.Tensor:
        return self.case(2).factors


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["quad", "triangle"])
def test_a_simply_supported_plate_between_walls(kind):
    """Laminated steel: N = E alpha T h / (1 - nu) on all sides, against pi^2 D (1/a^2 + 1/b^2)."""
    body = plate(mbd.Laminate(STEEL, mbd.deg([0, 30, 80]), [0.5e-3, 1e-3, 0.5e-3]), (24, 16), kind)
    expected = math.pi**2 * 2e-3**2 * (1 / 0.8**2 + 1 / 0.5**2) / (12 * ALPHA * 1.3)
    assert float(mbd.buckling.linear_buckling(body, {}, WALLS, changes=KELVIN).factors.detach()) == pytest.approx(
        expected, rel=4e-3
    )


def test_a_pinned_bar_between_walls():
    """A factor for 1 K is the temperature at which it buckles; loads and temperature that grow together share it."""
    body = bar()
    assert float(mbd.buckling.linear_buckling(body, {}, PINNED, changes=KELVIN).factors) == pytest.approx(
        BAR_BUCKLES, rel=1e-3
    )
    euler = math.pi**2 * E * I / LENGTH**2
    free = {"start": "u1 u2 u3 phi1", "end": "u2 u3"}
    both = mbd.buckling.linear_buckling(
        body, {"end": (-euler, 0.0, 0.0)}, free, changes={"temperature": 50.0}
    )  # it expands freely
    assert float(both.factors) == pytest.approx(1.0, rel=1e-3)
    assert float(both.displacements[-1, 0]) == pytest.approx(LENGTH * (50.0 * ALPHA - euler / (E * AREA)), rel=1e-3)
    cold = mbd.buckling.linear_buckling(body, {}, PINNED, changes={"temperature": -1.0})
    assert float(cold.factors) > 1e5 * BAR_BUCKLES  # its tension stiffens it


@pytest.mark.thorough
def test_zones_add_up():
    """Two halves of one plate that warm up alike; one of them alone needs more."""
    mesh = mbd.mesh.rectangle(0.8, 0.5, (6, 4))
    right = mesh.nodes[mesh.quads].mean(1)[:, 0] > 0.0
    laminate = mbd.Laminate(CARBON, mbd.deg([20, -50, 75]), 1e-3)
    zones = {name: torch.nonzero(x)[:, 0] for name, x in (("skin", right), ("root", ~right))}
    parts = {name: mbd.fem.elements.Plates(mesh, laminate, cells=cells) for name, cells in zones.items()}
    body = mbd.FlexibleBody("plate", mesh, parts, 2, reference="left_edge")
    whole = mbd.buckling.linear_buckling(body, {}, WALLS, 2, {"temperature": 1.0, "gradient": 0.0}).factors
    apart = mbd.buckling.linear_buckling(body, {}, WALLS, 2, {"temperature": {"skin": 1.0, "root": 1.0}}).factors
    assert_close(apart, whole, rtol=1e-10, atol=0)
    assert mbd.buckling.linear_buckling(body, {}, WALLS, changes={"temperature": {"skin": 1.0}}).factors[0] > whole[0]


@pytest.mark.thorough
def test_gradients_by_ply_angles():
    """Forward, reverse and by differences, of an unbalanced stack under a load and two changes."""
    body = plate(mbd.Laminate(CARBON, mbd.deg([20, -50, 75]), [1e-3, 0.7e-3, 0.9e-3]), (4, 3))
    changes = {"temperature": 30.0, "gradient": 2e3}
    check_gradients(Factors(body, {"right_edge": (0.0, 300.0, 0.0)}, changes), "body.laminate.angles", 1e-2)


@pytest.mark.thorough
def test_along_a_motion_and_as_a_measure():
    """A bar between two joints that warms up to half of the temperature at which it buckles."""
    body = bar(expansion=True, damping=0.1)
    ground = mbd.Ground()
    joints = [mbd.Fixed(ground.at(), body.at("start")), mbd.Spherical(ground.at(LENGTH, 0, 0), body.at("end"))]
    peak = mbd.variable(0.5 * BAR_BUCKLES)
    warming = mbd.forces.Scaled(peak, lambda t: 0.5 - 0.5 * torch.cos(math.pi * t))
    system = mbd.System([body], joints, [mbd.Temperature(body, warming, name="sun")], truncation=None)
    with pytest.warns(UserWarning, match="stiffening"):
        motion = mbd.simulate(system, 1.0, steps=20, backend="eager")
    index = mbd.buckling.BucklingIndex("bar", PINNED)(motion)
    assert_close(index[0].detach(), 0.25 - 0.25 * torch.cos(math.pi * motion.t), rtol=2e-3, atol=1e-4)
    index[0, -1].backward()
    assert peak.grad is not None
    assert float(peak.grad) == pytest.approx(float(index[0, -1]) / float(peak), rel=1e-6)
    static = mbd.buckling.BucklingFactor("bar", supports=PINNED, changes=KELVIN)
    assert static(motion).item() == pytest.approx(BAR_BUCKLES, rel=1e-3)


def test_what_is_wrong_is_named():
    body = plate(mbd.Laminate(CARBON, [0.3], 1e-3), (2, 2))
    for changes, path, meant in (
        (80.0, "plate.changes", ""),
        ({"temperture": 80.0}, "plate.change", "temperature"),
        ({"temperature": {"plat": 80.0}}, "plate.zone", "plate"),
        ({"temperature": "hot"}, "plate.changes.temperature", ""),
        ({"temperature": 0.0}, "plate.loads", ""),
    ):
        with refused(path, meant=meant):
            mbd.buckling.linear_buckling(body, {}, WALLS, changes=changes)  # pyright: ignore
    bare = plate(mbd.Laminate(mbd.Ply(128e9, 10.1e9, 5.36e9, 5.36e9, 3.6e9, 0.23, 1586.0), [0.3], 1e-3), (2, 2))
    with pytest.raises(mbd.InputError, match="layer 0 of the laminate, whose ply has no alpha1"):
        mbd.buckling.linear_buckling(bare, {}, WALLS, changes=KELVIN)
