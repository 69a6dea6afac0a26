"""MMFD solves the Hock-Schittkowski problems, and never needs more than three times SLSQP's functions or gradients."""

from functools import cache

import pytest

from tests.optimization.counts import count, plain_slsqp, problems

PROBLEMS = {p.name: p for p in problems()}


@cache
def ours_and_plain(name):
    return count(PROBLEMS[name], "mmfd"), plain_slsqp(PROBLEMS[name])


@pytest.mark.parametrize("name", PROBLEMS)
def test_solved_within_three_times_the_counts_of_slsqp(name):
    ours, plain = ours_and_plain(name)
    assert ours.status == "converged"
    assert ours.error <= 1e-4
    assert ours.violation <= 1e-6
    if plain.solved:
        assert ours.functions <= 3 * plain.functions
        assert ours.gradients <= 3 * plain.gradients


def test_all_together_need_half_as_much_again_as_slsqp():
    """Guards the counts as a whole: a change that costs a few evaluations everywhere fails here.

    A fifth of ours is the check, in one batch, that the end is a minimum.
    """
    both = [(ours, plain) for ours, plain in map(ours_and_plain, PROBLEMS) if ours.solved and plain.solved]
    assert len(both) >= 40
    assert sum(ours.functions for ours, _ in both) <= 1.55 * sum(plain.functions for _, plain in both)
    assert sum(ours.gradients for ours, _ in both) <= 1.2 * sum(plain.gradients for _, plain in both)
