"""The largest response to a harmonic input: closed forms, scipy.signal, derivatives in every mode, ends of the band."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import scipy.signal
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.extensions.vibrations.measures.test_system_vibrations import carriage, measured
from tests.extensions.vibrations.test_eigenvalues import angles_of, blade
from tests.refused import ANY, refused
from torchmbd.design.response_spec import measure_of
from torchmbd.extensions.identification.run import Run

pytestmark = pytest.mark.thorough

GROUND = mbd.Ground()


def mass(m: float = 2.0, k: float = 50.0, d: float = 2.0) -> mbd.System:
    body = mbd.RigidBody("load", mbd.variable(m), (1.0, 1.0, 1.0))
    rail = mbd.Prismatic(GROUND.at(), body.at(), axis="y", name="rail")
    values = {"stiffness": mbd.variable(k), "damping": mbd.variable(d)}
    return mbd.System(
        [body], [rail], [mbd.AxialSpringDamper(GROUND.at(), body.at(), axis="y", name="spring", **values)]
    )


def short(system: mbd.System, **options) -> mbd.Trajectory:
    return mbd.simulate(system, 1e-4, steps=2, **options)


def test_peak_and_gradient_of_one_mass():
    """1 / (k 2 zeta sqrt(1 - zeta^2)) at w sqrt(1 - 2 zeta^2), of the travel of its rail and of its point."""
    x = {
        name: torch.tensor([x], dtype=torch.float64, requires_grad=True)
        for name, x in (("stiffness", 50.0), ("damping", 2.0))
    }
    k, d = x.values()
    zeta = d / (2.0 * (2.0 * k).sqrt())
    expected = 1.0 / (k * 2.0 * zeta * (1.0 - zeta**2).sqrt())
    by = torch.autograd.grad(expected.sum(), [k, d])
    motion = short(mass(), designs={f"spring.{name}": y for name, y in x.items()}, gradients="reverse")
    options: dict[str, Any] = {"direction": "y", "input_direction": "y"}
    for measure in (
        mbd.vibrations.FrequencyResponse("rail", "rail", (0.01, 10.0)),
        mbd.vibrations.FrequencyResponse("load", "load", (0.0, 10.0), input_place=(0.1, 0.0, 0.0), **options),
    ):
        peak = measure.peak(motion)
        assert_close(peak.magnitude, expected, rtol=1e-10, atol=0.0)
        assert_close(peak.frequency, 5.0 * (1.0 - 2.0 * zeta**2).sqrt().detach() / (2.0 * math.pi), rtol=1e-7, atol=0.0)
        assert peak.where == ["peak"]
        for got, y in zip(torch.autograd.grad(peak.magnitude.sum(), [k, d]), by, strict=True):
            assert_close(got, y, rtol=1e-9, atol=0.0)


@pytest.mark.parametrize("quantity", ["displacement", "velocity", "acceleration"])
def test_two_masses_against_scipy(quantity):
    """M, C and K by hand: a force on the first, the second answers."""
    system, band = carriage(), (0.05, 5.0)
    first, second = (joint.name for joint in system.joints)
    M, K = np.diag([2.0, 1.0]), 50.0 * np.array([[2.0, -1.0], [-1.0, 1.0]])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(M, K), -np.linalg.solve(M, 0.04 * K)]])
    B, C = np.array([[0.0], [0.0], [0.5], [0.0]]), np.array([[0.0, 1.0, 0.0, 0.0]])
    order = ["displacement", "velocity", "acceleration"].index(quantity)
    w = 2.0 * math.pi * np.linspace(*band, 200_001)
    _, G = scipy.signal.freqresp((A, B, C, np.zeros((1, 1))), w)
    peak = mbd.vibrations.FrequencyResponse(second, first, band, quantity=quantity).peak(short(system))
    size = np.abs(G) * w**order
    assert float(peak.magnitude) == pytest.approx(size.max(), rel=1e-7)
    assert float(peak.frequency) == pytest.approx(w[size.argmax()] / (2.0 * math.pi), abs=2e-4)


def test_ends_of_the_band_are_told_apart():
    """Above the peak |G| = |k - w^2 m + i w d|^-1 at the lower end, below it at the upper one; with the derivative there."""
    k = torch.tensor([50.0], dtype=torch.float64, requires_grad=True)
    motion = short(mass(), designs={"spring.stiffness": k}, gradients="reverse")
    for band, end, f in (((2.0, 4.0), "lower end of the band", 2.0), ((0.1, 0.4), "upper end of the band", 0.4)):
        peak = mbd.vibrations.FrequencyResponse("rail", "rail", band).peak(motion)
        w = 2.0 * math.pi * f
        expected = 1.0 / ((k - 2.0 * w * w) ** 2 + (2.0 * w) ** 2).sqrt()
        assert peak.where == [end]
        assert_close(peak.magnitude, expected, rtol=1e-10, atol=0.0)
        got, by = (torch.autograd.grad(y.sum(), k)[0] for y in (peak.magnitude, expected))
        assert_close(got, by, rtol=1e-9, atol=0.0)


def test_gradients_in_both_modes_and_lanes():
    names = ["spring.stiffness", "load.mass"]
    x = {name: torch.tensor(y, dtype=torch.float64) for name, y in zip(names, ([40.0, 60.0], [2.0, 3.0]), strict=True)}
    measure = mbd.vibrations.FrequencyResponse("rail", "rail", (0.1, 3.0), quantity="acceleration")
    reverse, forward = (
        measure.value_and_gradient(short(mass(), designs=x, variables=names, gradients=mode))
        for mode in ("reverse", "forward")
    )
    assert reverse.gradient is not None
    assert_close(reverse.gradient, forward.gradient, rtol=1e-9, atol=1e-13)
    for i, name in enumerate(names):
        h = 1e-4 * x[name]
        up, down = (measured(measure, mass(), x | {name: x[name] + sign * h}).detach() for sign in (1.0, -1.0))
        assert_close(reverse.gradient[:, i], (up - down) / (2.0 * h), rtol=1e-6, atol=1e-10)


M, K, C = 2.0, 8e3, 10.0  # of a mass on a round mount


def round_mount() -> mbd.System:
    disc = mbd.RigidBody("disc", M, (0.01, 0.01, 0.02))
    mount = mbd.Bushing(GROUND.at(), disc.at(), (K, K, 5e4), (C, C, C), (50.0, 50.0, 0.0), (0.1, 0.1, 0.0))
    return mbd.System([disc], [], [mount], free=["disc"])


@pytest.mark.parametrize("speed", [0.0, 30.0])
@pytest.mark.parametrize("direction", ["x", "y"])
def test_a_direction_of_the_ground_stands_still_while_the_machine_turns(direction, speed):
    """|1 / (k - m w^2 + i w c)| at any speed; an observer who turns does not see it, and says who does."""
    ports: dict[str, Any] = {"direction": direction, "input_direction": direction}
    motion, band = short(round_mount()), (5.0, 15.0)
    largest = mbd.vibrations.FrequencyResponse("disc", "disc", band, speed=speed, observer="ground", **ports).peak(
        motion
    )
    w = math.sqrt(K / M - 0.5 * (C / M) ** 2)
    assert float(largest.frequency) == pytest.approx(w / (2.0 * math.pi), rel=1e-9)
    assert float(largest.magnitude) == pytest.approx(abs(1.0 / (K - M * w * w + 1j * w * C)), rel=1e-9)
    turning = mbd.vibrations.FrequencyResponse("disc", "disc", band, speed=speed, **ports)
    if speed:
        with refused("observer", "turning", "output 1", "must be 'ground'"):
            turning(motion)
    else:
        assert float(turning(motion)) == pytest.approx(float(largest.magnitude), rel=1e-9)


def test_a_direction_along_the_axis_is_the_same_for_both_observers():
    motion = short(round_mount())
    ground, turning = (
        mbd.vibrations.FrequencyResponse(
            "disc", "disc", (5.0, 40.0), direction="z", input_direction="z", speed=30.0, observer=observer
        )(motion)
        for observer in ("ground", "turning")
    )
    assert_close(ground, turning, rtol=1e-9, atol=0.0)


@pytest.mark.parametrize(
    ("force", "observer", "message"),
    [
        ("x", "turning", r"output 1 is fixed in the ground across the axis"),
        ("z", "turning", r"output 1 is fixed in the ground across the axis"),
        ("x", "ground", None),
    ],
)
def test_matrices_and_data_refuse_what_their_observer_sees_turn(force, observer, message):
    system = round_mount()
    at, spin = system.bodies[0].at(), (0.0, 0.0, 30.0)
    inputs, outputs = mbd.signals.ForceOn(at, force), mbd.signals.PointPosition(at)
    state = mbd.equilibrium(system, spin=spin, observer=observer, unstable=True)
    shown = {"frequency": [8.0, 9.0], "sway": [1e-3 + 0j, 1e-3 + 0j]}
    data = mbd.identification.FrequencyResponseData(
        shown, inputs, {"sway": (outputs, "x")}, deviation={"sway": 1e-5}, spin=spin, observer=observer
    )
    if message is None:
        G = mbd.vibrations.linearize(system, [inputs], [outputs], state).response([8.0])[0, 0, 0]
        w = 16.0 * math.pi
        assert abs(G * (K - M * w * w + 1j * w * C) - 1.0) < 1e-9
        return
    with pytest.raises(mbd.InputError, match=message):
        mbd.vibrations.linearize(system, [inputs], [outputs], state)
    with pytest.raises(mbd.InputError, match=message):
        data.predict(Run(system, 1.0, {}, {}, mbd.Simulation(system, 1.0), 1, False), {})


def test_of_a_bent_blade_in_rotation():
    """By ply angles and a tip mass, with the state that moves with them. Peaks are as accurate as their damping, the share of
    the stiffness that is left at resonance, allows."""
    options: dict[str, Any] = {"direction": "z", "input_direction": "z", "input_place": "end"}
    measure = mbd.vibrations.FrequencyResponse("tip", "blade", (5.0, 40.0), speed=30.0, **options)
    system = blade(damping=3e-2)
    names = [*angles_of(system), "tip.mass"]
    x = {name: system.get_parameter(name).detach()[None] for name in names}
    assert measure.peak(short(system)).where == ["peak"]
    reverse, forward = (
        measure.value_and_gradient(short(system, designs=x, variables=names, gradients=mode))
        for mode in ("reverse", "forward")
    )
    assert reverse.gradient is not None
    assert_close(reverse.gradient, forward.gradient, rtol=1e-9, atol=1e-12)
    d = {names[0]: torch.tensor([[0.3, -0.7, 0.5, 1.0]], dtype=torch.float64), names[1]: torch.tensor([0.02]).double()}
    expected = 0.0
    for step, weight in ((1e-3, 8.0), (2e-3, -1.0)):
        up, down = (measured(measure, system, {n: x[n] + s * step * d[n] for n in names}) for s in (1.0, -1.0))
        expected = expected + weight * (up - down).detach() / (12.0 * 1e-3)
    along = torch.cat([d[n].flatten() for n in names])
    assert_close(reverse.gradient @ along, expected, rtol=1e-6, atol=0.0)


def test_the_largest_of_many_narrow_peaks():
    """Ten masses of other frequencies with little damping: the largest of all samples of a fine grid at the poles."""
    bodies, forces, joints = [], [], []
    for i in range(10):
        bodies.append(mbd.RigidBody(f"m{i}", 1.0, (1.0, 1.0, 1.0)))
        before = GROUND if not i else bodies[i - 1]
        joints.append(mbd.Prismatic(before.at(), bodies[i].at(), axis="x", name=f"j{i}"))
        forces.append(
            mbd.AxialSpringDamper(before.at(), bodies[i].at(), axis="x", stiffness=400.0, damping=1e-3 * (i + 1))
        )
    system = mbd.System(bodies, joints, forces)
    linear = mbd.vibrations.linearize(
        system, [mbd.signals.ForceOn(bodies[3].at(), "x")], [mbd.signals.PointPosition(bodies[6].at())]
    )
    poles = np.linalg.eigvals(linear.A)
    w = np.concatenate([s.imag + s.real * np.linspace(-1.0, 1.0, 2001) for s in poles if s.imag > 3.5])
    _, G = scipy.signal.freqresp((linear.A, linear.B, linear.C[:1], linear.D[:1]), w)
    options: dict[str, Any] = {"direction": "x", "input_direction": "x"}
    peak = mbd.vibrations.FrequencyResponse("m6", "m3", (3.5 / (2.0 * math.pi), 10.0), **options).peak(short(system))
    assert float(peak.magnitude) == pytest.approx(np.abs(G).max(), rel=1e-6)


def test_without_damping_it_is_infinite():
    motion = short(mass(d=0.0))
    with refused("band", ANY, "5 rad/s", kind=mbd.DesignFailure):
        mbd.vibrations.FrequencyResponse("rail", "rail", (0.1, 10.0))(motion)
    assert float(mbd.vibrations.FrequencyResponse("rail", "rail", (1.0, 2.0))(motion)) > 0.0


@pytest.mark.parametrize(
    ("change", "path"),
    [
        ({"output": "nobody"}, "output"),
        ({"output": 3}, "output"),
        ({"input": "load"}, "input_direction"),
        ({"direction": "x"}, "direction"),
        ({"output": "load", "direction": "y", "place": "tip"}, "place"),
        ({"band": (2.0, 1.0)}, "band"),
        ({"band": (-2.0, 1.0)}, "band"),
        ({"quantity": "jerk"}, "quantity"),
        ({"input_direction": "w"}, "input_direction"),
        ({"output": "load", "direction": "y", "place": (0.1, 0.2)}, "place"),
        ({"speed": -1.0}, "speed"),
    ],
)
def test_wrong_arguments_are_named(change, path):
    with refused(path):
        mbd.vibrations.FrequencyResponse(**{"output": "rail", "input": "rail"} | change).check(mass())


def test_what_cannot_move_does_not_respond():
    load = mbd.RigidBody("load", 2.0, (1.0, 1.0, 1.0))
    motion = short(mbd.System([load], [mbd.Fixed(GROUND.at(), load.at())]))
    ports = {"direction": "x", "input_direction": "x", "place": np.array([0.1, 0.0, 0.0])}
    assert mbd.vibrations.FrequencyResponse("load", "load", **ports)(motion).item() == 0.0


def test_in_inference_mode():
    system = mass()
    measure = mbd.vibrations.FrequencyResponse("rail", "rail", (0.1, 10.0))
    with torch.inference_mode():
        result, [rail] = measure(short(system)), system.joints
        linear = mbd.vibrations.linearize(system, [mbd.signals.JointForce(rail)], [mbd.signals.JointTravel(rail)])
    assert float(result) == float(measure(short(system)))
    assert linear.A[1].tolist() == [-25.0, -1.0]


def test_from_an_experiment_file():
    spec = {
        "output": "load",
        "direction": "y",
        "place": [0.1, 0.0, 0.0],
        "input": "rail",
        "band": [0.1, 10],
        "speed": 0,
    }
    measure = measure_of({"frequency_response": spec})
    assert measure == mbd.vibrations.FrequencyResponse(
        "load", "rail", (0.1, 10), direction="y", place=(0.1, 0.0, 0.0), speed=0
    )
    assert float(measure(short(mass()))) == pytest.approx(0.1005037815259212, rel=1e-10)


def test_a_response_of_zero_has_a_value_and_no_derivative():
    """Across its rail the load does not move: zeros would be no derivative of the magnitude."""
    system = mass()
    across = mbd.vibrations.FrequencyResponse("load", "rail", (0.1, 10.0), direction="x")
    with torch.no_grad():
        assert across(short(system)).item() == 0.0
    with refused("output", kind=mbd.DesignFailure):
        across(short(system, gradients="reverse"))
