"""Steady rotation of a whole system about an axis of the ground: its rates, and the terms that it adds to small vibrations.

    q(t) = exp(~s t) o (q0 o exp(x))         s: angular velocity, x: increments in the rotating axes
    r' = s x (r - c) + x_r'                  omega = A's + x_th'
    r'' = s x (s x (r - c)) + 2 s x x_r'     omega' = A's x x_th'          to first order in x', without x''

So a steady state solves the equations of motion with these rates, and the matrices of its vibrations are constant.
Checked in tests/multibody/system/test_steady_rotation.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.math.checked_numbers import reals
from torchmbd.math.pair import cat, cross, matvec_t
from torchmbd.math.rotation import rotation_matrix
from torchmbd.multibody.system import equations
from torchmbd.multibody.system.topology import Topology


@dataclass(frozen=True, eq=False)
class SteadyRotation:
    """spin: angular velocity in ground axes [rad/s]; center: a point of the axis [m]."""

    spin: Float[Tensor, " 3"]
    center: Float[Tensor, " 3"]

    @classmethod
    def of(cls, spin: Sequence[float] | Tensor | None, center: Sequence[float] | Tensor) -> SteadyRotation | None:
        """The rotation of two arguments; None without a spin. InputError for anything but three finite numbers, and for a
        center without a spin."""
        if spin is None:
            if reals("center", center).any():
                raise InputError(f"center is {center!r} without a spin; allowed: with spin=(...)")
            return None
        vectors = []
        for name, components in (("spin", spin), ("center", center)):
            x = reals(name, components)
            if x.shape != (3,) or not bool(torch.isfinite(x).all()):
                raise InputError(f"{name} is {components!r}; allowed: three finite numbers")
            vectors.append(x.detach())
        return cls(*vectors) if bool(vectors[0].any()) else None

    @property
    def period(self) -> float:
        """Time of a turn by one radian [s]."""
        return 1.0 / float(self.spin.norm())

    def rates(self, T: Topology, q: Any) -> tuple[Any, Any]:
        """v and v' [n_v, ...] of the rotation at coordinates q [n_q, ...]."""
        r, p, w = equations.split_q(T, q)
        spin, center = (x[:, None, None, None] for x in (self.spin, self.center))
        velocity = cross(spin, r - center)
        omega = matvec_t(rotation_matrix(p), spin)
        still = 0.0 * w
        v = cat([x.flatten(0, 1) for x in (velocity, omega, still)])
        return v, cat([x.flatten(0, 1) for x in (cross(spin, velocity), 0.0 * omega, still)])

    def accelerations(self, T: Topology, q: Tensor, rates: Any) -> Any:
        """The part of v' [n_v, ...] that rates x' [n_v, ...] in the rotating axes add."""
        _, p, _ = equations.split_q(T, q)
        dr, dth, dw = equations.split_v(T, rates)
        spin = self.spin[:, None, None, None]
        turned = cross(matvec_t(rotation_matrix(p), spin), dth)
        return cat([x.flatten(0, 1) for x in (2.0 * cross(spin, dr), turned, 0.0 * dw)])

    def turned(self, T: Topology, q: Tensor) -> Tensor:
        """Coordinates [n_q, ...] after a turn by one radian."""
        r, p, w = equations.split_q(T, q)
        axis = (self.spin / self.spin.norm())[:, None, None, None]
        arm = r - self.center[:, None, None, None]
        step = [_turned(axis, arm) - arm, matvec_t(rotation_matrix(p), axis), 0.0 * w]
        return equations.advance(T, q, cat([x.flatten(0, 1) for x in step]))

    def turned_forces(self, T: Topology, forces: Tensor, angle: float = 1.0) -> Tensor:
        """Forces, or increments of coordinates, [n_v] after a turn by an angle [rad]: those in ground axes turn, those in body
        axes and modal ones stay."""
        n = 3 * T.bodies
        axis = (self.spin / self.spin.norm())[:, None]
        return torch.cat([_turned(axis, forces[:n].reshape(3, -1), angle).flatten(), forces[n:]])


def _turned(axis: Tensor, x: Tensor, angle: float = 1.0) -> Tensor:
    """Vectors x [3, ...] turned by an angle [rad] about an axis."""
    once = cross(axis, x)
    return x + math.sin(angle) * once + (1.0 - math.cos(angle)) * cross(axis, once)
