"""The design space: order and names of variables, and what it refuses."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import laminate, plate, rigid_pendulum
from tests.refused import ANY, refused
from torchmbd.design import DesignSpace


@pytest.fixture(scope="module")
def system() -> mbd.System:
    return mbd.System([plate("one"), plate("two", made_of=laminate((10.0, 80.0)))])


def test_variables_stand_in_the_order_of_their_names(system):
    space = DesignSpace(system, ["two.laminate.angles", "one.laminate.angles"], bounds=mbd.deg([-90, 90]))
    assert space.names == [
        *(f"two.laminate.angles[{i}]" for i in range(2)),
        *(f"one.laminate.angles[{i}]" for i in range(3)),
    ]
    assert space.start == pytest.approx(np.radians([10.0, 80.0, 20.0, -50.0, 75.0]))
    assert (space.lower == -np.pi / 2).all()
    assert (space.upper == np.pi / 2).all()
    X = np.arange(10.0).reshape(2, 5)
    designs = space.designs(X)
    assert list(designs) == ["two.laminate.angles", "one.laminate.angles"]
    assert_close(designs["two.laminate.angles"], torch.tensor([[0.0, 1.0], [5.0, 6.0]], dtype=torch.float64))
    assert_close(designs["one.laminate.angles"], torch.tensor([[2.0, 3.0, 4.0], [7.0, 8.0, 9.0]], dtype=torch.float64))


def test_the_default_is_every_parameter_that_requires_a_gradient(system):
    assert DesignSpace(system).variables == ["one.laminate.angles", "two.laminate.angles"]
    thickness = DesignSpace(system, ["one.laminate.thickness"])
    assert thickness.start == pytest.approx([2.5e-3] * 3)


def test_bounds_and_start_one_for_each(system):
    space = DesignSpace(
        system, ["two.laminate.angles"], bounds=([-1.0, -2.0], [1.0, 2.0]), start=torch.tensor([0.5, -1.5])
    )
    assert space.lower.tolist() == [-1.0, -2.0]
    assert space.upper.tolist() == [1.0, 2.0]
    assert space.start.tolist() == [0.5, -1.5]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (
            {"variables": ["two.laminate.angle"]},
            (
                "variables.two.laminate.angle",
                "two.laminate.angle",
                "parameter = 'two.laminate.angle'",
                "Try: 'two.laminate.angles'",
            ),
        ),
        ({"bounds": (0.0, 1.0, 2.0)}, ("bounds", (0.0, 1.0, 2.0))),
        ({"bounds": 1.0}, ("bounds", 1.0)),
        (
            {"bounds": ([0.0] * 4, 1.0)},
            ("lower", [0.0, 0.0, 0.0, 0.0], "lower bound has 4 values", "must have 5, or one number for all"),
        ),
        (
            {"bounds": (1.0, -1.0)},
            (
                "lower.one.laminate.angles[0]",
                ANY,
                "lower bound of one.laminate.angles[0]",
                "= 1 rad (57.2958 deg)",
                "must be below upper = -1 rad",
            ),
        ),
        ({"bounds": (np.nan, 1.0)}, ("lower", math.nan)),
        (
            {"bounds": (0.5, 2.0)},
            (
                "start.one.laminate.angles[0]",
                ANY,
                "start of one.laminate.angles[0]",
                "(20 deg)",
                "must lie between 0.5 rad (28.6479 deg) and 2 rad (114.592 deg)",
            ),
        ),
        ({"start": [0.0, 1.0]}, ("start", [0.0, 1.0], "start has 2 values", "must have 5, or one number for all")),
        ({"start": [np.nan] * 5}, ("start", ANY, "nan")),
        ({"bounds": ("low", 1.0)}, ("lower", "low", "lower bound = 'low'")),
        ({"bounds": ([0.0, "b", 0.0, 0.0, 0.0], 1.0)}, ("lower", [0.0, "b", 0.0, 0.0, 0.0], "lower bound = ")),
        ({"variables": ["two.laminate.angles"] * 2}, ("variables", ["two.laminate.angles", "two.laminate.angles"])),
        ({"variables": "two.laminate.angles"}, ("variables", "two.laminate.angles")),
    ],
    ids=lambda x: "-".join(x) if isinstance(x, dict) else "",
)
def test_bad_input_is_named_with_its_value_and_what_is_allowed(given, said, system):
    with refused(*said):
        DesignSpace(system, **given)


def test_a_system_without_parameters_has_no_designs():
    with refused("variables"):
        DesignSpace(rigid_pendulum())


def test_designs_of_a_wrong_shape(system):
    for X in (np.zeros(5), np.zeros((2, 4))):
        with refused("designs"):
            DesignSpace(system).designs(X)


class Swing(torch.nn.Module):
    """A controller with parameters of the names of a laminate; it has no period."""

    def __init__(self, angles: torch.nn.Parameter | None = None):
        super().__init__()
        start = torch.tensor([0.3, -0.4], dtype=torch.float64)
        self.angles = torch.nn.Parameter(start) if angles is None else angles

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.angles.sum(-1, keepdim=True) * x


class Turn(Swing):
    """One that repeats itself."""

    periods: ClassVar = {"angles": 2.0 * np.pi}


def controlled(module: torch.nn.Module, angles: torch.nn.Parameter | None = None) -> mbd.System:
    """A rod on a hinge with a controlled torque."""
    ground = mbd.Ground()
    rod = plate("rod", made_of=laminate() if angles is None else mbd.Laminate(mbd.examples.carbon(), angles, 2e-3))
    hinge = mbd.Revolute(ground.at(), rod.at("left"), axis="z", name="hinge")
    signals = [mbd.signals.JointAngle(hinge)], [mbd.signals.JointTorque(hinge)]
    return mbd.System([rod], [hinge], [mbd.Controller(module, *signals, name="law")])


def test_the_period_is_that_of_the_module_that_owns_a_parameter():
    for module, period in ((Swing(), 0.0), (Turn(), 2.0 * np.pi)):
        space = DesignSpace(controlled(module), ["law.angles", "rod.laminate.angles"])
        assert space.period == pytest.approx([period] * 2 + [np.pi] * 3)


def test_a_parameter_that_several_modules_share_repeats_itself_where_all_do():
    angles = torch.nn.Parameter(torch.tensor([0.3, -0.4], dtype=torch.float64))
    for module, period in ((Swing(angles), 0.0), (Turn(angles), 2.0 * np.pi)):
        assert DesignSpace(controlled(module, angles), ["rod.laminate.angles"]).period == pytest.approx([period] * 2)


@pytest.mark.parametrize(
    ("factor", "period"),
    [
        (-1.0, np.pi),
        (2.0, np.pi),
        (0.5, 2.0 * np.pi),
        (-1.0 / 3.0, 3.0 * np.pi),
        (1.5, 2.0 * np.pi),
        (np.sqrt(2.0), 0.0),
    ],
)
def test_the_period_of_a_variable_is_that_of_all_that_follow_it(system, factor, period):
    links = {"two.laminate.angles[1]": {"two.laminate.angles[0]": factor, "constant": 0.1}}
    space = DesignSpace(system, ["two.laminate.angles"], links=links)
    assert space.period == pytest.approx([period], rel=1e-12)
    if period:
        first, last = (space.designs(space.start[None] + x)["two.laminate.angles"] for x in (0.0, period))
        assert_close(torch.polar(torch.ones_like(first), 2.0 * first), torch.polar(torch.ones_like(last), 2.0 * last))


def test_a_follower_without_a_period_ends_that_of_its_leader(system):
    links = {"two.laminate.thickness[0]": {"two.laminate.angles[1]": 1e-3, "constant": 2e-3}}
    space = DesignSpace(system, ["two.laminate.angles", "two.laminate.thickness"], links=links)
    assert space.period == pytest.approx([np.pi, 0.0, 0.0])


def test_tolerances_narrow_the_bounds_of_what_does_not_repeat_itself():
    problem = mbd.Problem(
        controlled(Swing()),
        0.01,
        mbd.Integral(mbd.StrainEnergy("rod")),
        bounds=(-1.0, 1.0),
        variables=["law.angles", "rod.laminate.angles"],
        start=[0.3, -0.4, 0.0, 0.0, 0.0],
        steps=4,
    )
    robust = mbd.optimization.RobustProblem(problem, 0.1)
    assert robust.upper == pytest.approx([0.9] * 2 + [1.0] * 3)


@pytest.mark.thorough
def test_many_variables_have_no_matrix_of_all_pairs():
    """100,000 gains of a controller; a matrix of n x n numbers would have 80 GB."""
    n = 100_000
    parameters = {"gains": torch.zeros(n, dtype=torch.float64), "rest": torch.zeros(2, dtype=torch.float64)}
    links = {f"gains[{k}]": {f"gains[{k - 1}]": -1.0, "constant": 0.5} for k in range(1, 1000, 2)}
    space = DesignSpace.of_parameters(parameters, (-1.0, 1.0), links=links)
    assert len(space.names) == n + 2 - 500
    x = np.random.default_rng(1).uniform(-1.0, 1.0, (2, len(space.names)))
    entries = torch.cat(list(space.designs(x).values()), 1)
    assert_close(entries[:, 1:1000:2], 0.5 - entries[:, 0:1000:2])
    by_entries = np.random.default_rng(2).normal(size=(2, 3, n + 2))
    slopes = space.slopes(by_entries)
    np.testing.assert_array_equal(slopes[..., :500], by_entries[..., 0:1000:2] - by_entries[..., 1:1000:2])
    np.testing.assert_array_equal(slopes[..., 500:], by_entries[..., 1000:])
