"""Mode shapes of a system as motions: period, shape, closed joints, size; their page is that of any motion."""

from __future__ import annotations

import json
import math
import re

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.multibody.equilibrium.test_rotors import rotor
from tests.refused import refused
from torchmbd.multibody.equations import equations

GROUND = mbd.Ground()


def chain(damping: float = 0.0) -> mbd.System:
    """Two masses m on a rail between three springs k: (x1, x2) ~ (1, 1) at sqrt(k / m), (1, -1) at sqrt(3 k / m)."""
    first, second = (mbd.RigidBody(name, 2.0, (1.0, 1.0, 1.0), position=(x, 0, 0)) for name, x in (("a", 1), ("b", 2)))
    rails = [mbd.Prismatic(GROUND.at(), body.at(), axis="x") for body in (first, second)]
    pairs = ((GROUND.at(0, 0, 0), first.at()), (first.at(), second.at()), (second.at(), GROUND.at(3, 0, 0)))
    springs = [mbd.SpringDamper(*pair, stiffness=50.0, damping=damping, rest=1.0) for pair in pairs]
    return mbd.System([first, second], rails, springs)


@pytest.mark.parametrize(("number", "ratio", "square"), [(1, 1.0, 25.0), (2, -1.0, 75.0)])
def test_two_masses_swing_in_their_shapes(number, ratio, square):
    rest = mbd.equilibrium(chain())
    motion = mbd.viz.mode_motion(rest, number, size=0.1, periods=2)
    assert motion.stats["mode"] == f"{math.sqrt(square) / (2 * math.pi):.4g} Hz, no damping"
    assert float(motion.t[-1]) == pytest.approx(2 * 2 * math.pi / math.sqrt(square))
    x, y = (motion.body(name).r[0, :, 0] - rest.body(name).r[0, 0, 0] for name in ("a", "b"))
    assert_close(y, ratio * x, rtol=1e-8, atol=1e-9)
    assert_close(x, float(x[0]) * torch.cos(math.sqrt(square) * motion.t), rtol=0.0, atol=1e-9)
    assert 0.05 < float(x.abs().max()) < 0.31  # of 3 m, the size of the picture
    assert_close(motion.v[0, 12, 0], -math.sqrt(square) * x[0], rtol=1e-6, atol=1e-9)


def test_damping_is_told_and_not_shown():
    motion = mbd.viz.mode_motion(mbd.equilibrium(chain(damping=2.0)))
    assert motion.stats["mode"].endswith("damping 10 %")
    assert_close(motion.q[0, 0], motion.q[0, -1])


def test_joints_stay_closed_and_reactions_are_unknown():
    rest = mbd.equilibrium(mbd.examples.arm())
    motion = mbd.viz.mode_motion(rest, 2)
    T, data = motion.dynamics.topology, motion.dynamics.data
    at = equations.placement(T, data, motion.q[0].T[:, None], T.prescribed(rest.t[-1], data))
    assert float(equations.constraints(T, at).abs().max()) < 1e-10
    shape = motion.body("arm").displacements[0, 0] - rest.body("arm").displacements[0, 0]
    assert float(shape.norm(dim=1).max()) > 0.01 * 0.5
    assert bool(motion.reaction("hinge").force.isnan().all())


def test_a_page_has_the_shape_at_its_size(tmp_path):
    rest = mbd.equilibrium(mbd.examples.arm())
    page = mbd.viz.animate_mode(rest, tmp_path / "mode.html", number=2)
    scene = json.loads(
        re.search(r'<script id="scene" type="application/json">(.*?)</script>', page.read_text(), re.S)[1]  # pyright: ignore
    )
    assert (scene["title"], scene["scale"], scene["strips"]) == ("11.69 Hz, no damping", 1.0, [])
    assert {body["name"] for body in scene["bodies"]} == {"arm", "tool"}


@pytest.mark.thorough
def test_a_blade_in_steady_rotation(tmp_path):
    """The first vibration of a blade whose hub turns: it flaps along the axis; the hub stands in the turning frame."""
    hub = mbd.RigidBody("hub", 2.0, (0.01, 0.01, 0.01))
    ply = mbd.Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=3.6e9, nu12=0.23, density=1586.0)
    spar = mbd.sections.box(0.06, 0.02, ply, mbd.deg([20, -10]), thickness=1e-3, cells=(6, 3, 1))
    blade = mbd.FlexibleBeam("blade", mbd.BeamLine.straight(1.5, elements=4), spar, position=(0.1, 0, 0))
    joints = [
        mbd.Revolute(GROUND.at(), hub.at(), axis="z"),
        mbd.Drive(GROUND, hub, axis="z", speed=50.0),
        mbd.Fixed(hub.at(0.1, 0, 0), blade.at("start")),
    ]
    rest = mbd.equilibrium(mbd.System([hub, blade], joints), spin=(0.0, 0.0, 50.0))
    motion = mbd.viz.mode_motion(rest)
    assert 1.0 / float(motion.t[-1]) == pytest.approx(float(rest.frequencies[0, 0].detach()))
    moved = motion.body("blade").nodes[0, 0] - rest.body("blade").nodes[0, 0].detach()
    assert float(moved[-1, 2].abs()) == pytest.approx(0.08 * 1.6, rel=0.05)
    assert float(motion.body("hub").A[0].std(0).abs().max()) < 1e-9
    assert mbd.viz.film(motion, tmp_path / "blade.gif", seconds=0.2, frames_per_second=10).stat().st_size > 1000


@pytest.mark.thorough
def test_whirl_is_a_circle_and_overdamped_poles_do_not_count():
    """Seen from the ground: backward whirl before forward whirl, which has the larger frequency."""
    rest = mbd.equilibrium(rotor(150.0, damping=1e-5), spin=(150.0, 0, 0), unstable=True, observer="ground")
    for number, sense in ((1, -1.0), (2, 1.0)):
        motion = mbd.viz.mode_motion(rest, number)
        moved = motion.body("disk").r[0] - rest.body("disk").r[0, 0].detach()
        start, quarter = moved[0, 1:], moved[12, 1:]
        assert_close(quarter, sense * torch.stack([-start[1], start[0]]), rtol=0.0, atol=1e-4 * float(start.norm()))


@pytest.mark.parametrize(
    ("change", "path"),
    [
        ({"rest": 3}, "rest"),
        ({"number": 3}, "number"),
        ({"number": 0}, "number"),
        ({"lane": 1}, "lane"),
        ({"size": 0.0}, "size"),
        ({"periods": 0}, "periods"),
        ({"frames": 2}, "frames"),
    ],
)
def test_wrong_arguments_are_named(change, path):
    with refused(path):
        mbd.viz.mode_motion(**{"rest": mbd.equilibrium(chain())} | change)


def test_a_page_of_another_ending_is_refused():
    with refused("path"):
        mbd.viz.animate_mode(mbd.equilibrium(chain()), "mode.txt")


def test_a_free_motion_is_no_vibration():
    free = mbd.RigidBody("free", 2.0, (1.0, 1.0, 1.0))
    rest = mbd.equilibrium(mbd.System([free], [mbd.Prismatic(GROUND.at(), free.at(), axis="x")]))
    with refused("number", 1):
        mbd.viz.mode_motion(rest)
