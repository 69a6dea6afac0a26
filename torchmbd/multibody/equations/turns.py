"""Turns: angles of joints that count full turns, as coordinates of the motion.

    tau    angle of the axis x of body b from the axis x of body a, towards y of a, in rigid bodies      [rad]

Rotations of bodies are Euler parameters, which forget full turns. A relation between angles (multibody/joints/relation.py)
needs them, as 2.5 times an angle is another rotation after a turn. Each of its angles has a coordinate tau behind the others
of q. It has no rate in v, as it is a function of the rotations except for full turns:

    after a step with the rotations dth in body axes     tau <- the angle nearest to tau + z_b . dth_b - z_a . dth_a
    in an ordinary differential equation                 tau' = z_b . om_b - z_a . om_a + 50 (nearest angle - tau)

Elastic rotations are not in tau; the equation takes its angle near tau.
Checked in tests/multibody/joints/test_joint_coupling.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchmbd.math.elementwise import angle_near
from torchmbd.math.pair import cat, dot, linear, matvec, value
from torchmbd.math.rotation import rotation_matrix

_PULL = 50.0  # [1/s]


@dataclass(frozen=True, eq=False)
class Turns:
    """The counted angles of a system.

    first, second   bodies of the frames a and b [k], long; the number of bodies is the ground
    axes            [5, 3, k, 1, 1]: x, y and z of each a, x and z of each b, in axes of their bodies
    """

    first: Tensor
    second: Tensor
    axes: Tensor

    @classmethod
    def of(cls, angles: Sequence[tuple[int, ...]], attached: Sequence[Any], body_of: Sequence[int]) -> Turns | None:
        """Those of angles between attached vectors (x and y of a, x of b), on bodies of these numbers; None: no angles."""
        if not angles:
            return None
        x, y, b = (torch.stack([attached[i].vector for i in each], 1) for each in zip(*angles, strict=True))
        first, second = (torch.tensor([body_of[angle[k]] for angle in angles]) for k in (0, 2))
        z = torch.linalg.cross(x, y, dim=0)
        axes = [torch.stack([body.axes for body in (attached[angle[k]].body for angle in angles)], 2) for k in (0, 2)]
        in_b = torch.einsum("ijk,ilk,lk->jk", axes[1], axes[0], z)
        return cls(first, second, torch.stack([x, y, z, b, in_b])[..., None, None])

    def __len__(self) -> int:
        return len(self.first)

    def renumbered(self, number: Mapping[int, int]) -> Turns:
        """The same angles for other numbers of the bodies and the ground."""
        first, second = (torch.tensor([number[i] for i in x.tolist()]) for x in (self.first, self.second))
        return replace(self, first=first, second=second)


def advanced(T: Any, tau: Any, p: Any, turn: Any) -> Any:
    """Angles [k, ...] after rotations `turn` [3, bodies] to Euler parameters p [4, bodies], from angles tau before."""
    return _nearest(T.turns, p, tau + _about_axes(T.turns, turn))


def rates(T: Any, tau: Any, p: Any, om: Any) -> Any:
    """d tau / dt [k, ...] at angular velocities om [3, bodies]."""
    return _about_axes(T.turns, om) + _PULL * (_nearest(T.turns, p, tau) - tau)


def _about_axes(turns: Turns, x: Any) -> Any:
    """Rotations or angular velocities x of b from a about z [k, ...]."""
    whole = cat([x, linear(lambda y: torch.zeros_like(y[:, :1]), x)], 1)
    return dot(whole.index_select(1, turns.second), turns.axes[4]) - dot(
        whole.index_select(1, turns.first), turns.axes[2]
    )


def _nearest(turns: Turns, p: Any, tau: Any) -> Any:
    """The angles [k, ...] of bodies with Euler parameters p [4, bodies] that are nearest to tau."""
    A = cat(
        [rotation_matrix(p), torch.eye(3, dtype=torch.float64, device=turns.axes.device)[:, :, None, None, None]], 2
    )
    of_a, of_b = A.index_select(2, turns.first), A.index_select(2, turns.second)
    x, y, b = matvec(of_a, turns.axes[0]), matvec(of_a, turns.axes[1]), matvec(of_b, turns.axes[3])
    return angle_near(dot(y, b), dot(x, b), value(tau))
