"""What the start moves to close joints: how far joints are open where the bodies were put, and how far each body goes.

    gap      |Phi| of a joint at the given positions, over its rows that are lengths [m] and over those that are sines of
             angles [rad];
             of a coupling the smallest travel [m], or angle [rad], of one of its joints that closes it: |Phi| / max |c_i|
    distance the farthest way of a body's origin and of its points that joints and forces have [m]
    angle    of the body's rotation [rad]; with full turns if a coupling counts the angle of its joint to the ground

A gap does not count the elastic displacements that bodies were given, because joints are meant to follow a bent body.
Source of the limit of the warning: positions are typed with three digits or more, so a share of 1e-3 of the size of the
mechanism as it was built (equations/sizes.py), or 1e-3 rad, is rounding, and more is a mistake.
Checked in tests/multibody/start/test_closing.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import warn
from torchmbd.multibody.equations import equations
from torchmbd.multibody.joints.primitive import Angle, Perpendicular
from torchmbd.multibody.joints.relation import Relation

_FAR = 1e-3  # share of the size of the mechanism [-], angle [rad]: see the header
_ROUNDING = 1e-9  # lengths as shares of this size, and angles [rad], that are not listed
_SHOWN = 4  # joints, and bodies, in a warning


@dataclass(frozen=True)
class Way:
    """A joint or a body with a length [m] and an angle [rad]: a gap, or the way that a body is moved."""

    name: str
    distance: float
    angle: float

    def __str__(self) -> str:
        parts = [f"{self.distance:.3g} m"] * (self.distance > 0.0) + [f"{self.angle:.3g} rad"] * (self.angle > 0.0)
        return f"{self.name!r} by {' and '.join(parts)}"


@dataclass(frozen=True)
class Closing:
    """What the start moves to close joints, each the farthest first.

    joints   those that are open where the bodies were put
    bodies   those that are moved
    far      whether a joint is open by more than rounding of positions (module header)
    """

    joints: tuple[Way, ...] = ()
    bodies: tuple[Way, ...] = ()
    far: bool = False

    @classmethod
    @torch.no_grad()
    def of(cls, dynamics: Any, start: Tensor, closed: Tensor) -> Closing:
        """That of one design from given coordinates to closed ones [n_q, 1, 1]."""
        T, data = dynamics.topology, dynamics.values().data
        t = torch.zeros((), dtype=torch.float64)
        undeformed = start.clone()
        equations.split_q(T, undeformed)[2].zero_()
        before, after, still = (
            equations.placement(T, data, q, T.prescribed(t, data)) for q in (start, closed, undeformed)
        )
        size = dynamics.initial.size
        gaps, phi = {}, equations.constraints(T, still)[:, 0, 0].abs()
        for kind, rows in T.row_slices():
            if isinstance(kind, Relation):
                phi[rows] /= kind.largest_factors(data)
            unit = 2 if kind.angles and not kind.travels else int(isinstance(kind, (Perpendicular, Angle)))
            for i in range(rows.start, rows.stop):
                gaps.setdefault(T.row_joints[i], [0.0, 0.0, 0.0])[unit] += float(phi[i]) ** 2
        joints = [Way(name, x[0] ** 0.5, math.asin(min(x[1] ** 0.5, 1.0)) + x[2] ** 0.5) for name, x in gaps.items()]
        bodies = [_way(T, k, before, after, start, closed) for k in range(T.bodies)]
        return cls(
            *(_listed(ways, size) for ways in (joints, bodies)),
            far=any(way.distance > _FAR * size or way.angle > _FAR for way in joints),
        )

    def __str__(self) -> str:
        return f"joints are open at the given positions of the bodies: {_shown(self.joints)}"


def warn_far(closing: Closing, in_equilibrium: bool) -> None:
    """Warn of joints that are open by more than rounding of positions; in_equilibrium: where the start is one."""
    if closing.far:
        moves = f"to close them, torchmbd moves {_shown(closing.bodies)}"
        warn(
            f"{closing}; {'they are closed in the static equilibrium of the start' if in_equilibrium else moves}. Try: "
            "positions, axes and laws of drives that close the joints at t = 0 (system.describe() lists all gaps)"
        )


def _shown(ways: tuple[Way, ...]) -> str:
    return ", ".join(map(str, ways[:_SHOWN])) + f" and {len(ways) - _SHOWN} more" * (len(ways) > _SHOWN)


def _way(T: Any, body: int, before: Any, after: Any, start: Tensor, closed: Tensor) -> Way:
    """How far a body is moved."""
    points = [i for i, x in enumerate(T.attached) if int(T.vector_body[i]) == body and x.is_point]
    r, p = T.r_slice(body), T.p_slice(body)
    ways = torch.cat([(closed - start)[r, 0], (after.g - before.g)[:, points, 0, 0]], 1).norm(dim=0)
    p, p0 = closed[p, 0, 0], start[p, 0, 0]
    chord = torch.minimum((p - p0).norm(), (p + p0).norm())  # 2 sin(angle / 4): Euler parameters have half the angle
    angle = _with_turns(T, body, float(4.0 * torch.asin(0.5 * chord)), start, closed)
    return Way(T.names[body], float(ways.max()), angle)


def _with_turns(T: Any, body: int, angle: float, start: Tensor, closed: Tensor) -> float:
    """The rotation of a body with full turns, as its joint to the ground counts them, out of the angle within half a turn."""
    if T.turns is None:
        return angle
    ends = torch.stack([T.turns.first, T.turns.second])
    to_ground = (ends == body).any(0) & (ends == T.bodies).any(0)
    counted = max((closed - start)[-T.turn_count :, 0, 0][to_ground].abs().tolist(), default=0.0)
    turns = round(counted / (2.0 * math.pi))
    return min(
        (abs(2.0 * math.pi * k + sign * angle) for k in (turns - 1, turns, turns + 1) for sign in (1, -1)),
        key=lambda x: abs(x - max(counted, angle)),
    )


def _listed(ways: list[Way], size: float) -> tuple[Way, ...]:
    """The ways beyond rounding, the farthest first, with rounding set to zero."""
    rounded = [Way(x.name, x.distance * (x.distance > _ROUNDING * size), x.angle * (x.angle > _ROUNDING)) for x in ways]
    moved = [x for x in rounded if x.distance or x.angle]
    return tuple(sorted(moved, key=lambda x: -max(x.distance / size, x.angle)))
