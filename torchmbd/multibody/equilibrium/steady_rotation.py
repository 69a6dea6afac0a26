"""Steady rotation of a whole system about an axis of the ground: its rates, and the terms that it adds to small vibrations.

    q(t) = exp(~s t) o (q0 o exp(x))         s: angular velocity, x: increments in the rotating axes
    r' = s x (r - c) + x_r'                  omega = A's + x_th'
    r'' = s x (s x (r - c)) + 2 s x x_r'     omega' = A's x x_th'          to first order in x', without x''

So a steady state solves the equations of motion with these rates, and the matrices of its vibrations are constant.
An observer in the ground (`GroundObserver`) measures increments in ground axes instead:

    r' = s x (r0 - c) + x_r'       omega = A's + A'x_th'       r'' = x_r''       omega' = A'x_th'' - omega x A'x_th'

Of a shaft that is the same after any turn their matrices are constant as well, whatever bearings it has.
Checked in tests/multibody/equilibrium/test_steady_rotation.py, tests/multibody/equilibrium/test_ground_observer.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError, one_of
from torchmbd.math.checked_numbers import differentiable_reals, reals
from torchmbd.math.gradients import all_true, is_differentiated
from torchmbd.math.pair import cat, cross, linear, matvec, matvec_t
from torchmbd.math.rotation import rotation_matrix
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equations.topology import Topology


class Observer(Protocol):
    """Who measures the increments of the coordinates in small vibrations about a state."""

    def perturbed(self, T: Topology, q: Tensor, x: Any, xd: Any, xdd: Any) -> tuple[Any, Any, Any]:
        """Coordinates, rates and accelerations [n, ...] at increments x, x', x'' [n_v, ...] about coordinates q."""
        ...

    def rows(self, T: Topology, q: Tensor, forces: Any) -> Any:
        """Generalized forces [n_v, ...], with torques in body axes, that do work on the increments."""
        ...


TURNING, GROUND = "turning", "ground"


class ObserverAtRest:
    """About a state at rest: increments of positions in ground axes, of rotations in body axes."""

    def perturbed(self, T: Topology, q: Tensor, x: Any, xd: Any, xdd: Any) -> tuple[Any, Any, Any]:
        return equations.advance(T, q, x), xd, xdd

    def rows(self, T: Topology, q: Tensor, forces: Any) -> Any:
        return forces


@dataclass(frozen=True, eq=False)
class SteadyRotation:
    """spin: angular velocity in ground axes [3, 1, lanes] [rad/s]; center: a point of the axis [3] [m].

    It is an observer who turns with the whole: increments of positions are in ground axes at the time of the linearization.
    drives_follow: whether the drives turn at this spin, whatever the speed of their laws.
    """

    spin: Any
    center: Float[Tensor, " 3"]
    drives_follow: bool = False

    @classmethod
    def of(
        cls, spin: Sequence[float] | Tensor | None, center: Sequence[float] | Tensor, observer: str = TURNING
    ) -> SteadyRotation | None:
        """The rotation of three arguments; None without a spin. InputError for anything but three finite numbers for each lane,
        and for a center without a spin."""
        kind = OBSERVERS[one_of("observer", observer, OBSERVERS)]
        middle = reals("center", center)
        if middle.shape != (3,) or not bool(torch.isfinite(middle).all()):
            raise InputError("center", center, "three finite numbers")
        if spin is None:
            if bool(middle.any()) or observer != TURNING:
                name, x = ("center", center) if bool(middle.any()) else ("observer", observer)
                raise InputError(name, x, "given with spin=(...)", state=f"is {x!r} without a spin")
            return None
        allowed = "three finite numbers, or three for each lane"
        x = differentiable_reals("spin", spin, allowed)
        if x.shape[-1:] != (3,) or x.dim() > 2 or not all_true(torch.isfinite(x)):
            raise InputError("spin", spin, allowed)
        axes = x.movedim(-1, 0).reshape(3, 1, -1)
        turns = is_differentiated(axes) or axes.shape[-1] > 1 or bool(axes.any())
        return kind(axes, middle) if turns else None

    def of_spin(self, spin: Any) -> SteadyRotation:
        """The same rotation at another spin [3, ..., lanes]."""
        return replace(self, spin=spin)

    def rates(self, T: Topology, q: Any) -> tuple[Any, Any]:
        """v and v' [n_v, ...] of the rotation at coordinates q [n_q, ...]."""
        r, p, w = equations.split_q(T, q)
        spin, center = linear(lambda x: x[:, None], self.spin), self.center[:, None, None, None]
        velocity = cross(spin, r - center)
        omega = matvec_t(rotation_matrix(p), spin)
        still = 0.0 * w
        v = cat([x.flatten(0, 1) for x in (velocity, omega, still)])
        return v, cat([x.flatten(0, 1) for x in (cross(spin, velocity), 0.0 * omega, still)])

    def perturbed(self, T: Topology, q: Tensor, x: Any, xd: Any, xdd: Any) -> tuple[Any, Any, Any]:
        near = equations.advance(T, q, x)
        v, a = self.rates(T, near)
        _, p, _ = equations.split_q(T, q)
        dr, dth, dw = equations.split_v(T, xd)
        spin = self.spin[:, None]
        turned = cross(matvec_t(rotation_matrix(p), spin), dth)
        coriolis = cat([y.flatten(0, 1) for y in (2.0 * cross(spin, dr), turned, 0.0 * dw)])
        return near, v + xd, a + coriolis + xdd

    def rows(self, T: Topology, q: Tensor, forces: Any) -> Any:
        return forces

    @property
    def turning(self) -> SteadyRotation:
        """The same rotation seen by an observer who turns with it."""
        return SteadyRotation(self.spin, self.center, self.drives_follow)

    def turned(self, T: Topology, q: Tensor) -> Tensor:
        """Coordinates [n_q, ...] after a turn by one radian."""
        r, p, w = equations.split_q(T, q)
        axis = self._axis[:, None]
        arm = r - self.center[:, None, None, None]
        step = [_turned(axis, arm) - arm, matvec_t(rotation_matrix(p), axis), 0.0 * w]
        return equations.advance(T, q, cat([x.flatten(0, 1) for x in step]))

    def turned_forces(self, T: Topology, forces: Tensor, angle: float = 1.0) -> Tensor:
        """Forces, or increments of coordinates, [n_v] after a turn by an angle [rad]: those in ground axes turn, those in body
        axes and modal ones stay."""
        n = 3 * T.bodies
        return torch.cat([_turned(self._axis[:, 0], forces[:n].reshape(3, -1), angle).flatten(), forces[n:]])

    def turned_increments(self, T: Topology, x: Tensor) -> Tensor:
        """Increments of coordinates [n_v] as this observer sees them after a turn by one radian."""
        return self.turned_forces(T, x)

    @property
    def _axis(self) -> Tensor:
        """Unit vector [3, 1, 1]."""
        return self.spin / self.spin.norm()


@dataclass(frozen=True, eq=False)
class GroundObserver(SteadyRotation):
    """The same rotation seen from the ground: increments of positions and of rotations are in ground axes."""

    def perturbed(self, T: Topology, q: Tensor, x: Any, xd: Any, xdd: Any) -> tuple[Any, Any, Any]:
        if T.flexible:
            raise InputError(
                "observer",
                allowed="'turning', which sees whirl at frequencies that differ by the speed",
                state=f"is 'ground', but the modes of body {T.names[0]!r} turn with it",
                hint="a model of flexible beams (mbd.FlexibleBeam) and rigid bodies, which the ground can observe",
            )
        v, a = self.rates(T, q)
        A = rotation_matrix(equations.split_q(T, q)[1])

        def in_body_axes(y: Any) -> Any:
            return y + _of_rotations(T, y, lambda turns: matvec_t(A, turns) - turns)

        spin, turns = equations.split_v(T, v)[1], equations.split_v(T, in_body_axes(xd))[1]
        gyroscopic = _of_rotations(T, xd, lambda _: cross(turns, spin))
        return equations.advance(T, q, in_body_axes(x)), v + in_body_axes(xd), a + gyroscopic + in_body_axes(xdd)

    def rows(self, T: Topology, q: Tensor, forces: Any) -> Any:
        A = rotation_matrix(equations.split_q(T, q)[1])
        return forces + _of_rotations(T, forces, lambda torques: matvec(A, torques) - torques)

    def turned_increments(self, T: Topology, x: Tensor) -> Tensor:
        return x


OBSERVERS: dict[str, type[SteadyRotation]] = {TURNING: SteadyRotation, GROUND: GroundObserver}


def _of_rotations(T: Topology, like: Any, f: Any) -> Any:
    """f(rotations [3, bodies, ...]) of `like` [n_v, ...] as rates [n_v, ...] that are zero elsewhere."""
    dr, dth, dw = equations.split_v(T, like)
    return cat([x.flatten(0, 1) for x in (0.0 * dr, f(dth), 0.0 * dw)])


def _turned(axis: Tensor, x: Tensor, angle: float = 1.0) -> Tensor:
    """Vectors x [3, ...] turned by an angle [rad] about an axis."""
    once = cross(axis, x)
    return x + math.sin(angle) * once + (1.0 - math.cos(angle)) * cross(axis, once)
