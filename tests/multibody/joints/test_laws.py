"""Laws of drives: slopes against automatic differentiation, rest to rest, drives that travel, and laws that go wrong."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import box, tensor, turned
from tests.refused import refused
from torchmbd.errors import InputError
from torchmbd.multibody.joints.laws import ConstantSpeed, FiniteLaw, Sine, SmoothStep
from torchmbd.multibody.joints.primitive import Law, slopes

LAWS = [ConstantSpeed(-2.5), SmoothStep(0.8, 0.5, start=0.2), SmoothStep(-3.0, 2.0), Sine(0.3, 1.7)]
named = pytest.mark.parametrize("law", LAWS, ids=lambda law: type(law).__name__)


@named
def test_slopes_are_derivatives(law):
    times = tensor(0.05, 0.21, 0.4, 0.6, 0.9)
    result = law.slopes(times)
    for i, t in enumerate(times):
        for stated, expected in zip(result, slopes(lambda s: law(s), t), strict=True):
            assert_close(stated[i], expected, rtol=1e-12, atol=1e-12)


SPLINE = CubicSpline([0.0, 0.5, 1.0, 2.0], [0.0, 0.2, 0.6, 0.7])
LEAVES_TORCH = {
    "spline": lambda t: SPLINE(t),
    "its numbers": lambda t: torch.as_tensor(SPLINE(t)),
    "numpy": lambda t: torch.from_numpy(np.asarray(np.sin(t.detach().numpy()))),
    "float": lambda t: torch.tensor(float(SPLINE(float(t))), dtype=torch.float64),
    "detach": lambda t: torch.sin(t.detach()),
}


@pytest.mark.parametrize("name", LEAVES_TORCH)
def test_a_law_that_leaves_torch_is_refused_by_name(name):
    with refused("motor.angle"):
        mbd.Drive(mbd.Ground(), box("b"), axis="z", angle=LEAVES_TORCH[name], name="motor")


@pytest.mark.thorough
def test_a_spline_of_scipy_in_torch_operations_drives():
    """As the message says: the pieces x and the coefficients c of the spline, highest power first."""
    x, c = torch.as_tensor(SPLINE.x), torch.as_tensor(SPLINE.c)

    def angle(t):
        k = (torch.searchsorted(x, t.detach().reshape(1), right=True)[0] - 1).clamp(0, len(x) - 2)
        d = t - x[k]
        return ((c[0, k] * d + c[1, k]) * d + c[2, k]) * d + c[3, k]

    crank = mbd.RigidBody("crank", 1.0, (0.01,) * 3)
    motor = mbd.Drive(mbd.Ground(), crank, axis="z", angle=angle, name="motor")
    system = mbd.System([crank], [mbd.Revolute(mbd.Ground().at(), crank.at(), axis="z"), motor])
    motion = mbd.simulate(system, 0.4, steps=8)
    assert motion.status == ["ok"]
    turned = 2.0 * torch.atan2(motion.q[0, :, 6], motion.q[0, :, 3])  # of the Euler parameters about z
    assert_close(turned, torch.as_tensor(SPLINE(motion.t.numpy())), rtol=1e-9, atol=1e-9)


def test_a_smooth_step_goes_from_rest_to_rest():
    law = SmoothStep(0.8, 0.5, start=0.2)
    ends = torch.stack(law.slopes(tensor(0.0, 0.2, 0.7, 5.0)))
    assert_close(ends, tensor(0, 0, 0.8, 0.8, *[0] * 8).reshape(3, 4), rtol=0, atol=1e-12)
    assert float(law.slopes(tensor(0.45))[1]) == pytest.approx(1.875 * 0.8 / 0.5)


@named
def test_the_law_of_a_joint_is_the_law(law):
    times, own = tensor(0.1, 0.35, 0.6), FiniteLaw("crank", pickle.loads(pickle.dumps(law)))
    plain = FiniteLaw("crank", lambda t: law(t))  # states no slopes, takes one time
    for x in (own, plain):
        assert_close(x(times), law(times))
        assert_close(x(times[0]), law(times[0]))
        for t in (times, times[1]):
            assert_close(torch.stack(x.slopes(t)), torch.stack(law.slopes(t)), rtol=1e-12, atol=1e-12)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("key", "x", "method"),
    [
        ("velocity", 0.3, "generalized_alpha"),
        ("position", lambda t: 0.1 * t * t, "generalized_alpha"),
        ("position", Sine(0.02, 2.0), "rk4"),
    ],
)
def test_a_drive_along_an_axis_travels(key, x, method):
    """A slider on a guide that leans; the way from the given position is the law, and the ground pulls it: m a."""
    ground, slider = mbd.Ground(), box("slider", position=(0.3, -0.1, 0.2), axes=turned(0.2, 0.1, -0.4))
    guide = ground.at(0.1, 0.2, 0.3, axes=turned(0.5, -0.3, 0.9))
    joints = [
        mbd.Prismatic(ground.at(0.3, -0.1, 0.2, axes=guide.axes), slider.at(), axis="y"),
        mbd.Drive(guide, slider.at(), axis="y", name="push", **{key: x}),
    ]
    steps = 100 if method == "generalized_alpha" else 200
    options = {"spectral_radius": 0.2} if method == "generalized_alpha" else {}
    motion = mbd.simulate(mbd.System([slider], joints), 0.5, method=method, steps=steps, **options).require_ok()
    law: Law = ConstantSpeed(x) if key == "velocity" else x
    way = FiniteLaw("", law)(motion.t)[:, None] * guide.axis("y")
    assert_close(motion.body("slider").r[0], tensor(0.3, -0.1, 0.2) + way, rtol=0, atol=1e-6)
    row = next(i for i, name in enumerate(motion.dynamics.topology.row_names) if name == "push: travel")
    pull = -0.7 * FiniteLaw("", law).slopes(motion.t)[2]
    # The stabilization of an ODE method multiplies errors of the position by 1 / (5e-3 s)^2.
    assert_close(motion.lam[0, :, row], pull, rtol=0, atol=5e-3 if method == "rk4" else 1e-9)


def hinged(**law) -> mbd.System:
    ground, disk = mbd.Ground(), mbd.RigidBody("disk", 1.0, (1.0, 1.0, 1.0))
    return mbd.System([disk], [mbd.Revolute(ground.at(), disk.at()), mbd.Drive(ground, disk, name="motor", **law)])


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["generalized_alpha", "rk4"])
def test_a_law_that_turns_nan_is_named_with_its_time(method):
    system = hinged(angle=lambda t: torch.sqrt(0.25 - t) - 0.5)
    with refused("motor.law"):
        mbd.simulate(system, 0.5, method=method, steps=50)


@pytest.mark.parametrize(
    ("law", "path"),
    [
        ({}, "motor"),
        ({"speed": 1.0, "position": lambda t: t}, "motor"),
        ({"speed": float("nan")}, "motor.speed"),
        ({"velocity": "fast"}, "motor.velocity"),
        ({"angle": 0.3}, "motor.angle"),
        ({"position": lambda t: t * float("nan")}, "motor.position"),
    ],
)
def test_a_drive_refuses_laws_that_are_none(law, path):
    with refused(path):
        hinged(**law)


def test_a_step_refuses_a_duration_of_zero():
    with pytest.raises(InputError) as error:
        SmoothStep(1.0, 0)
    assert (error.value.path, error.value.value) == (("duration",), 0)
