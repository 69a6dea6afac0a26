"""Combinations that cannot be seen, in words."""

from __future__ import annotations

import numpy as np
import pytest

from torchmbd.extensions.identification.unseen import singular_values, unseen_combinations

T = np.linspace(0.5, 2.0, 40)
FORMS = {
    "a and b only as a product": lambda a, b, c: a * b * T + c * T**2,
    "a and b only as a quotient": lambda a, b, c: a / b * T + c * T**2,
    "a and b only as a sum": lambda a, b, c: (a + b) * T + c * T**2,
    "a and b only as a difference": lambda a, b, c: (a - b) * T + c * T**2,
    "b not at all": lambda a, b, c: a * T + c * T**2,
    "a, b and c only up to a common factor": lambda a, b, c: (a * T + b * T**2) / c,
    "a, b and c only up to a common factor, opposite for b, c": lambda a, b, c: a * b * T + a * c * T**2,
    "a, b and c only up to a common summand": lambda a, b, c: (a - b) * T + (a - c) * T**2,
}


def named(f, x: np.ndarray, deviation: float = 1e-3) -> list[str]:
    def values(x):
        return f(*x) / deviation

    J = np.stack([(values(x + d) - values(x - d)) / 2e-6 for d in 1e-6 * np.eye(3)], 1)
    return [u.words for u in unseen_combinations(J, np.abs(x), ["a[0]", "b[0]", "c[0]"], x, values)]


@pytest.mark.parametrize("words", FORMS)
def test_the_form_is_named(words):
    assert named(FORMS[words], np.array([2.0, 3.0, 5.0])) == [words]


def test_of_equal_values_a_product_is_no_sum():
    assert named(FORMS["a and b only as a product"], np.array([2.0, 2.0, 5.0])) == ["a and b only as a product"]
    assert named(FORMS["a and b only as a sum"], np.array([2.0, 2.0, 5.0])) == ["a and b only as a sum"]


def test_what_has_no_simple_form_is_a_direction():
    [words] = named(lambda a, b, c: a**2 * b * T + c * T**2, np.array([2.0, 3.0, 5.0]))
    assert words.startswith("a and b not along ")


def test_two_directions():
    assert sorted(named(lambda a, b, c: a * T, np.array([2.0, 3.0, 5.0]))) == ["b not at all", "c not at all"]


def test_what_is_seen_has_no_words():
    assert named(lambda a, b, c: a * T + b * T**2 + c, np.array([2.0, 3.0, 5.0])) == []


def test_what_noise_hides_is_unseen():
    """c moves the data by a tenth of their noise."""
    assert named(lambda a, b, c: a * T + b * T**2 + 1e-6 * c * T**3, np.array([2.0, 3.0, 5.0])) == ["c not at all"]


def test_singular_values_of_fewer_rows_than_unknowns():
    values, vectors = singular_values(np.array([[3.0, 4.0, 0.0]]), np.ones(3))
    np.testing.assert_allclose(values, [5.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(np.abs(vectors[:, 0]), [0.6, 0.8, 0.0], atol=1e-12)
