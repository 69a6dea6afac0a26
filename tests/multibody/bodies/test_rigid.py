"""Rigid bodies: moments against a cloud of mass points, and what is refused."""

from __future__ import annotations

import math

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import cross_matrix, tensor, turned
from tests.refused import ANY, refused


def test_invariants_are_the_moments_of_a_cloud_of_points():
    """Inertia goes in about the center of mass and comes out about the origin: Steiner's term has the sign to lose."""
    make = torch.Generator().manual_seed(4)
    x = torch.randn(20, 3, generator=make, dtype=torch.float64) + torch.tensor([0.5, -1.0, 2.0])
    m = torch.rand(20, generator=make, dtype=torch.float64)
    center = (m[:, None] * x).sum(0) / m.sum()
    inertia = sum(
        m_k * cross_matrix(x_k - center).T @ cross_matrix(x_k - center) for m_k, x_k in zip(m, x, strict=True)
    )
    result = mbd.RigidBody("cloud", mass=float(m.sum()), inertia=inertia, center=center).invariants()
    assert_close(result["mass"], m.sum())
    assert_close(result["S0"], (m[:, None] * x).sum(0), rtol=1e-13, atol=0)
    assert_close(result["P0"], torch.einsum("k,ki,kj->ij", m, x, x), rtol=1e-12, atol=1e-12)
    assert result["mu"] == 0


def test_three_moments_are_a_diagonal():
    given = {"mass": 2.0, "center": (0.1, 0.2, 0.3)}
    short = mbd.RigidBody("short", inertia=(1.0, 2.0, 2.5), **given)
    full = mbd.RigidBody("full", inertia=torch.diag(torch.tensor([1.0, 2.0, 2.5])), **given)
    assert_close(short.invariants(), full.invariants())


@pytest.mark.parametrize("moments", [(3e-4, 3e-4, 3e-4), (2e-3, 2e-3, 0.0), (1e-3, 2e-3, 3e-3), (0.0, 0.0, 0.0)])
def test_a_turned_inertia_is_symmetric_to_rounding(moments):
    """R J R' of a sphere, a rod and a lamina: rounding makes it unsymmetric, and zero moments negative."""
    for seed in range(5):
        R = turned(*torch.randn(3, generator=torch.Generator().manual_seed(seed)).tolist())
        J = R @ torch.diag(tensor(*moments)) @ R.T
        body = mbd.RigidBody("box", 1.0, J)
        assert_close(body.inertia, J, rtol=0, atol=1e-18)
        assert torch.equal(body.inertia, body.inertia.T)


def test_places_and_gravity_are_saved_with_the_module():
    """And come back into a system that was built elsewhere."""
    place = {"position": (1.0, 2.0, 3.0), "velocity": (0.1, 0.0, 0.0), "angular_velocity": (0.0, 0.2, 0.0)}
    box = mbd.RigidBody("box", 1.0, (1.0, 1.0, 1.0), axes=[[0, -1, 0], [1, 0, 0], [0, 0, 1]], **place)
    saved = mbd.System([box], gravity=(0.0, 0.0, -9.81), free=["box"]).state_dict()
    for key in (*place, "axes"):
        assert_close(saved[f"box.{key}"], getattr(box, key))
    other = mbd.System([mbd.RigidBody("box", 2.0, (1.0, 1.0, 1.0))], gravity=(0.0, 0.0, 0.0), free=["box"])
    other.load_state_dict(saved)
    assert_close(other.body("box").position, box.position)
    assert_close(other.gravity, torch.tensor([0.0, 0.0, -9.81], dtype=torch.float64))
    motion = mbd.simulate(other, 1.0, steps=10).require_ok()
    assert_close(motion.body("box").r[0, 0], box.position)
    assert_close(motion.body("box").r[0, -1, 2], torch.tensor(3.0 - 0.5 * 9.81, dtype=torch.float64))


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"name": "two words"}, ("name", "two words", "name of the rigid body")),
        ({"mass": 0.0}, ("box.mass", 0.0, "0.0 kg")),
        ({"mass": "1.0"}, ("box.mass", "1.0")),
        ({"inertia": "round"}, ("box.inertia", "round")),
        ({"position": "here"}, ("box.position", "here")),
        ({"axes": [[1, 0, 0], [0, 1]]}, ("box.axes", [[1, 0, 0], [0, 1]], "3 x 3")),
        ({"mass": math.nan}, ("box.mass", math.nan)),
        ({"inertia": (1.0, 1.0)}, ("box.inertia", (1.0, 1.0), "3 x 3")),
        ({"inertia": (1.0, 1.0, 2.1)}, ("box.inertia", (1.0, 1.0, 2.1), "the sum of the other two")),
        ({"inertia": (-1.0, 1.0, 1.0)}, ("box.inertia", (-1.0, 1.0, 1.0), "negative")),
        (
            {"inertia": [[1, 0.5, 0], [0, 1, 0], [0, 0, 1]]},
            ("box.inertia", [[1, 0.5, 0], [0, 1, 0], [0, 0, 1]], "symmetric"),
        ),
        ({"center": (0.0, math.inf, 0.0)}, ("box.center", ANY, "inf")),
        ({"position": (0.0, 0.0)}, ("box.position", (0.0, 0.0))),
        ({"velocity": (0.0, 0.0, math.nan)}, ("box.velocity", ANY, "nan")),
        ({"angular_velocity": (1.0,)}, ("box.angular_velocity", (1.0,))),
        ({"axes": torch.eye(2)}, ("box.axes", ANY, "(2, 2)", "3 x 3")),
        ({"axes": 2.0 * torch.eye(3)}, ("box.axes", ANY, "3.0e+00")),
        ({"axes": -torch.eye(3)}, ("box.axes", ANY, "det A = -1")),
    ],
    ids=lambda x: "-".join(x) if isinstance(x, dict) else "",
)
def test_bad_input_is_named_with_its_value_and_what_is_allowed(given, said):
    with refused(*said):
        mbd.RigidBody(**({"name": "box", "mass": 1.0, "inertia": (1.0, 1.0, 1.0)} | given))


def test_bad_frames_are_named():
    box = mbd.RigidBody("box", mass=1.0, inertia=(1.0, 1.0, 1.0))
    with refused("box.point"):
        box.at(0.0, math.nan, 0.0)
    for point in ((0.1, 0.0, 0.0), torch.zeros(3)):
        with refused("box.point", point, "Try: at(x, y, z)"):
            box.at(point)
    with refused("axes"):
        mbd.Ground().at(axes=[[1, 1, 0], [0, 1, 0], [0, 0, 1]])
    with refused("axis", "w"):
        box.at().axis("w")


def test_axes_of_a_frame_are_columns():
    A = turned(0.3, -0.5, 0.8)
    frame = mbd.RigidBody("box", mass=1.0, inertia=(1.0, 1.0, 1.0)).at(axes=A)
    assert_close(torch.stack([frame.axis(name) for name in "xyz"], 1), A)


def test_a_body_does_not_share_memory_with_its_arguments():
    """Changing an array after it was given must not move the body."""
    given = torch.zeros(3, dtype=torch.float64)
    body = mbd.RigidBody("box", mass=1.0, inertia=(1.0, 1.0, 1.0), position=given, center=given)
    given += 1.0
    assert not body.position.any()
    assert not body.center.any()
