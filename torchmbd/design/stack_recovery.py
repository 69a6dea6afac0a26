"""Stacks of plies whose lamination parameters are nearest to given ones.

    minimize  w_A |xi_A - a|^2 + w_B |xi_B - b|^2 + w_D |xi_D - d|^2     over the angles of n equal plies, from a list

Each start is a random stack; it is improved by the best change of one ply, then by the best change of two plies together,
until neither helps. Starts are drawn from a seed. Local, not exhaustive: `distance` says how near it came. With rules the
number of rules broken is reduced first.
Source: the search by changes of one and two plies as in Narita, Layerwise optimization for the maximum fundamental frequency of
laminated composite plates, J. Sound Vib. 263 (2003) 1005-1016. Checked in tests/design/test_stack_recovery.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import torch

from torchmbd.design.lamination import LaminationRules
from torchmbd.errors import InputError
from torchmbd.fem.elements import LaminationParameters
from torchmbd.fem.materials import Laminate
from torchmbd.fem.materials.lamination_region import directions
from torchmbd.math.checked_numbers import is_real, is_whole, reals

STARTS = 100
Score = tuple[int, float]  # rules broken, distance


class RecoveredStack(NamedTuple):
    """A stack, and how its lamination parameters differ from those asked for."""

    angles: list[float]  # of all plies, from bottom to top [rad]
    distance: float  # root of the weighted mean of squared differences; 0: the same parameters
    broken: list[str]  # rules that it breaks
    laminate: Laminate  # of these plies, with the thickness asked for


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

    laminate  has the parameters that stacks should have; without `coupling` all stacks are symmetric
    plies     how many, at least 1
    angles    which are allowed [rad]
    rules     that stacks should keep; those broken by the fewest come first
    number    of different stacks
    weights   of the differences of membrane, coupling and bending parameters
    seed      of the random starts

    InputError for a field: recover the stacks of one control at a time.

    >>> laminate = mbd.LaminationParameters(mbd.examples.carbon(), 2e-3, [0, 0, 0, 0], bending=[0.375, 0, 0.25, 0])
    >>> found = mbd.recover_stacks(laminate, plies=8, angles=mbd.deg([0, 45, 90, -45]))[0]
    >>> len(found.angles), found.distance < 0.2
    (8, True)
    """
    check_wanted("laminate", laminate, plies)
    check_search(rules, weights, seed)
    if not is_whole(number) or number < 1:
        raise InputError(f"number is {number!r}; allowed: a whole number >= 1")
    allowed = checked_angles(angles)
    mirror = mirrored(plies, laminate.coupling is None)
    search = StackSearch(shares(plies, mirror), wanted(laminate), set_weights(weights), allowed, [mirror], rules)
    random = np.random.default_rng(seed)
    found: dict[tuple[int, ...], Score] = {}
    for _ in range(STARTS):
        for stack, score in search.run(random.integers(len(allowed), size=search.free)):
            found[stack] = score
    best = sorted(found, key=lambda stack: found[stack])[:number]
    return [recovered(laminate, allowed[np.array(stack)[mirror]].tolist(), found[stack][1], rules) for stack in best]


def mirrored(plies: int, symmetric: bool) -> np.ndarray:
    """Which free ply each ply of a stack is: of a symmetric one the lower half is free, with its middle ply."""
    return np.minimum(np.arange(plies), np.arange(plies)[::-1]) if symmetric else np.arange(plies)


def shares(plies: int, mirror: np.ndarray) -> np.ndarray:
    """What each free ply adds to xi_A, xi_B, xi_D [3, free]."""
    edges = np.linspace(-1.0, 1.0, plies + 1)
    share = np.stack([np.diff(edges**power) / 2 for power in (1, 2, 3)])
    return share @ np.eye(int(mirror.max()) + 1)[mirror]


def wanted(laminate: LaminationParameters) -> np.ndarray:
    """xi_A, xi_B, xi_D [3, 4]."""
    return np.stack([x.detach().numpy() for x in laminate.sets()])


def set_weights(weights: Sequence[float]) -> np.ndarray:
    """Of the differences of every parameter: their sum is 1 [3, 1]."""
    return np.array(weights, dtype=float)[:, None] / (4.0 * sum(weights))


class StackSearch:
    """Free plies, each the number of an allowed angle; sets of parameters are linear in cos 2 theta and so on of these plies.

    share    of the free plies in each set [sets, free]
    wanted   parameters [sets, 4];   weights   of their squared differences [sets, 1]
    stacks   which free plies the stacks are made of that have to keep the rules, from bottom to top
    """

    def __init__(
        self,
        share: np.ndarray,
        wanted: np.ndarray,
        weights: np.ndarray,
        allowed: torch.Tensor,
        stacks: Sequence[np.ndarray],
        rules: LaminationRules | None,
    ) -> None:
        self.share, self.wanted, self.weights, self.stacks, self.rules = share, wanted, weights, stacks, rules
        self.free, self.V, self.degrees = share.shape[1], directions(allowed).numpy(), np.rad2deg(allowed.numpy())

    def _distance(self, difference: np.ndarray) -> np.ndarray:
        """Of differences [..., sets, 4]."""
        return np.sqrt((self.weights * difference**2).sum((-2, -1)))

    def _score(self, stack: np.ndarray, distance: float) -> Score:
        rules = self.rules
        if rules is None:
            return 0, float(distance)
        return sum(_broken(rules, tuple(self.degrees[stack[one]].tolist())) for one in self.stacks), float(distance)

    def score(self, stack: np.ndarray) -> Score:
        """How many rules a stack breaks, and how far its parameters are."""
        difference = np.einsum("xk,kv->xv", self.share, self.V[stack]) - self.wanted
        return self._score(stack, float(self._distance(difference)))

    def run(self, stack: np.ndarray) -> list[tuple[tuple[int, ...], Score]]:
        """All stacks on the way from one start to where no change of one or two plies helps."""
        difference = np.einsum("xk,kv->xv", self.share, self.V[stack]) - self.wanted
        score = self._score(stack, float(self._distance(difference)))
        way = [(tuple(map(int, stack)), score)]
        while True:
            step = self._better(stack, difference, score, 1) or self._better(stack, difference, score, 2)
            if step is None:
                return way
            stack, score = step
            difference = np.einsum("xk,kv->xv", self.share, self.V[stack]) - self.wanted
            way.append((tuple(map(int, stack)), score))

    def _better(
        self, stack: np.ndarray, difference: np.ndarray, score: Score, changed: int
    ) -> tuple[np.ndarray, Score] | None:
        """The nearest better stack with so many plies changed."""
        change = self.share[:, :, None, None] * (self.V[None, :] - self.V[stack][:, None])  # [sets, free, angles, 4]
        change = change.transpose(1, 2, 0, 3)
        places = list(combinations(range(self.free), changed))
        if not places:
            return None
        if changed == 1:
            found = self._distance(difference + change)
        else:
            one, two = np.array(places).T
            found = self._distance(difference + change[one][:, :, None] + change[two][:, None, :])
        flat = found.ravel()
        near = np.flatnonzero(flat < score[1] - 1e-12) if self.rules is None or score[0] == 0 else np.arange(len(flat))
        for k in near[np.argsort(flat[near], kind="stable")]:
            place, *angles = np.unravel_index(k, found.shape)
            other = stack.copy()
            other[list(places[int(place)])] = angles
            new = self._score(other, float(flat[k]))
            if new < (score[0], score[1] - 1e-12):
                return other, new
        return None


@lru_cache(maxsize=20_000)
def _broken(rules: LaminationRules, degrees: tuple[float, ...]) -> int:
    """How many rules a stack breaks; searches come by the same stacks again and again."""
    return len(rules.broken(degrees))


def recovered(
    laminate: LaminationParameters, angles: list[float], distance: float, rules: LaminationRules | None
) -> RecoveredStack:
    """The stack of these plies [rad]."""
    h = float(laminate.thickness.detach()) / len(angles)
    found = Laminate(laminate.ply, angles, h, shear_correction=laminate.shear_correction)
    broken = [] if rules is None else rules.broken([math.degrees(x) for x in angles])
    return RecoveredStack(angles, distance, broken, found)


def checked_angles(angles: Sequence[float]) -> torch.Tensor:
    """Those allowed [rad]."""
    allowed = reals("angles", angles).flatten()
    if not len(allowed) or not allowed.isfinite().all():
        raise InputError(f"angles is {angles!r}; allowed: at least one finite angle [rad]")
    return allowed


def check_wanted(name: str, laminate: object, plies: Any) -> None:
    """InputError for what is no laminate of parameters, or no number of plies."""
    if not isinstance(laminate, LaminationParameters):
        raise InputError(f"{name} is {laminate!r}; allowed: LaminationParameters(...)")
    if laminate.field is not None:
        raise InputError(f"{name} has a field; allowed: LaminationParameters of one control, without a field")
    if not is_whole(plies) or plies < 1:
        raise InputError(f"plies is {plies!r}; allowed: a whole number >= 1")


def check_search(rules: object, weights: Any, seed: Any) -> None:
    """InputError for rules, weights or a seed of another kind."""
    if not (rules is None or isinstance(rules, LaminationRules)):
        raise InputError(f"rules is {rules!r}; allowed: a LaminationRules, or None")
    three = isinstance(weights, (Sequence, np.ndarray)) and np.shape(weights) == (3,)
    if not three or not all(is_real(w) and 0.0 <= w < math.inf for w in weights) or not sum(weights) > 0.0:
        raise InputError(f"weights is {weights!r}; allowed: three numbers >= 0, not all zero")
    if not is_whole(seed) or seed < 0:
        raise InputError(f"seed is {seed!r}; allowed: a whole number >= 0")
