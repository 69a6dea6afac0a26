"""A plate hung by two corners: one row along the hinge line contradicts the other as soon as the plate twists."""

from __future__ import annotations

import pytest
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import GRAVITY, SOFT, plate

GROUND = mbd.Ground()
NAME = "door.laminate.angles"


def door(free: str | None = None) -> mbd.System:
    """The hinge line is the plate's left edge; in the corner `free` only the two rows across it are there."""
    ply = mbd.Ply(strength=None, **SOFT)
    stack = mbd.Laminate(ply, mbd.deg([40.0, -10.0]), thickness=1.25e-3, symmetric=True)
    body = plate("door", modes=5, made_of=stack)
    joints: list = []
    for side, y in (("bottom", -0.05), ("top", 0.05)):
        a, b = GROUND.at(-0.15, y, 0.0), body.at(f"corner_left_{side}")
        if side == free:
            joints += [mbd.PointOnPlane(a, b, normal=k, name=f"{side}_{k}") for k in "xz"]
        else:
            joints.append(mbd.Spherical(a, b, name=side))
    return mbd.System([body], joints, gravity=GRAVITY)


def moved(system: mbd.System) -> mbd.Trajectory:
    return mbd.simulate(system, 0.1, steps=25, gradients="forward", variables=[NAME], iterations=(4, 2)).require_ok()


@pytest.mark.thorough
def test_a_row_that_contradicts_another_is_left_out():
    whole = moved(door())
    (name,) = whole.dynamics.redundant
    assert name in ("bottom: coincide y", "top: coincide y")
    single = moved(door(free=name.partition(":")[0]))
    assert single.dynamics.redundant == ()
    twist = (
        whole.body("door").at("corner_left_top").displacement - whole.body("door").at("corner_left_bottom").displacement
    )
    assert float(twist[..., 2].abs().max()) > 1e-3
    for x, y in ((whole.q, single.q), (whole.v, single.v), (whole.dq_db, single.dq_db)):
        assert x is not None
        assert y is not None
        assert_close(x, y, rtol=0, atol=1e-7 * float(y.abs().max()))
    row = whole.dynamics.topology.row_names.index(name)
    assert float(whole.lam[..., row].abs().max()) < 1e-20 * float(whole.lam.abs().max())


@pytest.mark.thorough
def test_the_same_on_the_other_route():
    """Index-1 equations: accelerations with the row left out."""
    system = door()
    alpha, other = mbd.simulate(system, 0.01, steps=40), mbd.simulate(system, 0.01, "rk4", 40)
    end = other.require_ok().q[:, -1]
    assert_close(alpha.require_ok().q[:, -1], end, rtol=0, atol=1e-3 * float((end - other.q[:, 0]).abs().max()))


def test_rows_of_rigid_bodies_stay():
    body = mbd.RigidBody("door", 1.0, (1e-3, 1e-3, 1e-3))
    joints = [mbd.Spherical(GROUND.at(0, y, 0), body.at(0, y, 0)) for y in (-1, 1)]
    rank = mbd.System([body], joints, gravity=GRAVITY)().dynamics.rank
    assert rank.left_out == ()
    assert len(rank.redundant) == 1
