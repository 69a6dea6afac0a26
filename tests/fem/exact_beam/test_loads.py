"""Loads and supports of exact beams against closed forms and the differential equation."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.fem.exact_beam.cases import given
from tests.fem.exact_beam.cosserat import cantilever
from tests.refused import refused

ROD = (1e6, 1e6, 1e6, 1.0, 1.0, 1.0)


def rod(elements: int = 16) -> mbd.ExactBeam:
    return mbd.ExactBeam("rod", mbd.BeamLine.straight(1.0, elements), given(*ROD))


@pytest.mark.parametrize("which", ["line_load", "follower_line_load"])
def test_line_loads_of_small_displacements(which):
    load: Any = {which: (0.0, 1e-6, 0.0)}
    result = [rod(n).equilibrium(**load).nodes[-1, 1].item() * 8e6 for n in (5, 10)]
    assert result == pytest.approx([1.0 - 1 / 75, 1.0 - 1 / 300], abs=1e-4)  # 1 - 1 / (3 n^2)


@pytest.mark.thorough
def test_follower_loads_are_those_of_the_differential_equation():
    """A load that turns with the tip."""
    state = rod(40).equilibrium(follower_loads={"end": (0.0, 6.0, 0.0)})
    expected = cantilever(1.0, np.diag(ROD), np.zeros(3), np.array([0.0, 6.0, 0.0]), follower=True)
    assert np.abs(state.nodes[-1].numpy() - expected).max() < 5e-4


@pytest.mark.thorough
def test_a_dead_and_a_follower_moment_bend_alike_in_a_plane():
    moment = (0.0, 0.0, 0.0, 0.0, 0.0, 3.0)
    dead, follower = rod(4).equilibrium({"end": moment}), rod(4).equilibrium(follower_loads={"end": moment})
    torch.testing.assert_close(dead.nodes, follower.nodes, rtol=1e-9, atol=1e-9)


def test_pressure_on_a_ring():
    """A half ring between guided ends under pressure: it stays a half ring, N = p R."""
    line = mbd.BeamLine.arc(1.0, math.pi, 12)
    beam = mbd.ExactBeam("ring", line, given(*ROD), orientation=(0.0, 0.0, 1.0))
    held = {"start": "u1 u3 phi1 phi2 phi3", "end": "u1 u3 phi1 phi2 phi3", "center": "u2"}
    state = beam.equilibrium(follower_line_load=(0.0, 0.0, 2.0), supports=held)  # outward
    assert state.status == "ok"
    assert state.forces[..., 0].mean().item() == pytest.approx(2.0, rel=2e-2)
    assert float(state.forces[..., 4].abs().max()) < 0.02


def test_gravity_and_spin():
    """N = mass (L - x) g for a hanging rod, mass w^2 (L^2 - x^2) / 2 for a spinning one, lumped at the nodes."""
    mass = torch.diag(torch.tensor([3.0, 3.0, 3.0, 2e-6, 1e-6, 1e-6], dtype=torch.float64))
    beam = mbd.ExactBeam("rod", mbd.BeamLine.straight(2.0, 10), given(*ROD, mass=mass))
    hung = beam.equilibrium(gravity=(9.81, 0.0, 0.0))
    assert hung.forces[0, 0, 0].item() == pytest.approx(3.0 * (2.0 - 0.1) * 9.81, rel=1e-6)
    assert hung.reactions[0, 0].item() == pytest.approx(-3.0 * 2.0 * 9.81, rel=1e-6)
    spun = beam.equilibrium(spin=(0.0, 0.0, 5.0))
    assert spun.forces[0, 0, 0].item() == pytest.approx(3.0 * 25.0 * 2.0, rel=6e-3)
    moved = beam.equilibrium(spin=(0.0, 0.0, 5.0), center=(-1.0, 0.0, 0.0))
    # Half of the first element is held.
    assert moved.forces[0, 0, 0].item() == pytest.approx(3.0 * 25.0 * 4.0, rel=3e-2)


def test_an_eccentric_mass_twists_the_beam():
    mass = torch.diag(torch.tensor([2.0, 2.0, 2.0, 0.0, 0.0, 0.0], dtype=torch.float64))
    y = 0.01  # center of mass, along y
    mass[0, 5] = mass[5, 0] = -2.0 * y
    mass[2, 3] = mass[3, 2] = 2.0 * y
    mass[3:, 3:] = 2.0 * torch.diag(torch.tensor([2e-6 + y * y, 1e-6, 1e-6 + y * y], dtype=torch.float64))
    beam = mbd.ExactBeam("rod", mbd.BeamLine.straight(1.0, 20), given(*ROD, mass=mass))
    state = beam.equilibrium(gravity=(0.0, 0.0, -0.1))
    # M g y L^2 / 2 / (G J).
    assert math.asin(state.rotations[-1, 2, 1].item()) == pytest.approx(-0.2 * y * 0.5, rel=5e-3)


@pytest.mark.thorough
def test_imposed_ends():
    """A rod whose end is turned by half a turn and free to come along x bends to a half circle."""
    state = rod(8).equilibrium(supports={"start": "all", "end": (None, None, None, 0.0, 0.0, math.pi)})
    assert state.status == "ok"
    assert state.nodes[-1].tolist() == pytest.approx([0.0, 2.0 / math.pi, 0.0], abs=1e-9)
    assert state.reactions[-1, 5].item() == pytest.approx(math.pi, rel=1e-9)
    pulled = rod(3).equilibrium(supports={"start": "all", "end": (1e-3, 0.0, 0.0, None, None, None)})
    assert pulled.reactions[-1, 0].item() == pytest.approx(1e3, rel=1e-6)


def test_reactions_balance_the_loads():
    state = rod(6).equilibrium({3: (1.0, 2.0, 3.0), ("center", "end"): (0.0, 2.0, 0.0)}, line_load=(0.0, 0.0, 4.0))
    assert state.reactions[:, :3].sum(0).tolist() == pytest.approx([-1.0, -4.0, -7.0], abs=1e-8)


@pytest.mark.parametrize(
    ("arguments", "path"),
    [
        ({"loads": {"tip": (0.0, 1.0, 0.0)}}, "node"),
        ({"loads": {99: (0.0, 1.0, 0.0)}}, "node"),
        ({"loads": {"end": (0.0, 1.0)}}, "loads['end']"),
        ({"loads": {"end": (0.0, float("nan"), 0.0)}}, "loads['end']"),
        ({"loads": [1.0]}, "loads"),
        ({"line_load": [[0.0, 1.0, 0.0]] * 3}, "line_load"),
        ({"supports": {}}, "rod.supports"),
        ({"supports": {"start": "u4"}}, "support 'start' of 'rod'"),
        ({"supports": {"start": "u1 phi1"}}, "rod.supports.0"),
        ({"supports": {"start": (0.0, 0.0, 0.0, 0.1, 0.0, None)}}, "rod.supports.0"),
        ({"supports": {"start": (mbd.variable(0.1), 0.0, 0.0, 0.0, 0.0, 0.0)}}, "support 'start' of 'rod'"),
        ({"gravity": (0.0, 1.0)}, "gravity"),
        ({"spin": 3.0}, "spin"),
    ],
)
def test_what_is_refused(arguments, path):
    with refused(path):
        rod().equilibrium(**arguments)


@pytest.mark.parametrize(
    ("arguments", "argument"),
    [
        ({"name": ""}, "name"),
        ({"line": [[0, 0, 0]]}, "rod.line"),
        ({"section": 3.0}, "rod.section"),
        ({"twist": [0.0, 1.0]}, "rod.twist"),
        ({"offset": [0.0, 1.0, 2.0]}, "rod.offset"),
    ],
)
def test_beams_that_are_refused(arguments, argument):
    usual = {"name": "rod", "line": mbd.BeamLine.straight(1.0, 4), "section": given(*ROD)}
    with refused(argument):
        mbd.ExactBeam(**(usual | arguments))
