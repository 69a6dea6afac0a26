"""Stacks of plies whose lamination parameters are nearest to target parameters.

    minimize  w_A |xi_A - a|^2 + w_B |xi_B - b|^2 + w_D |xi_D - d|^2     over the angles of n equal plies, from a list

xi: target parameters;  a, b, d: parameters of the stack;  w: weights

A local search from random stacks: the best change of one ply, else of two plies, is made until no change is an improvement.
It is not exhaustive: `distance` is the remaining difference. With rules, fewer broken rules count before a smaller distance.
Source: the search by changes of one and two plies as in Narita, Layerwise optimization for the maximum fundamental frequency of
laminated composite plates, J. Sound Vib. 263 (2003) 1005-1016. Checked in tests/extensions/lamination/test_stack_recovery.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import torch

from torchmbd.errors import InputError, Path
from torchmbd.extensions.lamination.conditions import directions
from torchmbd.extensions.lamination.parameters import LaminationParameters
from torchmbd.extensions.lamination.rules import LaminationRules
from torchmbd.fem.materials import Laminate
from torchmbd.math.checked_numbers import is_real, is_whole, reals

STARTS = 100
Score = tuple[int, float]  # rules broken, distance


class RecoveredStack(NamedTuple):
    """A stack, and the difference of its lamination parameters from the target."""

    angles: list[float]  # of all plies, from bottom to top [rad]
    distance: float  # root of the weighted mean of squared differences; 0: the target parameters
    broken: list[str]  # the rules that it breaks, one sentence for each
    laminate: Laminate  # of these plies, as thick as the laminate of the target


def recover_stacks(
    laminate: LaminationParameters,
    plies: int,
    angles: Sequence[float],
    rules: LaminationRules | None = None,
    number: int = 1,
    weights: Sequence[float] = (1.0, 1.0, 1.0),
    seed: int = 0,
) -> list[RecoveredStack]:
    """Find the best `number` stacks of equal plies for a laminate of lamination parameters, the nearest first.

    laminate  the target parameters; without `coupling` all stacks are symmetric
    plies     number of plies, at least 1
    angles    the allowed angles [rad]
    rules     rules that stacks should keep; stacks that break fewer rules come first
    number    how many stacks are returned
    weights   of the differences of membrane, coupling and bending parameters
    seed      of the random starts

    InputError for a field: recover the stacks of one control at a time.

    >>> laminate = mbd.lamination.LaminationParameters(mbd.examples.carbon(), 2e-3, [0, 0, 0, 0], bending=[0.375, 0, 0.25, 0])
    >>> found = mbd.lamination.recover_stacks(laminate, plies=8, angles=mbd.deg([0, 45, 90, -45]))[0]
    >>> len(found.angles), found.distance < 0.2
    (8, True)
    """
    check_target("laminate", laminate, plies)
    check_search(rules, weights, seed)
    if not is_whole(number) or number < 1:
        raise InputError("number", number, "a whole number >= 1")
    allowed = checked_angles(angles)
    free = free_ply_indices(plies, laminate.coupling is None)
    contributions, target = ply_contributions(plies, free), target_parameters(laminate)
    search = StackSearch(contributions, target, parameter_weights(weights), allowed, [free], rules)
    random = np.random.default_rng(seed)
    scores: dict[tuple[int, ...], Score] = {}
    for _ in range(STARTS):
        scores |= search.run(random.integers(len(allowed), size=search.free))
    best = sorted(scores, key=lambda stack: scores[stack])[:number]
    return [recovered_stack(laminate, allowed[np.array(s)[free]].tolist(), scores[s][1], rules) for s in best]


def free_ply_indices(plies: int, symmetric: bool) -> np.ndarray:
    """Index of the free ply of every ply [plies]; in a symmetric stack the lower half, with the middle ply, is free."""
    return np.minimum(np.arange(plies), np.arange(plies)[::-1]) if symmetric else np.arange(plies)


def ply_contributions(plies: int, free: np.ndarray) -> np.ndarray:
    """Factors [3, free plies] of (cos 2 theta, ...) of each free ply in xi_A, xi_B, xi_D.

    free  index of the free ply of every ply
    """
    edges = np.linspace(-1.0, 1.0, plies + 1)
    of_ply = np.stack([np.diff(edges**power) / 2 for power in (1, 2, 3)])
    return of_ply @ np.eye(int(free.max()) + 1)[free]


def target_parameters(laminate: LaminationParameters) -> np.ndarray:
    """xi_A, xi_B, xi_D [3, 4] of a laminate."""
    return np.stack([x.detach().numpy() for x in laminate.sets()])


def parameter_weights(weights: Sequence[float]) -> np.ndarray:
    """Weights [3, 1] of the squared difference of each parameter, of sum one over the three sets of four parameters."""
    return np.array(weights, dtype=float)[:, None] / (4.0 * sum(weights))


class StackSearch:
    """A local search over stacks: every free ply has the index of an allowed angle.

    Lamination parameters are linear in v = (cos 2 theta, sin 2 theta, cos 4 theta, sin 4 theta) of the free plies:
    xi = contributions @ v.

    contributions  of the free plies to each set of parameters [sets, free]
    target         parameters [sets, 4];   weights   of their squared differences [sets, 1]
    allowed        angles [rad]
    stacks         indices of the free plies of each stack that has to keep the rules, from bottom to top
    """

    def __init__(
        self,
        contributions: np.ndarray,
        target: np.ndarray,
        weights: np.ndarray,
        allowed: torch.Tensor,
        stacks: Sequence[np.ndarray],
        rules: LaminationRules | None,
    ) -> None:
        self.contributions, self.target, self.weights = contributions, target, weights
        self.stacks, self.rules = stacks, rules
        self.free, self.V, self.degrees = (
            contributions.shape[1],
            directions(allowed).numpy(),
            np.rad2deg(allowed.numpy()),
        )

    def _difference(self, stack: np.ndarray) -> np.ndarray:
        """Difference of the parameters from the target [sets, 4]."""
        return np.einsum("xk,kv->xv", self.contributions, self.V[stack]) - self.target

    def _distance(self, difference: np.ndarray) -> np.ndarray:
        """Root of the weighted mean square of differences [..., sets, 4]."""
        return np.sqrt((self.weights * difference**2).sum((-2, -1)))

    def _score(self, stack: np.ndarray, distance: float) -> Score:
        rules = self.rules
        if rules is None:
            return 0, float(distance)
        broken = (_broken(rules, tuple(self.degrees[stack[plies]].tolist())) for plies in self.stacks)
        return sum(broken), float(distance)

    def score(self, stack: np.ndarray) -> Score:
        """Number of broken rules and distance from the target."""
        return self._score(stack, float(self._distance(self._difference(stack))))

    def run(self, stack: np.ndarray) -> dict[tuple[int, ...], Score]:
        """Scores of all stacks from a start to a stack that no change of one or two plies improves, which is the last."""
        score = self.score(stack)
        scores = {tuple(map(int, stack)): score}
        while True:
            better = self._improved(stack, score, 1) or self._improved(stack, score, 2)
            if better is None:
                return scores
            stack, score = better
            scores[tuple(map(int, stack))] = score

    def _improved(self, stack: np.ndarray, score: Score, changes: int) -> tuple[np.ndarray, Score] | None:
        """The nearest better stack with one or two (`changes`) plies changed, and its score; None if there is none."""
        difference = self._difference(stack)
        change = self.contributions[:, :, None, None] * (self.V[None, :] - self.V[stack][:, None])
        change = change.transpose(1, 2, 0, 3)  # of each free ply to each angle [free, angles, sets, 4]
        changed_plies = list(combinations(range(self.free), changes))
        if not changed_plies:
            return None
        if changes == 1:
            distances = self._distance(difference + change)
        else:
            first, second = np.array(changed_plies).T
            distances = self._distance(difference + change[first][:, :, None] + change[second][:, None, :])
        flat = distances.ravel()
        rules_kept = self.rules is None or score[0] == 0
        candidates = np.flatnonzero(flat < score[1] - 1e-12) if rules_kept else np.arange(len(flat))
        for k in candidates[np.argsort(flat[candidates], kind="stable")]:
            which, *angles = np.unravel_index(k, distances.shape)
            other = stack.copy()
            other[list(changed_plies[int(which)])] = angles
            new = self._score(other, float(flat[k]))
            if new < (score[0], score[1] - 1e-12):
                return other, new
        return None


@lru_cache(maxsize=20_000)
def _broken(rules: LaminationRules, degrees: tuple[float, ...]) -> int:
    """Number of rules that a stack breaks; cached, as searches meet the same stacks many times."""
    return len(rules.broken(degrees))


def recovered_stack(
    laminate: LaminationParameters, angles: list[float], distance: float, rules: LaminationRules | None
) -> RecoveredStack:
    """The result for plies of these angles [rad], as thick together as `laminate`."""
    h = float(laminate.thickness.detach()) / len(angles)
    stack = Laminate(laminate.ply, angles, h, shear_correction=laminate.shear_correction)
    broken = [] if rules is None else rules.broken([math.degrees(x) for x in angles])
    return RecoveredStack(angles, distance, broken, stack)


def checked_angles(angles: Sequence[float]) -> torch.Tensor:
    """Allowed angles as a tensor [rad]; InputError for none, or one that is not finite."""
    allowed = reals("angles", angles).flatten()
    if not len(allowed) or not allowed.isfinite().all():
        raise InputError("angles", angles, "at least one finite angle [rad]")
    return allowed


def check_target(name: str | Path, laminate: object, plies: Any) -> None:
    """InputError unless `laminate` has the parameters of one control, and `plies` is a number of plies."""
    if not isinstance(laminate, LaminationParameters):
        raise InputError(name, laminate, "a LaminationParameters(...)")
    if laminate.field is not None:
        raise InputError(name, allowed="a LaminationParameters of one control, without a field", state="has a field")
    if not is_whole(plies) or plies < 1:
        raise InputError("plies", plies, "a whole number >= 1")


def check_search(rules: object, weights: Any, seed: Any) -> None:
    """InputError unless rules, weights and seed are valid."""
    if not (rules is None or isinstance(rules, LaminationRules)):
        raise InputError("rules", rules, "a LaminationRules, or None")
    are_three = isinstance(weights, (Sequence, np.ndarray)) and np.shape(weights) == (3,)
    if not are_three or not all(is_real(w) and 0.0 <= w < math.inf for w in weights) or not sum(weights) > 0.0:
        raise InputError("weights", weights, "three numbers >= 0, not all zero")
    if not is_whole(seed) or seed < 0:
        raise InputError("seed", seed, "a whole number >= 0")
