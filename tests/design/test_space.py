"""The design space: order and names of variables, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import laminate, plate, rigid_pendulum
from torchmbd.design import DesignSpace
from torchmbd.errors import InputError


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
    ("given", "words"),
    [
        (
            {"variables": ["two.laminate.angle"]},
            ["parameter 'two.laminate.angle'", "did you mean 'two.laminate.angles'"],
        ),
        ({"bounds": (0.0, 1.0, 2.0)}, ["bounds is (0.0, 1.0, 2.0)", "two entries, (lower, upper)"]),
        ({"bounds": 1.0}, ["bounds is 1.0", "(lower, upper)"]),
        ({"bounds": ([0.0] * 4, 1.0)}, ["lower bound has 4 values", "allowed: 5, or one number for all"]),
        (
            {"bounds": (1.0, -1.0)},
            ["lower bound of one.laminate.angles[0]", "= 1 rad (57.2958 deg)", "must be below upper = -1 rad"],
        ),
        ({"bounds": (np.nan, 1.0)}, ["lower", "nan", "numbers"]),
        (
            {"bounds": (0.5, 2.0)},
            [
                "start of one.laminate.angles[0]",
                "(20 deg)",
                "must lie between 0.5 rad (28.6479 deg) and 2 rad (114.592 deg)",
            ],
        ),
        ({"start": [0.0, 1.0]}, ["start has 2 values", "allowed: 5, or one number for all"]),
        ({"start": [np.nan] * 5}, ["start", "nan", "numbers"]),
        ({"bounds": ("low", 1.0)}, ["lower bound is 'low'", "numbers"]),
        ({"bounds": ([0.0, "b", 0.0, 0.0, 0.0], 1.0)}, ["lower bound is", "'b'", "numbers"]),
        ({"variables": ["two.laminate.angles"] * 2}, ["variables is", "each parameter once"]),
    ],
    ids=lambda x: "-".join(x) if isinstance(x, dict) else "",
)
def test_bad_input_is_named_with_its_value_and_what_is_allowed(given, words, system):
    with pytest.raises(InputError) as error:
        DesignSpace(system, **given)
    for word in words:
        assert word in str(error.value)
    assert "allowed" in str(error.value) or "must" in str(error.value)


def test_a_system_without_parameters_has_no_designs():
    with pytest.raises(InputError, match="no parameter that requires a gradient; allowed: at least one"):
        DesignSpace(rigid_pendulum())


def test_designs_of_a_wrong_shape(system):
    for X in (np.zeros(5), np.zeros((2, 4))):
        with pytest.raises(InputError, match=r"designs have shape .*; allowed: \[lanes, 5\]"):
            DesignSpace(system).designs(X)
