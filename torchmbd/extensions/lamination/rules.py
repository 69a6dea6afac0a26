"""Rules of manufacturers for laminates, checked on discrete stacks of angles.

    symmetric     mirrored about the mid-plane: no coupling of stretching and bending, no warping when cured
    balanced      for every +theta as much thickness of -theta: no coupling of stretching and in-plane shear
    neighbors     at most 45 degrees between neighboring plies: less stress between them, fewer cracks
    ten percent   at least 10 % of the thickness along each of 0, 90, 45 and -45 degrees: strength in every direction

Angles are in degrees; 90 and -90 are the same direction. The rules are for rounded results and for a choice among discrete
angles (`admits`), not constraints of a continuous optimization. There a symmetric laminate is Laminate(symmetric=True), and a
balanced one has linked angles (space.py).
Source: Bailie, Ley, Pasricha, A summary and review of composite laminate design guidelines, NASA contract NAS1-19347
(1997). Checked in tests/extensions/lamination/test_rules.py.
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
    """Rules that a stack of plies has to keep.

    symmetric, balanced  switch the rules on
    max_step             largest angle between neighboring plies [deg]; None: any
    min_share            smallest share of the thickness along each of 0, 90, 45, -45 degrees; 0: none
    tolerance            angles that differ by less are equal [deg]

    >>> rules = mbd.lamination.LaminationRules(symmetric=True, balanced=True)
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
        true_or_false("symmetric", self.symmetric)
        true_or_false("balanced", self.balanced)
        if self.max_step is not None and not (is_real(self.max_step) and 0.0 <= self.max_step <= 90.0):
            raise InputError("max_step", self.max_step, "0 to 90 degrees, or None")
        if not (is_real(self.min_share) and 0.0 <= self.min_share <= 0.25):
            raise InputError("min_share", self.min_share, "0 to 0.25, for four directions")
        if not (is_real(self.tolerance) and 0.0 <= self.tolerance < 45.0):
            raise InputError("tolerance", self.tolerance, "0 to 45 degrees")

    def broken(self, angles: Sequence[float], thickness: Sequence[float] | float = 1.0) -> list[str]:
        """One sentence for each rule that a stack breaks; plies from bottom to top [deg], their thickness [any unit]."""
        plies = [float(a) for a in angles]
        one_for_all = isinstance(thickness, (int, float))
        h = [float(thickness)] * len(plies) if one_for_all else [float(x) for x in thickness]
        if not plies or not all(map(math.isfinite, plies)):
            raise InputError("angles", angles, "at least one finite number [deg]")
        if len(h) != len(plies) or not all(0.0 < x < math.inf for x in h):
            raise InputError("thickness", thickness, "a positive number, or one for each ply")
        broken = []
        if self.symmetric:
            broken += self._symmetry_errors(plies, h)
        if self.balanced:
            broken += self._balance_errors(plies, h)
        if self.max_step is not None:
            broken += self._step_errors(plies)
        if self.min_share > 0.0:
            broken += self._share_errors(plies, h)
        return broken

    def admits(self, angles: Sequence[float], thickness: Sequence[float] | float = 1.0) -> bool:
        """True if a stack keeps all rules."""
        return not self.broken(angles, thickness)

    def _symmetry_errors(self, plies: list[float], h: list[float]) -> list[str]:
        for k in range(len(plies) // 2):
            a, b = plies[k], plies[-1 - k]
            if angle_between(a, b) > self.tolerance:
                return [f"not symmetric: ply {k + 1} lies at {a:g}, its mirror image at {b:g} degrees"]
            if abs(h[k] - h[-1 - k]) > 1e-9 * max(h):
                return [f"not symmetric: ply {k + 1} and its mirror image differ in thickness"]
        return []

    def _balance_errors(self, plies: list[float], h: list[float]) -> list[str]:
        for angle in plies:
            if min(angle_between(angle, 0.0), angle_between(angle, 90.0)) <= self.tolerance:
                continue
            up, down = self._thickness_along(angle, plies, h), self._thickness_along(-angle, plies, h)
            if abs(up - down) > 1e-9 * sum(h):
                shares = f"{100 * up / sum(h):.4g} % at {angle:g}, {100 * down / sum(h):.4g} % at {-angle:g}"
                return [f"not balanced: {shares} degrees"]
        return []

    def _step_errors(self, plies: list[float]) -> list[str]:
        assert self.max_step is not None
        for k, (a, b) in enumerate(pairwise(plies)):
            if angle_between(a, b) > self.max_step + self.tolerance:
                step = f"{angle_between(a, b):.4g} degrees between plies {k + 1} and {k + 2} ({a:g}, {b:g})"
                return [f"{step}: must be at most {self.max_step:g}"]
        return []

    def _share_errors(self, plies: list[float], h: list[float]) -> list[str]:
        broken = []
        for angle in DIRECTIONS:
            share = self._thickness_along(angle, plies, h) / sum(h)
            if share < self.min_share - 1e-9:
                broken.append(
                    f"{100 * share:.4g} % lie at {angle:g} degrees: must be at least {100 * self.min_share:g} %"
                )
        return broken

    def _thickness_along(self, angle: float, plies: list[float], h: list[float]) -> float:
        """Thickness of all plies of an angle [deg]."""
        return sum(x for ply, x in zip(plies, h, strict=True) if angle_between(ply, angle) <= self.tolerance)


def angle_between(a: float, b: float) -> float:
    """Angle between two fiber directions [deg], 0 to 90."""
    d = abs(a - b) % 180.0
    return min(d, 180.0 - d)
