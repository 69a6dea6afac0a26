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
from collections.abc import Iterable, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
import torch

from torchmbd.design.lamination import LaminationRules
from torchmbd.errors import InputError
from torchmbd.fem.elements import LaminationParameters
from torchmbd.fem.materials import Laminate
from torchmbd.fem.materials.lamination_region import directions
from torchmbd.math.owned import real, reals, whole

STARTS = 100


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
    _check(laminate, plies, rules, number, weights)
    allowed = reals("angles", angles).flatten()
    if not len(allowed) or not allowed.isfinite().all():
        raise InputError(f"angles is {angles!r}; allowed: at least one finite angle [rad]")
    a, b, d = (x.detach().numpy() for x in laminate.sets())
    search = _Search(plies, laminate.coupling is None, allowed, np.stack([a, b, d]), np.array(weights), rules)
    random = np.random.default_rng(seed)
    found: dict[tuple[int, ...], tuple[int, float]] = {}
    for _ in range(STARTS):
        for stack, score in search.run(random.integers(len(allowed), size=search.free)):
            found[stack] = score
    best = sorted(found, key=lambda stack: found[stack])[:number]
    return [_recovered(laminate, search, stack, found[stack][1]) for stack in best]


class _Search:
    """Free plies of a stack (the lower half of a symmetric one, with its middle ply), each the number of an allowed angle."""

    def __init__(
        self,
        plies: int,
        symmetric: bool,
        allowed: torch.Tensor,
        wanted: np.ndarray,
        weights: np.ndarray,
        rules: LaminationRules | None,
    ) -> None:
        self.mirror = np.minimum(np.arange(plies), np.arange(plies)[::-1]) if symmetric else np.arange(plies)
        self.free = int(self.mirror.max()) + 1
        edges = np.linspace(-1.0, 1.0, plies + 1)
        share = np.stack([np.diff(edges**power) / 2 for power in (1, 2, 3)])  # of xi_A, xi_B, xi_D
        self.share = share @ np.eye(self.free)[self.mirror]
        self.allowed, self.V = allowed, directions(allowed).numpy()
        self.wanted, self.weights, self.rules = wanted, weights[:, None] / (4.0 * weights.sum()), rules
        self.degrees = np.rad2deg(allowed.numpy())

    def angles(self, stack: Iterable[int]) -> list[float]:
        """Of all plies, from bottom to top [rad]."""
        return self.allowed[np.array(list(stack))[self.mirror]].tolist()

    def _distance(self, difference: np.ndarray) -> np.ndarray:
        """Of differences [..., 3, 4]."""
        return np.sqrt((self.weights * difference**2).sum((-2, -1)))

    def _score(self, stack: np.ndarray, distance: float) -> tuple[int, float]:
        if self.rules is None:
            return 0, float(distance)
        return len(self.rules.broken(self.degrees[stack[self.mirror]].tolist())), float(distance)

    def run(self, stack: np.ndarray) -> list[tuple[tuple[int, ...], tuple[int, float]]]:
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
        self, stack: np.ndarray, difference: np.ndarray, score: tuple[int, float], changed: int
    ) -> tuple[np.ndarray, tuple[int, float]] | None:
        """The nearest better stack with so many plies changed."""
        change = self.share[:, :, None, None] * (self.V[None, :] - self.V[stack][:, None])  # [3, free, angles, 4]
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


def _recovered(
    laminate: LaminationParameters, search: _Search, stack: tuple[int, ...], distance: float
) -> RecoveredStack:
    angles = search.angles(stack)
    h = float(laminate.thickness.detach()) / len(angles)
    found = Laminate(laminate.ply, angles, h, shear_correction=laminate.shear_correction)
    broken = [] if search.rules is None else search.rules.broken([math.degrees(x) for x in angles])
    return RecoveredStack(angles, distance, broken, found)


def _check(laminate: object, plies: int, rules: object, number: int, weights: Sequence[float]) -> None:
    if not isinstance(laminate, LaminationParameters):
        raise InputError(f"laminate is {laminate!r}; allowed: LaminationParameters(...)")
    if laminate.field is not None:
        raise InputError("laminate has a field; allowed: LaminationParameters of one control, without a field")
    for name, given in (("plies", plies), ("number", number)):
        if not whole(given) or given < 1:
            raise InputError(f"{name} is {given!r}; allowed: a whole number >= 1")
    if not (rules is None or isinstance(rules, LaminationRules)):
        raise InputError(f"rules is {rules!r}; allowed: a LaminationRules, or None")
    if len(weights) != 3 or not all(real(w) and 0.0 <= w < math.inf for w in weights) or not sum(weights) > 0.0:
        raise InputError(f"weights is {weights!r}; allowed: three numbers >= 0, not all zero")
