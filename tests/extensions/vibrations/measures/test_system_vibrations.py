"""Measures of vibrations of the whole system: closed forms, gradients in both modes, statuses of designs without a state."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.extensions.vibrations.test_eigenvalues import angles_of, blade
from tests.refused import refused
from torchmbd.design.words import heading

pytestmark = pytest.mark.thorough

V, GROUND = mbd.variable, mbd.Ground()


def carriage(stiffness: Any = 50.0, damping: Any = 2.0) -> mbd.System:
    """Two masses on a rail between springs: 2 kg and 1 kg."""
    first, second = (mbd.RigidBody(name, m, (1.0, 1.0, 1.0)) for name, m in (("first", 2.0), ("second", 1.0)))
    rails = [mbd.Prismatic(GROUND.at(), b.at(), axis="y", name=f"rail_{b.name}") for b in (first, second)]
    ends = [(GROUND, first), (first, second)]
    springs = [
        mbd.AxialSpringDamper(
            a.at(), b.at(), axis="y", stiffness=V(stiffness), damping=V(damping), name=f"spring_{b.name}"
        )
        for a, b in ends
    ]
    return mbd.System([first, second], rails, springs)


def measured(measure: mbd.Measure, system: mbd.System, designs: dict[str, Tensor], **options: Any) -> Tensor:
    return measure(mbd.simulate(system, 1e-4, steps=2, designs=designs, **options))


def poles(k: float, d: float) -> Tensor:
    M, K = torch.diag(torch.tensor([2.0, 1.0])).double(), k * torch.tensor([[2.0, -1.0], [-1.0, 1.0]]).double()
    A = torch.zeros(4, 4, dtype=torch.float64)
    A[:2, 2:] = torch.eye(2)
    A[2:, :2], A[2:, 2:] = -torch.linalg.solve(M, K), -torch.linalg.solve(M, d / k * K)
    return torch.linalg.eigvals(A)


def test_two_masses_in_closed_form():
    system, s = carriage(), poles(50.0, 2.0)
    upper = s[s.imag > 0.0]
    upper = upper[upper.imag.argsort()]
    motion = mbd.simulate(system, 1e-4, steps=2)
    squares = torch.linalg.eigvals(torch.tensor([[50.0, -25.0], [-50.0, 50.0]]).double()).real.sort().values
    w = squares.sqrt() / (2.0 * math.pi)
    for k in (1, 2):
        assert float(mbd.vibrations.SystemFrequency(k)(motion)) == pytest.approx(float(w[k - 1]), rel=1e-10)
        assert float(mbd.vibrations.DampingRatio(k)(motion)) == pytest.approx(
            float((-upper.real / upper.abs())[k - 1]), rel=1e-9
        )
    assert float(mbd.vibrations.StabilityMargin()(motion)) == pytest.approx(float(s.real.max()), rel=1e-9)
    smooth = float(mbd.vibrations.StabilityMargin(sharpness=20.0)(motion))
    assert float(s.real.max()) < smooth < float(s.real.max()) + math.log(4.0) / 20.0
    mean = float(mbd.vibrations.SystemFrequency(cluster=(1, 2))(motion))
    assert mean == pytest.approx(float(w.square().mean().sqrt()), rel=1e-10)


MEASURES = [
    mbd.vibrations.SystemFrequency(2),
    mbd.vibrations.SystemFrequency(cluster=(1, 2), power=-2.0),
    mbd.vibrations.DampingRatio(1),
    mbd.vibrations.StabilityMargin(),
    mbd.vibrations.StabilityMargin(sharpness=5.0),
    2.0 * mbd.vibrations.SystemFrequency(1) - mbd.vibrations.DampingRatio(2),
]


@pytest.mark.parametrize("measure", MEASURES, ids=str)
def test_gradients_in_both_modes_and_lanes(measure):
    system, names = carriage(), ["spring_first.stiffness", "spring_second.damping"]
    x = {names[0]: torch.tensor([40.0, 60.0]).double(), names[1]: torch.tensor([2.0, 1.0]).double()}
    reverse, forward = (
        measure.value_and_gradient(mbd.simulate(system, 1e-4, steps=2, designs=x, variables=names, gradients=mode))
        for mode in ("reverse", "forward")
    )
    assert_close(reverse.value, forward.value)
    assert reverse.gradient is not None
    assert_close(reverse.gradient, forward.gradient, rtol=1e-9, atol=1e-13)
    for k, name in enumerate(names):
        h = 1e-4 * x[name]
        up, down = (measured(measure, system, x | {name: x[name] + sign * h}).detach() for sign in (1.0, -1.0))
        assert_close(reverse.gradient[:, k], (up - down) / (2.0 * h), rtol=1e-6, atol=1e-10)


def test_measures_of_one_evaluation_share_the_state(monkeypatch):
    calls = []
    module = __import__("torchmbd.extensions.vibrations.measures.system_vibrations", fromlist=["steady_states"])
    original = module.steady_states
    monkeypatch.setattr(module, "steady_states", lambda *args: calls.append(args) or original(*args))
    problem = mbd.Problem(
        carriage(),
        1e-4,
        mbd.vibrations.SystemFrequency(1),
        [mbd.vibrations.DampingRatio(1) >= 0.01, mbd.vibrations.SystemFrequency(2) >= 1.0],
        steps=2,
    )
    problem.reference  # noqa: B018  simulates the start, if it must
    calls.clear()
    problem.evaluate(problem.start[None], True)
    assert len(calls) == 1


def test_values_first_and_gradients_later():
    """Numbers that were asked for without gradients are no obstacle to those with."""
    system = carriage()
    x = torch.tensor([40.0], dtype=torch.float64, requires_grad=True)
    rest = mbd.equilibrium(system, designs={"spring_first.stiffness": x})
    with torch.no_grad():
        plain = rest.frequencies, rest.poles
    assert not any(y.requires_grad for y in plain)
    (rest.frequencies.sum() + rest.poles.real.sum()).backward()
    assert x.grad is not None
    assert float(x.grad) > 0.0


def test_campbell_clearance_of_a_blade():
    """Against frequencies at each speed; a band that an order crosses is negative."""
    system = blade(speed=30.0)
    name = angles_of(system)[0]
    measure = mbd.vibrations.CampbellClearance((1.0, 3.0), band=(25.0, 30.0), modes=(1, 2), points=3)
    x = system.get_parameter(name).detach()[None].clone().requires_grad_()
    got = measured(measure, system, {name: x})
    rows = []
    for speed in (25.0, 27.5, 30.0):
        w = 2.0 * math.pi * mbd.equilibrium(blade(speed=speed), spin=(0.0, 0.0, speed)).frequencies[0, :2]
        rows.append(w[:, None] / (torch.tensor([1.0, 3.0]) * speed) - 1.0)
    e = torch.stack(rows, -1)
    expected = torch.maximum(e.amin(-1), (-e).amin(-1)).flatten()
    assert_close(got[0].detach(), expected, rtol=1e-8, atol=1e-10)
    (by,) = torch.autograd.grad(got.sum(), x)
    d = torch.randn(x.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    h = 3e-3
    places = (1.0, -1.0, 2.0, -2.0)
    up, down, far_up, far_down = (measured(measure, system, {name: x.detach() + k * h * d}).sum() for k in places)
    slope = (8.0 * (up - down) - (far_up - far_down)) / (12.0 * h)
    assert float((by * d).sum()) == pytest.approx(float(slope), rel=1e-6)
    first = float(e[0, 0, 1] + 1.0)  # the first frequency at 27.5 rad/s by this speed
    crossed = mbd.vibrations.CampbellClearance((first,), band=(25.0, 30.0), modes=(1,), points=3)
    assert float(measured(crossed, system, {name: x.detach()})) < 0.0


def test_designs_without_a_state_are_statuses():
    """A spring that pushes has no stable state: the design fails by name, the other lane stays."""
    problem = mbd.Problem(
        carriage(),
        1e-4,
        mbd.vibrations.SystemFrequency(1),
        variables=["spring_first.stiffness"],
        bounds=(-100.0, 100.0),
        steps=2,
    )
    good, bad = problem.evaluate([[50.0], [-80.0]], True)
    assert good.status == "ok"
    assert "eigenvalue 1 has no derivative, because it is not a number" in bad.status


@pytest.mark.parametrize(
    ("make", "fault"),
    [
        (lambda: mbd.vibrations.SystemFrequency(0), ("number", 0)),
        (lambda: mbd.vibrations.SystemFrequency(cluster=(1, 1)), ("cluster", (1, 1))),
        (lambda: mbd.vibrations.SystemFrequency(3, cluster=(1, 2)), ("number", 3)),
        (lambda: mbd.vibrations.SystemFrequency(1, power=0.0), ("power", 0.0)),
        (lambda: mbd.vibrations.SystemFrequency(1, speed=-1.0), ("speed", -1.0)),
        (lambda: mbd.vibrations.DampingRatio(1, axis="w"), ("axis", "w")),
        (lambda: mbd.vibrations.DampingRatio(1, observer="moon"), ("observer", "moon")),
        (lambda: mbd.vibrations.StabilityMargin(sharpness=-1.0), ("sharpness", -1.0)),
        (lambda: mbd.vibrations.CampbellClearance((0.0,), (1.0, 2.0)), ("orders", 0.0)),
        (lambda: mbd.vibrations.CampbellClearance((1.0,), (1.0, 2.0), modes=([1],)), ("modes", [1])),
        (lambda: mbd.vibrations.SystemFrequency(1, center="a"), ("center", "a")),
        (lambda: mbd.vibrations.StabilityMargin(sharpness=1.0)(mbd.simulate(fixed(), 1e-4, steps=2)), ("system",)),
        (lambda: mbd.vibrations.CampbellClearance((1.0,), (2.0, 1.0)), ("band", (2.0, 1.0))),
        (lambda: mbd.vibrations.CampbellClearance((1.0,), (1.0, 2.0), points=1), ("points", 1)),
        (lambda: mbd.vibrations.SystemFrequency(9)(mbd.simulate(carriage(), 1e-4, steps=2)), ("number",)),
        (lambda: mbd.vibrations.DampingRatio(9)(mbd.simulate(carriage(), 1e-4, steps=2)), ("number",)),
    ],
)
def test_bad_arguments_are_named(make, fault):
    with refused(*fault):
        make()


def fixed() -> mbd.System:
    """A body without a freedom."""
    body = mbd.RigidBody("load", 2.0, (1.0, 1.0, 1.0))
    return mbd.System([body], [mbd.Fixed(mbd.Ground().at(), body.at())])


def test_axes_as_arrays_are_those_as_words():
    """Measures are compared and are keys, which arrays cannot be."""
    by_array = mbd.vibrations.SystemFrequency(
        1, axis=np.array([0.0, 0.0, 1.0]), center=torch.zeros(3, dtype=torch.float64)
    )
    assert by_array == mbd.vibrations.SystemFrequency(1, axis=(0.0, 0.0, 1.0))
    problem = mbd.Problem(carriage(), 1e-4, by_array, [by_array >= 0.01], steps=2)
    assert problem.evaluate(problem.start[None], False)[0].status == "ok"


@pytest.mark.parametrize(
    ("response", "said"),
    [
        (mbd.vibrations.SystemFrequency(1), "system frequency [Hz]"),
        (mbd.vibrations.SystemFrequency(2, speed=30.0, axis="x"), "system frequency 2 at 30 rad/s [Hz]"),
        (mbd.vibrations.DampingRatio(1, speed=30.0), "damping ratio at 30 rad/s"),
        (mbd.vibrations.CriticalSpeed(2), "critical speed 2 [rad/s]"),
        (mbd.vibrations.CampbellClearance(), "campbell clearance"),
    ],
)
def test_vibrations_of_the_system_have_number_and_speed(response, said):
    assert heading(response) == said
