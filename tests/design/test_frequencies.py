"""Frequencies of a square plate whose symmetry makes pairs of them equal: [45, -45] turns into itself upside down."""

from __future__ import annotations

import pytest
import torch

import torchmbd as mbd
from tests.mechanisms import CARBON
from tests.refused import refused
from torchmbd.design.response_spec import measure_of

DESIGN = mbd.deg([45.0, -45.0])
VARIABLES = ["sheet.laminate.angles", "sheet.laminate.thickness"]
STEPS = torch.tensor([1e-3, 1e-3, 1e-6, 1e-6], dtype=torch.float64)  # rad, m


def square() -> mbd.System:
    """Two layers, held at the center."""
    laminate = mbd.Laminate(mbd.Ply(**CARBON), angles=DESIGN, thickness=1e-3)
    mesh = mbd.mesh.rectangle(0.2, 0.2, cells=(4, 4), kind="quad")
    sheet = mbd.FlexibleBody.plate("sheet", mesh, laminate, modes=6, reference="center")
    return mbd.System(bodies=[sheet], joints=[mbd.Fixed(mbd.Ground().at(), sheet.at("center"))])


@pytest.fixture(scope="module")
def motions():
    """The symmetric design with sensitivities, and its neighbors by -+STEPS in each variable."""
    system = square()
    shifts = torch.cat([torch.diag(STEPS), -torch.diag(STEPS)])
    designs = dict(zip(VARIABLES, (DESIGN + shifts[:, :2], 1e-3 + shifts[:, 2:]), strict=True))
    exact = mbd.simulate(system, 1e-5, steps=1, gradients="forward", variables=VARIABLES)
    return exact, mbd.simulate(system, 1e-5, steps=1, designs=designs)


def pair(motion) -> int:
    """The lower number of the first pair."""
    values = [float(mbd.Frequency("sheet", k).value(motion)[0]) for k in range(1, 7)]
    return next(k for k in range(1, 6) if values[k] - values[k - 1] < 1e-8 * values[k])


def differences(measure, neighbors):
    value = measure.value(neighbors)
    return (value[:4] - value[4:]) / (2 * STEPS)


def test_a_frequency_of_a_pair_has_the_mean_of_both_slopes(motions):
    exact, neighbors = motions
    low = pair(exact)
    both = [mbd.Frequency("sheet", low), mbd.Frequency("sheet", low + 1)]
    mean = differences(0.5 * both[0] + 0.5 * both[1], neighbors)
    sides = both[1].value(neighbors) - both[0].value(neighbors)
    assert (sides[[0, 1, 4, 5]] / STEPS[[0, 1, 0, 1]]).min() > 5.0  # Hz/rad: each of them has a corner
    assert mean[2:].min() > 1e4  # Hz/m
    for one in both:
        torch.testing.assert_close(one.value_and_gradient(exact).gradient[0], mean, rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize("power", [1.0, -1.0, 3.0, -12.0])
def test_the_power_mean_of_a_pair_has_a_gradient(motions, power):
    exact, neighbors = motions
    low = pair(exact)
    measure = mbd.MeanFrequency("sheet", (low, low + 1), power)
    value, gradient = measure.value_and_gradient(exact)
    assert float(value[0]) == pytest.approx(float(mbd.Frequency("sheet", low).value(exact)[0]))
    torch.testing.assert_close(gradient[0], differences(measure, neighbors), rtol=1e-5, atol=1e-2)


def test_the_power_mean_lies_between_lowest_and_highest(motions):
    exact, _ = motions
    each = torch.stack([mbd.Frequency("sheet", k).value(exact) for k in (1, 4, 6)])
    for power in (-200.0, -1.0, 1.0, 200.0):
        squares = (each / each.amin()) ** (2 * power)
        expected = each.amin() * squares.mean(0) ** (1 / (2 * power))
        torch.testing.assert_close(mbd.MeanFrequency("sheet", (1, 4, 6), power).value(exact), expected)


@pytest.mark.parametrize(
    ("given", "path"),
    [
        ({"cluster": ()}, "cluster"),
        ({"cluster": (2, 2)}, "cluster"),
        ({"cluster": 2}, "cluster"),
        ({"cluster": (1, 2), "power": 0.0}, "power"),
        ({"cluster": (1, 2), "power": float("nan")}, "power"),
    ],
)
def test_wrong_arguments_are_named(given, path):
    with refused(path):
        mbd.MeanFrequency("sheet", **given)


def test_a_mode_that_is_not_retained_is_named(motions):
    with refused("number", 99):
        mbd.MeanFrequency("sheet", (6, 99)).value(motions[0])


SUPPORTS = {"left_edge": "u1 u2 u3 phi1", "right_edge": "u3"}


def test_frequencies_on_supports_are_those_of_the_body(motions):
    exact, neighbors = motions
    expected = mbd.natural_frequencies(exact.system.body("sheet"), SUPPORTS, 3).frequencies.detach()
    for number in (1, 3):
        measure = mbd.Frequency("sheet", number, SUPPORTS)
        value, gradient = measure.value_and_gradient(exact)
        torch.testing.assert_close(value[0], expected[number - 1])
        torch.testing.assert_close(gradient[0], differences(measure, neighbors), rtol=1e-5, atol=1e-2)
    mean = mbd.MeanFrequency("sheet", (1, 3), supports=SUPPORTS).value(exact)[0]
    torch.testing.assert_close(mean, (0.5 * (expected[0] ** 2 + expected[2] ** 2)).sqrt())


@pytest.mark.parametrize(
    ("given", "path"),
    [
        ({"supports": {"edge": "all"}}, "node"),
        ({"supports": {"left_edge": "u7"}}, "sheet.supports.left_edge"),
        ({"supports": SUPPORTS, "number": 0}, "number"),
        ({"supports": SUPPORTS, "number": 999}, "number"),
    ],
)
def test_wrong_supports_are_named(motions, given, path):
    with refused(path):
        mbd.Frequency("sheet", **given).check(motions[0].system)


def test_supports_in_a_file():
    spec = {"frequency": {"body": "sheet", "number": 3, "supports": {"left_edge": "all"}}}
    assert measure_of(spec) == mbd.Frequency("sheet", 3, {"left_edge": "all"})
