"""Films: as many frames as asked for, and in each frame the mechanism where the motion has it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image

import torchmbd as mbd
from tests.fem.elements.beam_cases import coupled_section
from tests.refused import refused
from torchmbd.fem.elements import BeamLine
from torchmbd.viz import animate, film
from torchmbd.viz.animation import scene_of
from torchmbd.viz.film import _Drawing, positions


@pytest.fixture(scope="module")
def beam_motion() -> mbd.Trajectory:
    """A beam that a motor turns."""
    arm = mbd.FlexibleBody.beam("arm", BeamLine.straight(0.5, 6), coupled_section(), modes=3)
    ground = mbd.Ground()
    joints = [
        mbd.Revolute(ground.at(0, 0, 0), arm.at("start"), axis="z"),
        mbd.Drive(ground, arm, axis="z", speed=20.0),
    ]
    return mbd.simulate(mbd.System([arm], joints), 0.01, steps=40).require_ok()


def test_positions_are_those_of_the_motion(beam_motion, slider_crank_motion):
    for motion, name in ((beam_motion, "arm"), (slider_crank_motion, "rod")):
        scene = scene_of(motion, 0, np.arange(len(motion.t)))
        body = next(body for body in scene["bodies"] if body["name"] == name)
        nodes = motion.body(name).nodes[0].detach().numpy()
        size = np.abs(motion.body(name).displacements[0].detach().numpy()).max()
        assert_allclose(positions(body, len(motion.t), 1.0), nodes, atol=1e-6 + 1e-4 * size)


def test_beams_are_lines_of_the_animation(beam_motion, tmp_path):
    (body,) = scene_of(beam_motion, 0, np.arange(41))["bodies"]
    assert body["triangles"] == []
    assert body["lines"] == [k for e in range(6) for k in (e, e + 1)]
    page = animate(beam_motion, tmp_path / "arm.html").read_text()
    assert "function beams" in page


@pytest.mark.thorough
def test_a_film_has_its_frames(beam_motion, slider_crank_motion, tmp_path):
    for motion in (beam_motion, slider_crank_motion):
        path = film(motion, tmp_path / "m.gif", seconds=0.5, frames_per_second=10)
        picture = Image.open(path)
        assert picture.n_frames in (5, 6)
        first = np.asarray(picture.convert("L"), dtype=float)
        picture.seek(picture.n_frames - 1)
        assert np.abs(np.asarray(picture.convert("L"), dtype=float) - first).max() > 100  # it moves


@pytest.mark.thorough
@pytest.mark.parametrize("options", [{"steps": 10}, {"steps": 200}, {"method": "dopri5"}])
def test_a_film_lasts_as_long_as_asked_and_its_time_runs_evenly(tmp_path, monkeypatch, options):
    """Also of a motion with fewer or more times than frames, or with times that are not equally spaced."""
    shown = []
    monkeypatch.setattr(_Drawing, "frame", lambda self, k: shown.append(float(self.t[k])) or [])
    motion = mbd.simulate(mbd.examples.pendulum(), 0.5, **options)
    film(motion, tmp_path / "m.gif", seconds=2.5, frames_per_second=12)
    times = np.linspace(0.0, 0.5, 30)
    distance = np.abs(times[:, None] - motion.t.numpy()).min(1)
    assert_allclose(np.abs(np.array(shown[-30:]) - times), distance, atol=1e-7)


@pytest.mark.parametrize(
    ("change", "argument"),
    [
        ({"path": "m.avi"}, "path"),
        ({"lane": 3}, "lane"),
        ({"view": "w"}, "view"),
        ({"seconds": 0.0}, "seconds"),
    ],
)
def test_bad_arguments_are_named(beam_motion, tmp_path, change, argument):
    arguments = {"path": "m.gif"} | change
    with refused(argument):
        film(beam_motion, tmp_path / arguments.pop("path"), **arguments)
