"""Exhaustive enumeration on a tiny rod: mirror pairs, what is best, what is a minimum; the stored grid."""

from __future__ import annotations

import json
from itertools import product

import numpy as np
import pytest

from experiments.paper.discrete import Within, problem_of
from experiments.paper.enumeration import Enumeration, enumerate_all, grid
from experiments.paper.minima import STORED

TINY = {"cells": (4, 2), "modes": 3, "steps": 120, "kind": "triangle"}  # the limit of 3f is one for triangles


@pytest.mark.parametrize(("layers", "increment"), [(1, 45.0), (2, 30.0), (3, 45.0)])
def test_a_grid_and_its_mirror_image_are_all_designs(layers, increment):
    X, size = grid(layers, increment)
    degrees = np.rint(np.degrees(X))
    both = {tuple(x) for x in degrees} | {tuple(np.where(x == 90, 90, -x + 0.0)) for x in degrees}
    assert len(both) == size == round(180 / increment) ** layers
    fixed = (np.abs(degrees) % 90 == 0).all(axis=1).sum()  # their own mirror image
    assert 2 * len(X) - fixed == size


def test_a_grid_within_a_limit():
    X, size = grid(2, 15.0, 45.0)
    degrees = np.rint(np.degrees(X))
    assert {tuple(x) for x in degrees} | {tuple(-x + 0.0) for x in degrees} == set(
        product(range(-45, 46, 15), repeat=2)
    )
    assert (len(X), size) == (25, 49)  # all zero is its own mirror image


def test_a_problem_within_a_limit():
    whole = problem_of("3f", 2, **TINY)
    within = Within(whole, 45.0)
    np.testing.assert_allclose(np.degrees([*within.lower, *within.upper]), [-45, -45, 45, 45])
    assert within.names == whole.names


@pytest.mark.thorough
def test_enumeration_says_what_the_problem_says_of_the_mirror_images():
    problem = problem_of("3f", 2, **TINY)
    result = enumerate_all({"": problem}, 15.0, lanes=41)[""]
    expected = problem.evaluate(-result.X, False)
    feasible = np.array([e.constraints.max() <= 1e-6 for e in expected])
    assert 0 < feasible.sum() < len(expected)
    np.testing.assert_allclose(result.value[feasible], np.array([e.objective for e in expected])[feasible], rtol=1e-8)
    assert np.isinf(result.value[~feasible]).all()
    assert result.value[[np.array_equal(x, result.best) for x in result.X].index(True)] == result.value.min()
    assert result.rank(float(np.sort(result.value)[2])) == 2


@pytest.mark.thorough
def test_constraints_of_one_problem_are_not_those_of_another():
    together = enumerate_all({table: problem_of(table, 2, **TINY) for table in ("3f", "4")}, 30.0)
    alone = enumerate_all({"4": problem_of("4", 2, **TINY)}, 30.0)["4"]
    np.testing.assert_allclose(together["4"].value, alone.value, rtol=1e-10)  # rounding of another batch
    assert np.isinf(together["3f"].value).any()


def test_minima_of_a_grid():
    """Two valleys on the circle of one angle, at 0 and at 90 degrees; every angle of the half that is listed."""
    X, size = grid(1, 15.0)
    enumeration = Enumeration(X, 2.0 - np.cos(4 * X[:, 0]) - 0.3 * np.cos(2 * X[:, 0]), size)
    minima = enumeration.minima(np.radians(15.0))
    np.testing.assert_allclose(np.degrees(enumeration.X[minima, 0]), [0.0, 90.0], atol=1e-9)


def test_the_stored_grid_is_complete():
    stored = json.loads(STORED.read_text(encoding="utf-8"))
    assert stored["designs"] == 36**3
    assert len(stored["refined"]) == len(stored["minima_of_the_grid"])
    assert stored["best"] == min(end["value"] for end in stored["refined"])
