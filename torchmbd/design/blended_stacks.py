"""Stacks of neighboring zones that share their plies: thin zones have plies of the thick ones, none of their own.

The thickest zone is the guide. Every other zone lacks some of its plies, and the plies of a zone are among those of all thicker
ones, so each ply runs through until it ends once. Of symmetric stacks plies end in pairs.

    minimize  sum_z s_z |xi_z - wanted_z|^2     over the angles of the guide's plies and where each ends

xi_z are linear in cos 2 theta and so on of the guide's plies for given ends, so the angles are searched as in
stack_recovery.py, for all zones at once; between these searches two plies exchange their ends where that helps. Starts are
drawn from a seed. Local, not exhaustive.
Source: D. B. Adams, L. T. Watson, Z. Gurdal and C. M. Anderson-Cook, Genetic algorithm optimization and blending of composite
laminates by locally reducing laminate thickness, Advances in Engineering Software 35 (2004) 35-43 (the guide).
Checked in tests/design/test_blended_stacks.py.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from torchmbd.design.lamination import LaminationRules
from torchmbd.design.stack_recovery import (
    RecoveredStack,
    Score,
    StackSearch,
    check_search,
    check_wanted,
    checked_angles,
    mirrored,
    recovered,
    set_weights,
    shares,
    wanted,
)
from torchmbd.errors import InputError
from torchmbd.fem.elements import LaminationParameters
from torchmbd.math.checked_numbers import is_real
from torchmbd.math.variable import without_variables

STARTS = 30


def recover_blended_stacks(
    laminates: Mapping[str, LaminationParameters],
    plies: Mapping[str, int],
    angles: Sequence[float],
    rules: LaminationRules | None = None,
    areas: Mapping[str, float] | None = None,
    weights: Sequence[float] = (1.0, 1.0, 1.0),
    seed: int = 0,
) -> dict[str, RecoveredStack]:
    """Find stacks of equal plies for the lamination parameters of several zones, which share their plies.

    laminates  of each zone, of one material; without `coupling` all stacks are symmetric
    plies      how many each zone has; of symmetric stacks all even or all odd. Zones with as many have the same stack
    angles     which are allowed [rad]
    rules      that every stack should keep; fewer broken ones come first
    areas      how much each zone counts [m2]; default: all alike
    weights    of the differences of membrane, coupling and bending parameters
    seed       of the random starts

    Returns the stack of every zone, `distance` being its own. Its `laminate` has the thickness asked for: plies are as thick in
    all zones where `plies` is in proportion to it.

    >>> carbon, flat = mbd.examples.carbon(), [0.0, 0.0, 0.0, 0.0]
    >>> zones = {"root": mbd.LaminationParameters(carbon, 2e-3, flat), "tip": mbd.LaminationParameters(carbon, 1e-3, flat)}
    >>> found = mbd.recover_blended_stacks(zones, {"root": 8, "tip": 4}, angles=mbd.deg([0, 45, 90, -45]))
    >>> len(found["root"].angles), len(found["tip"].angles)
    (8, 4)
    """
    symmetric, share = _check(laminates, plies, rules, areas, weights, seed)
    search = _Guide(laminates, plies, symmetric, share, checked_angles(angles), rules, set_weights(weights))
    random = np.random.default_rng(seed)
    best = min((search.run(random) for _ in range(STARTS)), key=lambda found: found[0])
    return search.stacks(*best[1:])


class _Guide:
    """Free plies of the thickest zone; `ends[k]`: in how many of the levels of thickness, from the thickest, ply k is there."""

    def __init__(
        self,
        laminates: Mapping[str, LaminationParameters],
        plies: Mapping[str, int],
        symmetric: bool,
        share: Mapping[str, float],
        allowed: Any,
        rules: LaminationRules | None,
        weights: np.ndarray,
    ) -> None:
        self.laminates, self.plies, self.allowed, self.rules, self.symmetric = (
            laminates,
            plies,
            allowed,
            rules,
            symmetric,
        )
        self.levels = sorted(set(plies.values()), reverse=True)
        self.middle = symmetric and self.levels[0] % 2 == 1  # a ply that no zone lacks
        self.wanted = np.concatenate([wanted(laminate) for laminate in laminates.values()])
        total = sum(share.values())
        self.weights = np.concatenate([share[name] / total * weights for name in laminates])
        self.own_weights = weights

    def _free(self, plies: int) -> int:
        return int(mirrored(plies, self.symmetric).max()) + 1

    def _members(self, ends: np.ndarray, name: str) -> np.ndarray:
        """Which free plies of the guide are those of a zone, from bottom to top."""
        n = self.plies[name]
        kept = np.flatnonzero(ends > self.levels.index(n))
        return kept[mirrored(n, self.symmetric)]

    def _search(self, ends: np.ndarray) -> StackSearch:
        stacks = [self._members(ends, name) for name in self.laminates]
        share = []
        for name, members in zip(self.laminates, stacks, strict=True):
            own = np.zeros((3, len(ends)))
            for ply, column in zip(members, shares(self.plies[name], np.arange(self.plies[name])).T, strict=True):
                own[:, ply] += column
            share.append(own)
        return StackSearch(np.concatenate(share), self.wanted, self.weights, self.allowed, stacks, self.rules)

    def run(self, random: np.random.Generator) -> tuple[Score, np.ndarray, np.ndarray]:
        """From one start to where neither angles nor exchanged ends help: score, angles' numbers, ends."""
        free = [self._free(n) for n in self.levels]
        counts = [a - b for a, b in zip(free, [*free[1:], 0], strict=True)]
        ends = np.repeat(np.arange(1, len(free) + 1), counts)
        loose = len(ends) - int(self.middle)
        # The last entry belongs to all zones: it stays where it is if it is the middle ply.
        ends[:loose] = random.permutation(ends[:loose])
        stack = random.integers(len(self.allowed), size=len(ends))
        while True:
            way = self._search(ends).run(stack)
            stack, score = np.array(way[-1][0]), way[-1][1]
            exchanged = self._exchanged(ends, stack, score, loose)
            if exchanged is None:
                return score, stack, ends
            ends = exchanged

    def _exchanged(self, ends: np.ndarray, stack: np.ndarray, score: Score, loose: int) -> np.ndarray | None:
        """The ends with the best exchange of two of them; None where none helps."""
        best, found = (score[0], score[1] - 1e-12), None
        for one, two in combinations(range(loose), 2):
            if ends[one] != ends[two]:
                other = ends.copy()
                other[[one, two]] = ends[[two, one]]
                if (new := self._search(other).score(stack)) < best:
                    best, found = new, other
        return found

    def stacks(self, stack: np.ndarray, ends: np.ndarray) -> dict[str, RecoveredStack]:
        """The stack of every zone."""
        found = {}
        for name, laminate in self.laminates.items():
            members, n = self._members(ends, name), self.plies[name]
            share = shares(n, np.arange(n))
            own = StackSearch(share, wanted(laminate), self.own_weights, self.allowed, [np.arange(n)], None)
            distance = own.score(stack[members])[1]
            found[name] = recovered(laminate, self.allowed[stack[members]].tolist(), distance, self.rules)
        return found


def _check(
    laminates: Any, plies: Any, rules: Any, areas: Any, weights: Any, seed: Any
) -> tuple[bool, dict[str, float]]:
    """Whether stacks are symmetric, and how much each zone counts."""
    if not isinstance(laminates, Mapping) or not laminates:
        raise InputError(f"laminates is {laminates!r}; allowed: LaminationParameters of each zone, by name")
    given = dict.fromkeys(laminates, 1.0) if areas is None else areas
    for argument, by_name in (("plies", plies), ("areas", given)):
        if not isinstance(by_name, Mapping) or set(by_name) != set(laminates):
            raise InputError(f"{argument} is {by_name!r}; allowed: a value for each of {', '.join(laminates)}")
    for name, laminate in laminates.items():
        check_wanted(f"laminate of {name!r}", laminate, plies[name])
        if not is_real(given[name]) or not 0.0 < given[name] < math.inf:
            raise InputError(f"area of {name!r} is {given[name]!r}; allowed: a number > 0")
    check_search(rules, weights, seed)
    first, *others = (without_variables(laminate.ply) for laminate in laminates.values())
    if any(ply != first for ply in others):
        raise InputError("laminates has zones of different plies; allowed: one material, as zones share their plies")
    symmetric = {laminate.coupling is None for laminate in laminates.values()}
    if len(symmetric) > 1:
        raise InputError("laminates has zones with coupling and zones without; allowed: all with, or all without")
    if symmetric == {True} and len({n % 2 for n in plies.values()}) > 1:
        raise InputError(f"plies is {dict(plies)!r}; allowed for symmetric stacks: all even, or all odd")
    return symmetric.pop(), dict(given)
