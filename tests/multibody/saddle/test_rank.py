"""Rank of constraint Jacobians: random ones of known rank, rows by name, the parallelogram in line."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.mechanisms import box, laminate, plate
from tests.multibody.start.test_initial import four_bar
from tests.refused import ANY, refused, warned
from torchmbd.multibody.saddle.rank import dominant_rows, jacobians, rank_of


@pytest.mark.parametrize("dependent", [(), (4,), (1, 3, 16)])
def test_rows_that_depend_on_others_are_found(dependent):
    """A random Jacobian of full rank in which some rows are made combinations of the others."""
    T = four_bar().topology
    make = np.random.default_rng(len(dependent))
    J = make.standard_normal((T.rows, 2 * T.rows)) * 10.0 ** make.uniform(-3, 3, (T.rows, 1))
    others = [i for i in range(T.rows) if i not in dependent]
    for i in dependent:
        J[i] = make.standard_normal(3) @ J[make.choice(others, 3, replace=False)]
    result = rank_of(T, J)
    assert result.rank == T.rows - len(dependent)
    assert len(result.redundant) == len(dependent)
    left = [i for i, name in enumerate(T.row_names) if name not in result.redundant]
    assert np.linalg.matrix_rank(J[left] / np.linalg.norm(J[left], axis=1, keepdims=True)) == result.rank


def test_of_equal_rows_the_first_stays_whatever_the_rounding():
    """Lanes and phases of one system must not leave out different rows: the motion would jump from one to the other."""
    T = four_bar().topology
    make = np.random.default_rng(1)
    J = make.standard_normal((T.rows, 2 * T.rows))
    J[7], J[12] = J[3], J[3] - 2.0 * J[5]
    result = {rank_of(T, J * (1.0 + 1e-13 * make.standard_normal(J.shape))).redundant for _ in range(20)}
    assert result == {(T.row_names[7], T.row_names[12])}


def test_a_drive_comes_last():
    """Of a hinge and a drive along it nothing is redundant; a second hinge is, not the drive."""
    ground, a = mbd.Ground(), box("a")
    hinges = [mbd.Revolute(ground.at(0, 0, z), a.at(0, 0, z), name=f"hinge_{z}") for z in (0, 1)]
    dynamics = mbd.System([a], [mbd.Drive(ground, a, speed=1.0, name="motor"), *hinges])().dynamics
    assert len(dynamics.redundant) == 5
    assert all(name.startswith("hinge") for name in dynamics.redundant)


@pytest.mark.thorough
def test_the_multipliers_of_redundant_rows_are_those_of_least_norm():
    """Two equal hinges share the weight in halves: each row carries what its twin carries."""
    ground, a = mbd.Ground(), box("a")
    hinges = [mbd.Revolute(ground.at(), a.at(), name=name) for name in ("one", "other")]
    motion = mbd.simulate(mbd.System([a], hinges, gravity=(1.0, -9.0, 2.0)), 0.02, steps=40).require_ok()
    one, other = (motion.reaction(name) for name in ("one", "other"))
    single = mbd.System([a], hinges[:1], gravity=(1.0, -9.0, 2.0))
    alone = mbd.simulate(single, 0.02, steps=40).require_ok().reaction("one")
    for kind in ("force", "torque"):
        parts = [getattr(x, kind) for x in (one, other, alone)]
        size = float(parts[2].abs().max())
        assert float((parts[0] - parts[1]).abs().max()) < 1e-6 * size
        assert float((parts[0] + parts[1] - parts[2]).abs().max()) < 1e-6 * size


def test_the_rows_that_are_lost_in_line_are_those_along_the_line():
    ground, a, b = mbd.Ground(), box("a"), box("b", position=(1.0, 0.0, 0.0))
    joints = [
        mbd.Revolute(ground.at(), a.at(), name="left"),
        mbd.Revolute(a.at(1.0, 0.0, 0.0), b.at(), name="middle"),
        mbd.DistanceJoint(ground.at(2.0, 0.0, 0.0), b.at(0.5, 0.0, 0.0), 0.5, name="rod"),
    ]
    dynamics = mbd.System([a, b], joints)().dynamics
    T = dynamics.topology
    J = jacobians(dynamics, dynamics.initial.q[None], torch.zeros(1).double())[0]
    U, s, _ = torch.linalg.svd(J)
    assert float(s[-1]) < 1e-12 < 1e-3 < float(s[-2])
    named = dominant_rows(T, U[:, -1])
    assert "rod: distance" in named
    assert not any("perpendicular" in name or name.endswith(("y", "z")) for name in named)


def test_a_travel_that_a_fixed_joint_holds_is_named():
    a, ground = box("a"), mbd.Ground()
    joints = [mbd.Fixed(ground.at(), a.at()), mbd.Drive(ground, a, axis="x", velocity=1.0, name="pusher")]
    with refused("pusher: travel", ANY, "a drive along a motion"):
        _ = mbd.System([a], joints)().dynamics.redundant


CORNERS = ("corner_left_bottom", "corner_left_top")


def hung(angles: tuple[float, float], modes: int = 4, **reduction) -> mbd.System:
    """A plate on two points of one end, which no mode of vibration stretches; modes of an unsymmetric one do a little."""
    body = plate("plate", modes, made_of=laminate(angles), **reduction)
    ground = mbd.Ground()
    places = zip((-0.05, 0.05), CORNERS, strict=True)
    return mbd.System([body], [mbd.Spherical(ground.at(-0.15, y, 0.0), body.at(k), name=k) for y, k in places])


@pytest.mark.thorough
def test_rows_that_only_coupled_bending_tells_apart_are_named():
    """Symmetric: the second is left out. Unsymmetric by a little: both act, and share the little; joints' modes help."""
    assert hung((0.0, 0.0))().dynamics.rank.left_out
    for difference, most in ((0.001, 1e-5), (1.0, 1e-2)):
        system = hung((difference, -difference))
        with warned("corner_left_bottom: coincide y", "craig-bampton"):
            result = system().dynamics.rank
        assert {name.partition(":")[0] for name in result.weak} == set(CORNERS)
        assert 1e-9 < result.share < most
        assert not result.left_out
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not hung((1.0, -1.0), reduction="craig-bampton", interface=CORNERS)().dynamics.rank.weak
