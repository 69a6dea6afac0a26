"""Loads that are borne and loads that are not: buckling, limit points, elements that turn too far."""

from __future__ import annotations

import math

import pytest
import scipy.sparse
import torch

import torchmbd as mbd
from tests.fem.exact_beam.cases import given
from torchmbd.fem.exact_beam.continuation import negative_pivots

PINNED = {"start": "u1 u2 u3 phi1 phi2", "end": "u1 u2 u3 phi1 phi2"}


def column() -> mbd.ExactBeam:
    return mbd.ExactBeam("column", mbd.BeamLine.straight(2.0, 12), given(1e8, 1e8, 1e8, 1e3, 100.0, 200.0))


def arch() -> mbd.ExactBeam:
    """Shallow, 0.4 rad of a circle of 1 m; a load towards its center makes it snap through."""
    return mbd.ExactBeam("arch", mbd.BeamLine.arc(1.0, 0.4, 16), given(1e6, 1e6, 1e6, 50.0, 50.0, 50.0))


def inward(load: float) -> dict:
    return {"center": (-load * math.sin(0.2), load * math.cos(0.2), 0.0)}


@pytest.mark.thorough
@pytest.mark.parametrize("times", [2.0, 40.0])
def test_a_straight_column_ends_at_its_buckling_load(times):
    euler = math.pi**2 * 100.0 / 16.0
    state = column().equilibrium({"end": (-times * euler, 0.0, 0.0)})
    assert state.status.startswith("unstable: the beam buckles at")
    assert state.factor.item() == pytest.approx(1.0 / times, rel=2e-3)
    assert bool(state.nodes.isnan().all())
    assert bool(state.forces.isnan().all())
    assert state.path[0][-1] == state.factor


def test_an_unstable_equilibrium_is_followed_where_that_is_asked_for():
    euler = math.pi**2 * 100.0 / 16.0
    state = column().equilibrium({"end": (-2.0 * euler, 0.0, 0.0)}, unstable=True)
    assert state.status == "ok"
    assert state.nodes[-1].tolist() == pytest.approx([2.0 - 4.0 * euler / 1e8, 0.0, 0.0], abs=1e-8)


@pytest.mark.thorough
def test_beyond_buckling_with_an_imperfection():
    """The elastica: at 1.293 times Euler's load the tip has turned by 80 degrees (Timoshenko and Gere, table 2-4)."""
    euler = math.pi**2 * 100.0 / 16.0
    state = column().equilibrium({"end": (-1.293 * euler, 0.0, 1e-4)})
    assert state.status == "ok"
    angle = math.acos(state.rotations[-1, 0, 0].item())
    assert math.degrees(angle) == pytest.approx(80.0, rel=0.01)
    assert state.nodes[-1, 0].item() / 2.0 == pytest.approx(0.560, rel=0.01)


@pytest.mark.thorough
def test_lateral_buckling():
    beam = mbd.ExactBeam("strip", mbd.BeamLine.straight(1.0, 16), given(1e8, 1e8, 1e8, 0.5, 1e4, 1.0))
    state = beam.equilibrium({"end": (0.0, 0.0, 2.0 * 4.0126 * math.sqrt(0.5))})
    assert "buckles" in state.status
    assert state.factor.item() == pytest.approx(0.5, rel=3e-3)


@pytest.mark.thorough
def test_a_limit_point_is_found_and_named():
    """No jump to the inverted arch, however large the load; its limit is that of the path of the apex pressed inward."""
    load = 2e4
    state = arch().equilibrium(inward(load), supports=PINNED)
    assert state.status.startswith("limit point")
    assert state.factor.item() * load == pytest.approx(1018.0, rel=2e-3)
    assert arch().equilibrium(inward(1000.0), supports=PINNED).status == "ok"


@pytest.mark.thorough
def test_the_limit_point_by_displacements_of_the_apex():
    """Its largest reaction is the limit load of the test above."""
    reactions = []
    axis = torch.tensor([-math.sin(0.2), math.cos(0.2), 0.0], dtype=torch.float64)
    for depth in (0.01, 0.0125, 0.015):
        held = (*(depth * axis).tolist(), None, None, None)
        state = arch().equilibrium(supports=PINNED | {"center": held}, unstable=True)
        assert state.status == "ok"
        reactions.append(float(axis @ state.reactions[8, :3]))
    assert max(reactions) == pytest.approx(1018.0, rel=3e-3)


@pytest.mark.thorough
def test_an_element_that_turns_too_far_is_named():
    beam = mbd.ExactBeam("rod", mbd.BeamLine.straight(1.0, 3), given(1e6, 1e6, 1e6, 1.0, 1.0, 1.0))
    state = beam.equilibrium({"end": (0.0, 0.0, 0.0, 0.0, 0.0, 100.0)})
    assert "turns by more than 2.6 rad" in state.status
    assert 100.0 * state.factor.item() / 3.0 == pytest.approx(2.6, rel=0.25)


@pytest.mark.thorough
def test_no_convergence_is_a_status():
    """An end that is pressed in by half of the length, straight: the beam buckles at 1e-6 of that."""
    state = column().equilibrium(supports={"start": "all", "end": (-1.0, 0.0, 0.0, 0.0, 0.0, 0.0)})
    assert state.status != "ok"
    assert state.factor.item() < 1e-3


def test_negative_pivots_are_negative_eigenvalues():
    A = torch.randn(12, 12, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    K = (A + A.T).numpy()
    expected = int((torch.linalg.eigvalsh(torch.from_numpy(K)) < 0.0).sum())
    assert negative_pivots(scipy.sparse.csc_array(K)) == expected
