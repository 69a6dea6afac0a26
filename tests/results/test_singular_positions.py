"""Singular positions are found, timed and named: four-bars that fold flat, and a crank that locks its slider."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.mechanisms import SOFT, pendulum, plate, tensor
from tests.refused import warned
from tests.validation.rigid_benchmarks import n_four_bar, n_four_bar_at
from torchmbd.diagnosis.failures import name_singular_positions
from torchmbd.results import singular_positions
from torchmbd.results.time_rows import TensorSignals


@pytest.fixture(scope="module")
def folding() -> mbd.Trajectory:
    return mbd.simulate(n_four_bar(), 0.8, method="dopri5", steps=80, rtol=1e-8, atol=1e-9).require_ok()


def test_a_flat_four_bar_is_singular_where_it_lies_flat(folding):
    """The uprights lie flat at 90 degrees: the time from the closed solution, to an output interval."""
    t = np.linspace(0.0, 0.8, 100001)
    flat = float(t[np.abs(n_four_bar_at(t) - np.pi / 2).argmin()])
    (result,) = folding.singular_positions()
    assert result.t == pytest.approx(flat, abs=0.6 * float(folding.t[1]))
    assert result.value < 2e-2
    joints = {row.partition(":")[0] for row in result.rows}
    assert joints & {f"{name}_{k}" for name, n in (("foot", 3), ("left", 2), ("right", 2)) for k in range(n)}
    assert f"singular position near t = {result.t:.6g} s (lane 0" in str(result)
    assert "depend on each other" in str(result)


def test_a_motion_that_failed_says_where(folding):
    gone = folding.t[:, None] > 0.755
    states = {name: torch.where(gone, torch.nan, getattr(folding, name)) for name in ("q", "v", "a", "lam")}
    status = ["failed: the motion is not finite from t = 0.76 s on"]
    failed = replace(folding, signals=TensorSignals(states), status=status)
    name_singular_positions(failed)
    (status,) = failed.status
    assert status.startswith("failed: the motion is not finite from t = 0.76 s on; singular position near t = 0.71")


def test_some_states_of_a_long_motion_say_whether_all_are_worth_a_look(folding, monkeypatch):
    """Ten states of a motion that folds once see it; a motion far from any singular position is left after them."""
    monkeypatch.setattr(singular_positions, "_SAMPLES", 10)
    assert singular_positions.may_be_near(folding, 0)
    assert len(folding.singular_positions()) == 1
    motion = mbd.simulate(mbd.examples.pendulum(), 0.02, steps=40).require_ok()
    assert not singular_positions.may_be_near(motion, 0)


@pytest.mark.thorough
def test_a_regular_motion_has_none():
    motion = mbd.simulate(pendulum(), 0.02, steps=40).require_ok()
    assert motion.singular_positions() == []


@pytest.mark.thorough
@pytest.mark.usefixtures("compiled")
def test_a_slider_driven_through_its_dead_point_fails_with_a_word():
    """The slider of a slider-crank cannot be driven past the stretched position of the crank: the run ends there."""
    ground = mbd.Ground()
    crank = mbd.RigidBody("crank", 0.1, (1e-4, 1e-4, 1e-4), axes=_about_z(0.6))
    joint = crank.axes @ torch.tensor([0.2, 0.0, 0.0]).double()
    end = float(joint[0]) + (0.25 - float(joint[1]) ** 2) ** 0.5
    tilt = -float(torch.asin(joint[1] / 0.5))
    rod = mbd.RigidBody("rod", 0.1, (1e-4, 1e-4, 1e-4), position=joint, axes=_about_z(tilt))
    slider = mbd.RigidBody("slider", 0.1, (1e-4, 1e-4, 1e-4), position=(end, 0.0, 0.0))
    joints = [
        mbd.Revolute(ground.at(), crank.at(), name="main"),
        mbd.Revolute(crank.at(0.2, 0.0, 0.0), rod.at(), name="big_end"),
        mbd.Spherical(rod.at(0.5, 0.0, 0.0), slider.at(), name="small_end"),
        mbd.Prismatic(ground.at(end, 0.0, 0.0), slider.at(), axis="x", name="guide"),
        mbd.Drive(ground.at(end, 0.0, 0.0), slider.at(), axis="x", velocity=0.5, name="pusher"),
    ]
    system = mbd.System([crank, rod, slider], joints)
    reach = (0.7 - end) / 0.5
    for method, options in (("generalized_alpha", {}), ("generalized_alpha", {"iterations": (4, 2)}), ("rk4", {})):
        motion = mbd.simulate(system, 1.5 * reach, steps=60, method=method, **options)
        assert motion.status[0].startswith("failed")
        near = float(motion.status[0].partition("near t = ")[2].partition(" s")[0])
        assert near == pytest.approx(reach, rel=0.15)
    # An iteration that settles with the joints open has not converged to a motion.
    for steps in (60, 120, 240):
        motion = mbd.simulate(system, 1.5 * reach, steps=steps, iterations=(8, 2), refresh=0, halvings=0)
        assert motion.status[0].startswith("failed")


def parallelogram(angle: float, speed: float, coupler: mbd.RigidBody | mbd.FlexibleBody, side: float) -> mbd.System:
    """A driven crank and a rocker of length `side` at an angle, a coupler of 2 m, or the plate of 0.3 m, between them."""
    ground, R = mbd.Ground(), _about_z(angle)
    reach = 1.0 if isinstance(coupler, mbd.RigidBody) else 0.15
    bodies, joints = [], []
    for name, x in (("crank", 0.0), ("rocker", 2.0 * reach)):
        center = tensor(x, 0.0, 0.0) + R @ tensor(0.5 * side, 0.0, 0.0)
        velocity = speed * (R @ tensor(0.0, 0.5 * side, 0.0))
        J = (1e-3 * side, 0.1 * side**2, 0.1 * side**2)
        given = {"position": center, "axes": R, "velocity": velocity, "angular_velocity": (0.0, 0.0, speed)}
        bodies.append(mbd.RigidBody(name, 1.0, J, **given))
        joints.append(
            mbd.Revolute(ground.at(x, 0.0, 0.0), bodies[-1].at(-0.5 * side, 0.0, 0.0), name=f"foot of {name}")
        )
    crank, rocker = bodies
    ends = [(-reach, 0.0, 0.0), (reach, 0.0, 0.0)] if isinstance(coupler, mbd.RigidBody) else [("left",), ("right",)]
    left, right = (coupler.at(*end) for end in ends)
    joints += [
        mbd.Spherical(crank.at(0.5 * side, 0.0, 0.0), left, name="left"),
        mbd.Universal(right, rocker.at(0.5 * side, 0.0, 0.0), axes="yz", name="right"),
        mbd.Drive(ground, crank, speed=speed, name="motor"),
    ]
    return mbd.System([*bodies, coupler], joints)


def distance(motion: mbd.Trajectory, side: float, length: float) -> torch.Tensor:
    """How far the tip of the rocker is from that of the crank, less the coupler [times]."""
    tips = [motion.body(name).at((0.5 * side, 0.0, 0.0)).position[0] for name in ("crank", "rocker")]
    return (tips[1] - tips[0] - tensor(length, 0.0, 0.0)).norm(dim=1)


@pytest.mark.thorough
def test_a_step_that_ends_in_a_singular_position():
    """A parallelogram folds flat exactly at a step, where its matrix has no inverse, and goes on as a parallelogram."""
    start, speed = 0.3, 2.0 * np.pi
    flat, errors = (np.pi - start) / speed, []
    bar = mbd.RigidBody("coupler", 1.0, (0.01, 0.3, 0.3), position=tensor(np.cos(start) + 1.0, np.sin(start), 0.0))
    system = parallelogram(start, speed, bar, side=1.0)
    assert system().dynamics.rank.redundant == ()
    for steps in (60, 240):
        with warned(f"singular position near t = {flat:.5g}") as caught:
            motion = mbd.simulate(system, 2.0 * flat, steps=steps).require_ok()
        assert "foot of rocker: coincide x" in str(caught[0].message)
        assert (motion.stats["renewed"], motion.stats["halved"]) == ([0], [])
        errors.append(float(distance(motion, 1.0, 2.0).max()))
    assert errors[0] < 5e-4
    assert errors[1] < errors[0] / 6.0


@pytest.mark.thorough
def test_a_start_in_a_singular_position():
    """A flat parallelogram with a soft coupler: the row that depends on others there is needed as soon as it moves."""
    soft = mbd.Laminate(mbd.Ply(strength=None, **SOFT), mbd.deg([40.0, -10.0]), thickness=1.25e-3, symmetric=True)
    bar = plate("coupler", made_of=soft, position=(0.25, 0.0, 0.0), axes=[[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    system = parallelogram(0.0, 6.0, bar, side=0.1)
    rank = system().dynamics.rank
    assert (len(rank.redundant), rank.left_out) == (1, ())
    motion = mbd.simulate(system, 0.2, steps=100).require_ok()
    assert motion.singular_positions()[0].t == 0.0
    assert float(distance(motion, 0.1, 0.3).max()) < 1e-5
    # At rest, the coupler contradicts the cranks: a start beside the motion is tried again with a new matrix.
    # The rates of the start are a mixture of both branches, whose shares depend on the size: 100 steps leave the parallelogram.
    bar.moving((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    system = parallelogram(0.0, 6.0, bar, side=0.1)
    with pytest.warns(
        UserWarning, match="singular position near t = 0 s|do not allow the initial velocities"
    ) as caught:
        motion = mbd.simulate(system, 0.2, steps=400).require_ok()
    assert len([w for w in caught if "singular position near" in str(w.message)]) == 1
    assert float(distance(motion, 0.1, 0.3).max()) < 1e-5


def _about_z(angle: float) -> torch.Tensor:
    c, s = np.cos(angle), np.sin(angle)
    return torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
