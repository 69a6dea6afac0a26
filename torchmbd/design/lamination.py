"""Rules that manufacturers lay laminates by, checked on discrete stacks of angles.

    symmetric     mirrored about the mid-plane: no coupling of stretching and bending, no warping when cured
    balanced      for every +theta as much thickness of -theta: no coupling of stretching and in-plane shear
    neighbors     at most 45 degrees between neighboring plies: less stress between them, fewer cracks
    ten percent   at least 10 % of the thickness along each of 0, 90, 45 and -45 degrees: strength in every direction

Angles are in degrees, fibers have no head: 90 is -90. Rules hold for the angles as they are laid, so they are for
rounded results and for choosing among them (`admits`), not constraints of a continuous optimization. There a symmetric
laminate is Laminate(symmetric=True), and a balanced one has linked angles (space.py).
Source: Bailie, Ley, Pasricha, A summary and review of composite laminate design guidelines, NASA contract NAS1-19347
(1997). Checked in tests/design/test_lamination.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from torchmbd.errors import InputError, true_or_false
from torchmbd.math.checked_numbers import is_real

DIRECTIONS = (0.0, 90.0, 45.0, -45.0)


@dataclass(frozen=True)
class LaminationRules:
    """Which rules a stack of plies keeps.

    symmetric, balanced  switch the rules on
    max_step             largest angle between neighboring plies [deg]; None: any
    min_share            smallest share of the thickness along each of 0, 90, 45, -45 degrees; 0: none
    tolerance            angles that differ by less are equal [deg]

    >>> rules = mbd.LaminationRules(symmetric=True, balanced=True)
    >>> rules.admits([45, -45, -45, 45])
    True
    >>> len(rules.broken([45, 0]))
    2
    """

    symmetric: bool = False
    balanced: bool = False
    max_step: float | None = None
    min_share: float = 0.0
    tolerance: float = 1e-6

    def __post_init__(self) -> None:
        true_or_false("symmetric of LaminationRules", self.symmetric)
        true_or_false("balanced of LaminationRules", self.balanced)
        if self.max_step is not None and not (is_real(self.max_step) and 0.0 <= self.max_step <= 90.0):
            raise InputError(f"max_step is {self.max_step!r}; allowed: 0 to 90 degrees, or None")
        if not (is_real(self.min_share) and 0.0 <= self.min_share <= 0.25):
            raise InputError(f"min_share is {self.min_share!r}; allowed: 0 to 0.25, for four directions")
        if not (is_real(self.tolerance) and 0.0 <= self.tolerance < 45.0):
            raise InputError(f"tolerance is {self.tolerance!r}; allowed: 0 to 45 degrees")

    def broken(self, angles: Sequence[float], thickness: Sequence[float] | float = 1.0) -> list[str]:
        """One sentence for each rule that a stack breaks; plies from bottom to top [deg], their thickness [any unit]."""
        plies = [float(a) for a in angles]
        given = (
            [float(thickness)] * len(plies) if isinstance(thickness, (int, float)) else [float(h) for h in thickness]
        )
        if not plies or not all(map(math.isfinite, plies)):
            raise InputError(f"angles is {angles!r}; allowed: at least one finite number [deg]")
        if len(given) != len(plies) or not all(0.0 < h < math.inf for h in given):
            raise InputError(f"thickness is {thickness!r}; allowed: a positive number, or one for each ply")
        checks = []
        if self.symmetric:
            checks += self._unsymmetric(plies, given)
        if self.balanced:
            checks += self._unbalanced(plies, given)
        if self.max_step is not None:
            checks += self._steep(plies)
        if self.min_share > 0.0:
            checks += self._scarce(plies, given)
        return checks

    def admits(self, angles: Sequence[float], thickness: Sequence[float] | float = 1.0) -> bool:
        """Whether a stack keeps all rules."""
        return not self.broken(angles, thickness)

    def _unsymmetric(self, plies: list[float], given: list[float]) -> list[str]:
        for k in range(len(plies) // 2):
            a, b = plies[k], plies[-1 - k]
            if between(a, b) > self.tolerance:
                return [f"not symmetric: ply {k + 1} lies at {a:g}, its mirror image at {b:g} degrees"]
            if abs(given[k] - given[-1 - k]) > 1e-9 * max(given):
                return [f"not symmetric: ply {k + 1} and its mirror image differ in thickness"]
        return []

    def _unbalanced(self, plies: list[float], given: list[float]) -> list[str]:
        for angle in plies:
            if min(between(angle, 0.0), between(angle, 90.0)) <= self.tolerance:
                continue
            up, down = self._along(angle, plies, given), self._along(-angle, plies, given)
            if abs(up - down) > 1e-9 * sum(given):
                shares = f"{100 * up / sum(given):.4g} % at {angle:g}, {100 * down / sum(given):.4g} % at {-angle:g}"
                return [f"not balanced: {shares} degrees"]
        return []

    def _steep(self, plies: list[float]) -> list[str]:
        assert self.max_step is not None
        for k, (a, b) in enumerate(pairwise(plies)):
            if between(a, b) > self.max_step + self.tolerance:
                step = f"{between(a, b):.4g} degrees between plies {k + 1} and {k + 2} ({a:g}, {b:g})"
                return [f"{step}; allowed: {self.max_step:g}"]
        return []

    def _scarce(self, plies: list[float], given: list[float]) -> list[str]:
        broken = []
        for angle in DIRECTIONS:
            share = self._along(angle, plies, given) / sum(given)
            if share < self.min_share - 1e-9:
                broken.append(
                    f"{100 * share:.4g} % lie at {angle:g} degrees; allowed: at least {100 * self.min_share:g} %"
                )
        return broken

    def _along(self, angle: float, plies: list[float], given: list[float]) -> float:
        return sum(h for ply, h in zip(plies, given, strict=True) if between(ply, angle) <= self.tolerance)


def between(a: float, b: float) -> float:
    """Angle between two fiber directions, 0 to 90 degrees."""
    d = abs(a - b) % 180.0
    return min(d, 180.0 - d)
