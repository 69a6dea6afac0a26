"""The animation file: what it holds is the motion, read back from the HTML and compared."""

from __future__ import annotations

import base64
import json
import re

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.refused import refused
from torchmbd.fem.materials import Laminate, Ply
from torchmbd.fem.mesh import rectangle
from torchmbd.math.angles import deg
from torchmbd.multibody.bodies import FlexibleBody, Ground, RigidBody
from torchmbd.multibody.joints import Drive, Prismatic, Revolute, Spherical, Universal
from torchmbd.multibody.system import System
from torchmbd.simulation import simulate
from torchmbd.viz import animate
from torchmbd.viz.animation import scene_of
from torchmbd.viz.film import positions


@pytest.fixture(scope="module")
def motion():
    """Two lanes of a slider-crank whose plate stands out of the x-y plane."""
    ply = Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=5.36e9, nu12=0.23, density=1586.0)
    laminate = Laminate(ply, angles=deg([30, -50]), thickness=3.75e-3)
    upright = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
    mesh = rectangle(length=0.304, width=0.04, cells=(6, 2))
    rod = FlexibleBody.plate("rod", mesh, laminate, modes=4, position=(0.304, 0, 0), axes=upright)
    crank = RigidBody("crank", 0.1, (1e-4, 1e-4, 1e-4))
    slider = RigidBody("slider", 0.0723, (1e-4, 1e-4, 1e-4), position=(0.456, 0, 0))
    ground = Ground()
    joints = [
        Revolute(ground.at(), crank.at(), axis="z"),
        Drive(ground, crank, axis="z", speed=124.8),
        Spherical(crank.at(0.152, 0, 0), rod.at("left")),
        Universal(rod.at("right"), slider.at(), axes="yz"),
        Prismatic(ground.at(), slider.at(), axis="x"),
    ]
    designs = {"rod.laminate.angles": torch.stack([deg([30, -50]), deg([0, 0])])}
    return simulate(System([crank, rod, slider], joints), 0.01, steps=100, designs=designs).require_ok()


def read(path):
    text = path.read_text()
    return json.loads(re.search(r'<script id="scene" type="application/json">(.*?)</script>', text, re.S)[1])


def unpack(text, *shape):
    return np.frombuffer(base64.b64decode(text), "<f4").reshape(shape)


def nodes_of(body, frames, scale):
    """Rebuild node positions as the viewer does (viewer.html, `nodes`)."""
    x, w = unpack(body["x"], -1, 3), unpack(body["weights"], frames, -1)
    full, relative = (unpack(body[key], w.shape[1], -1, 3) for key in ("modes", "relative"))
    local = x + np.einsum("tk,knc->tnc", w, full + (scale - 1) * relative)
    return unpack(body["r"], frames, 1, 3) + np.einsum("tij,tnj->tni", unpack(body["A"], frames, 3, 3), local)


@pytest.mark.parametrize("lane", [0, 1])
def test_the_file_holds_the_motion_of_the_lane(motion, tmp_path, lane):
    scene = read(animate(motion, tmp_path / "m.html", lane=lane))
    rod = next(body for body in scene["bodies"] if body["name"] == "rod")
    nodes = motion.body("rod").nodes[lane].numpy()
    size = np.abs(motion.body("rod").displacements[lane].numpy()).max()
    assert np.abs(nodes_of(rod, 101, 1.0) - nodes).max() < 1e-6 + 1e-4 * size
    np.testing.assert_allclose(unpack(rod["energy"], -1), motion.body("rod").strain_energy[lane], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(unpack(scene["t"], -1), motion.t, rtol=1e-6)


def test_joints_stay_together_at_any_scale(motion, tmp_path):
    """Exaggerated bending must not tear the rod off its crank pin and slider."""
    scene = read(animate(motion, tmp_path / "m.html"))
    bodies = {body["name"]: body for body in scene["bodies"]}
    mesh = motion.body("rod").mesh
    nodes = nodes_of(bodies["rod"], 101, 40.0)
    slider = unpack(bodies["slider"]["r"], 101, 3)
    pin = np.einsum("tij,j->ti", unpack(bodies["crank"]["A"], 101, 3, 3), np.array([0.152, 0, 0]))
    np.testing.assert_allclose(nodes[:, mesh.node("left")], pin, atol=3e-6)
    np.testing.assert_allclose(nodes[:, mesh.node("right")], slider, atol=3e-6)
    straight = nodes_of(bodies["rod"], 101, 1.0)
    moved = np.abs(nodes - straight).max()
    assert moved == pytest.approx(39 * scene["largest"], rel=0.5)  # what is between the joints is exaggerated


def test_long_motions_are_thinned_out_and_keep_their_ends(motion, tmp_path):
    scene = read(animate(motion, tmp_path / "m.html", max_frames=8))
    t = unpack(scene["t"], -1)
    assert len(t) <= 9
    assert (t[0], t[-1]) == (0.0, pytest.approx(0.01))


def test_a_title_cannot_leave_its_place(motion, tmp_path):
    title = "</script><script>alert(1)</script>"
    path = animate(motion, tmp_path / "m.html", title=title)
    assert read(path)["title"] == title
    assert path.read_text().count("<script") == 2


def test_the_file_needs_no_network(motion, tmp_path):
    path = animate(motion, tmp_path / "m.html")
    assert "http" not in path.read_text()
    assert path.stat().st_size < 200_000


@pytest.mark.parametrize(
    ("change", "argument"),
    [
        ({"lane": 2}, "lane"),
        ({"path": "m.txt"}, "path"),
        ({"max_frames": 1}, "max_frames"),
    ],
)
def test_bad_arguments_are_named(motion, tmp_path, change, argument):
    arguments = {"path": "m.html"} | change
    with refused(argument):
        animate(motion, tmp_path / arguments.pop("path"), **arguments)


def test_a_failed_lane_is_not_shown(motion, tmp_path, monkeypatch):
    monkeypatch.setattr(motion, "status", ["ok", "failed: not finite"])
    with refused("lane", 1):
        animate(motion, tmp_path / "m.html", lane=1)


def test_a_body_on_one_joint_reaches_from_there_to_its_center():
    ground = Ground()
    bob = RigidBody("bob", 1.0, (1e-3, 1e-3, 1e-3), center=(0.0, -0.2, 0.0), position=(0.0, -1.0, 0.0))
    pivot = Revolute(ground.at(), bob.at(0, 1, 0), axis="z")
    motion = simulate(System([bob], [pivot], gravity=(0, -9.81, 0)), 0.01, steps=2)
    scene = scene_of(motion, 0, np.arange(3))
    assert scene["bodies"][0]["center"] == [0.0, -0.2, 0.0]
    np.testing.assert_allclose(scene["size"], [0.0, 1.2, 0.0], atol=1e-12)
    np.testing.assert_allclose(positions(scene["bodies"][0], 3, 1.0)[0], [[0, 0, 0], [0, -1.2, 0]], atol=1e-6)


def test_histories_of_a_question_stand_below_the_motion(motion, tmp_path):
    """Those of objective and constraints by name, in the unit of figures, with limits; else strain energies."""
    angle = mbd.Max(mbd.Angle("rod", axis="z"))
    problem = mbd.Problem(
        motion.system, 0.01, mbd.RMS(mbd.Velocity("slider", "x")), subject_to=[angle <= mbd.deg(30.0)], steps=100
    )
    speed, turn = read(animate(motion, tmp_path / "m.html", lane=1, problem=problem))["strips"]
    assert speed["label"] == "x velocity of slider (minimize rms of x velocity)"
    assert (speed["unit"], speed["limits"]) == ("m/s", [])
    assert (turn["unit"], turn["limits"]) == ("deg", [pytest.approx(30.0)])
    drawn = unpack(turn["curves"][0]["y"], -1)
    np.testing.assert_allclose(drawn, np.degrees(angle.history(motion)[1].detach()), rtol=1e-6, atol=1e-5)
    (energy,) = read(animate(motion, tmp_path / "m.html"))["strips"]
    assert [curve["name"] for curve in energy["curves"]] == ["rod"]
    with refused("problem", 3):
        animate(motion, tmp_path / "m.html", problem=3)
