"""Stacks of neighboring zones that share their plies: all plies of a thin zone continue into the thicker zones.

The thickest zone is the guide. The plies of every other zone are some of the guide's plies, and the plies of a zone are among
those of all thicker zones, so each ply ends once. In symmetric stacks plies end in pairs.

    minimize  sum_z s_z |xi_z - target_z|^2     over the angles of the guide's plies and the zones where they end

For given ends xi_z are linear in cos 2 theta and so on of the guide's plies, so the angles of all zones are searched together
as in stack_recovery.py. Between these searches two plies exchange their ends if that is an improvement. Local search from
random starts, not exhaustive.
Source: D. B. Adams, L. T. Watson, Z. Gurdal and C. M. Anderson-Cook, Genetic algorithm optimization and blending of composite
laminates by locally reducing laminate thickness, Advances in Engineering Software 35 (2004) 35-43 (the guide).
Checked in tests/extensions/lamination/test_blended_stacks.py.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from torchmbd.errors import InputError
from torchmbd.extensions.lamination.parameters import LaminationParameters
from torchmbd.extensions.lamination.rules import LaminationRules
from torchmbd.extensions.lamination.stack_recovery import (
    RecoveredStack,
    Score,
    StackSearch,
    check_search,
    check_target,
    checked_angles,
    free_ply_indices,
    parameter_weights,
    ply_contributions,
    recovered_stack,
    target_parameters,
)
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
    plies      number of plies of each zone; for symmetric stacks all even or all odd. Zones with equal numbers have one stack
    angles     the allowed angles [rad]
    rules      rules that every stack should satisfy; a result with fewer broken rules comes before one with less distance
    areas      weight of each zone, such as its area [m2]; default: equal weights
    weights    of the differences of membrane, coupling and bending parameters
    seed       of the random starts

    Returns the stack of every zone with its own `distance`. Its `laminate` has the thickness of the zone. So plies have
    the same thickness in all zones if the numbers `plies` are proportional to the thicknesses of the zones.

    >>> carbon, flat = mbd.examples.carbon(), [0.0, 0.0, 0.0, 0.0]
    >>> root, tip = (mbd.lamination.LaminationParameters(carbon, thickness, flat) for thickness in (2e-3, 1e-3))
    >>> zones = {"root": root, "tip": tip}
    >>> found = mbd.lamination.recover_blended_stacks(zones, {"root": 8, "tip": 4}, angles=mbd.deg([0, 45, 90, -45]))
    >>> len(found["root"].angles), len(found["tip"].angles)
    (8, 4)
    """
    symmetric, zone_weights = _check(laminates, plies, rules, areas, weights, seed)
    search = _Guide(
        laminates, plies, symmetric, zone_weights, checked_angles(angles), rules, parameter_weights(weights)
    )
    random = np.random.default_rng(seed)
    _, angle_indices, ends = min((search.run(random) for _ in range(STARTS)), key=lambda result: result[0])
    return search.stacks(angle_indices, ends)


class _Guide:
    """The search over the free plies of the thickest zone.

    levels     numbers of plies of the zones, the largest first
    ends       of every free ply: the number of levels that have it; 1: only the guide, len(levels): all zones
    """

    def __init__(
        self,
        laminates: Mapping[str, LaminationParameters],
        plies: Mapping[str, int],
        symmetric: bool,
        zone_weights: Mapping[str, float],
        allowed: Any,
        rules: LaminationRules | None,
        weights: np.ndarray,
    ) -> None:
        self.laminates, self.plies, self.symmetric = laminates, plies, symmetric
        self.allowed, self.rules, self.weights_of_one = allowed, rules, weights
        self.levels = sorted(set(plies.values()), reverse=True)
        self.has_middle = symmetric and self.levels[0] % 2 == 1  # a middle ply, which all zones have
        self.target = np.concatenate([target_parameters(laminate) for laminate in laminates.values()])
        total = sum(zone_weights.values())
        self.weights = np.concatenate([zone_weights[name] / total * weights for name in laminates])

    def _free_count(self, plies: int) -> int:
        return int(free_ply_indices(plies, self.symmetric).max()) + 1

    def _zone_plies(self, ends: np.ndarray, name: str) -> np.ndarray:
        """Indices of the guide's free plies that a zone is made of, from bottom to top [plies of the zone]."""
        n = self.plies[name]
        kept = np.flatnonzero(ends > self.levels.index(n))
        return kept[free_ply_indices(n, self.symmetric)]

    def _search(self, ends: np.ndarray) -> StackSearch:
        """The search over the angles of all zones for given ends."""
        stacks = [self._zone_plies(ends, name) for name in self.laminates]
        contributions = []
        for name, zone_plies in zip(self.laminates, stacks, strict=True):
            of_zone = np.zeros((3, len(ends)))
            each = ply_contributions(self.plies[name], np.arange(self.plies[name])).T
            for ply, column in zip(zone_plies, each, strict=True):
                of_zone[:, ply] += column
            contributions.append(of_zone)
        return StackSearch(np.concatenate(contributions), self.target, self.weights, self.allowed, stacks, self.rules)

    def run(self, random: np.random.Generator) -> tuple[Score, np.ndarray, np.ndarray]:
        """Score, indices of angles, and ends [free] of a local optimum, from a random start."""
        free = [self._free_count(n) for n in self.levels]
        counts = [a - b for a, b in zip(free, [*free[1:], 0], strict=True)]
        ends = np.repeat(np.arange(1, len(free) + 1), counts)
        # The last free ply belongs to all zones: a middle ply keeps this position.
        movable = len(ends) - int(self.has_middle)
        ends[:movable] = random.permutation(ends[:movable])
        stack = random.integers(len(self.allowed), size=len(ends))
        while True:
            *_, (best, score) = self._search(ends).run(stack).items()
            stack = np.array(best)
            exchanged = self._exchanged(ends, stack, score, movable)
            if exchanged is None:
                return score, stack, ends
            ends = exchanged

    def _exchanged(self, ends: np.ndarray, stack: np.ndarray, score: Score, movable: int) -> np.ndarray | None:
        """The ends after the best exchange of two of them; None if no exchange is an improvement."""
        best, result = (score[0], score[1] - 1e-12), None
        for first, second in combinations(range(movable), 2):
            if ends[first] != ends[second]:
                other = ends.copy()
                other[[first, second]] = ends[[second, first]]
                if (new := self._search(other).score(stack)) < best:
                    best, result = new, other
        return result

    def stacks(self, stack: np.ndarray, ends: np.ndarray) -> dict[str, RecoveredStack]:
        """The stack of every zone, from indices of angles and ends of the guide's free plies."""
        result = {}
        for name, laminate in self.laminates.items():
            zone_plies, n = self._zone_plies(ends, name), np.arange(self.plies[name])
            target, contributions = target_parameters(laminate), ply_contributions(len(n), n)
            alone = StackSearch(contributions, target, self.weights_of_one, self.allowed, [n], None)
            distance = alone.score(stack[zone_plies])[1]
            result[name] = recovered_stack(laminate, self.allowed[stack[zone_plies]].tolist(), distance, self.rules)
        return result


def _check(
    laminates: Any, plies: Any, rules: Any, areas: Any, weights: Any, seed: Any
) -> tuple[bool, dict[str, float]]:
    """Whether stacks are symmetric, and the weight of each zone; InputError for invalid arguments."""
    if not isinstance(laminates, Mapping) or not laminates:
        raise InputError("laminates", laminates, "a mapping name of a zone -> LaminationParameters")
    weight_of_zone = dict.fromkeys(laminates, 1.0) if areas is None else areas
    for argument, by_name in (("plies", plies), ("areas", weight_of_zone)):
        if not isinstance(by_name, Mapping) or set(by_name) != set(laminates):
            raise InputError(argument, by_name, f"a value for each of {', '.join(laminates)}")
    for name, laminate in laminates.items():
        check_target((name, "laminate"), laminate, plies[name])
        if not is_real(weight_of_zone[name]) or not 0.0 < weight_of_zone[name] < math.inf:
            raise InputError((name, "area"), weight_of_zone[name], "a number > 0")
    check_search(rules, weights, seed)
    first, *others = (without_variables(laminate.ply) for laminate in laminates.values())
    if any(ply != first for ply in others):
        raise InputError(
            "laminates",
            laminates,
            "must have one material, because zones share their plies",
            state="has zones of different plies",
        )
    symmetric = {laminate.coupling is None for laminate in laminates.values()}
    if len(symmetric) > 1:
        raise InputError(
            "laminates",
            laminates,
            "must have coupling parameters in all zones, or in none",
            state="has zones with coupling parameters and zones without them",
        )
    if symmetric == {True} and len({n % 2 for n in plies.values()}) > 1:
        raise InputError(
            "plies",
            dict(plies),
            allowed="all even, or all odd for symmetric stacks",
            state=f"is {dict(plies)!r}",
        )
    return symmetric.pop(), dict(weight_of_zone)
