"""Views of a trajectory: one body, a point of a body, a joint. Plain torch, shapes [lanes, times, ...].

    point            r + A rho                                              rho = b + Psi_t w, body axes
    velocity         r' + A (om x rho + Psi_t w')
    acceleration     r'' + A (om' x rho + om x (om x rho) + 2 om x Psi_t w' + Psi_t w'')

om is the angular velocity in body axes; r, velocities and accelerations of points are in ground axes.
Differentiable as the motion is.
Checked in tests/results/test_body_motion.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.elements.beam_line import varying_nodes
from torchmbd.math.lane_groups import by_groups
from torchmbd.math.pair import Pair, value
from torchmbd.math.rotation import rotation_matrix
from torchmbd.multibody.bodies import Frame
from torchmbd.multibody.joints.joint import Attached
from torchmbd.results.motion_data import MotionData
from torchmbd.summary import Summary

Where = str | int | Sequence[float] | Frame | None


class BodyMotion(Summary):
    """One body along a trajectory."""

    def __init__(self, motion: MotionData, name: str):
        self.motion, self.name = motion, name
        self._T = motion.dynamics.topology
        self._index = self._T.names.index(name)
        self.mesh = getattr(motion.system.body(name), "mesh", None)

    @property
    def r(self) -> Tensor:
        """Origin of the body frame in ground axes [lanes, times, 3] [m]."""
        r = self.motion.signals.values("q", self._T.r_slice(self._index))
        return r if self._arm is None else r + self._turned(self._arm.expand_as(r))

    @property
    def p(self) -> Tensor:
        """Euler parameters [lanes, times, 4]."""
        return self.motion.signals.values("q", self._T.p_slice(self._index))

    @property
    def A(self) -> Tensor:
        """Rotation, body -> ground [lanes, times, 3, 3]."""
        return rotation_matrix(self.p.movedim(-1, 0)).movedim((0, 1), (-2, -1))

    @property
    def omega(self) -> Tensor:
        """Angular velocity in body axes [lanes, times, 3] [rad/s]."""
        return self.motion.signals.values("v", self._spin_rows())

    @property
    def omega_rate(self) -> Tensor:
        """Angular acceleration in body axes [lanes, times, 3] [rad/s2]."""
        return self.motion.signals.values("a", self._spin_rows())

    @property
    def velocity(self) -> Tensor:
        """Velocity of the origin in ground axes [lanes, times, 3] [m/s]."""
        v = self.motion.signals.values("v", self._T.r_slice(self._index))
        return v if self._arm is None else v + self._turned(_cross(self.omega, self._arm.expand_as(v)))

    @property
    def _acceleration(self) -> Tensor:
        """Acceleration of the origin in ground axes [lanes, times, 3] [m/s2]."""
        a = self.motion.signals.values("a", self._T.r_slice(self._index))
        if self._arm is None:
            return a
        om, arm = self.omega, self._arm.expand_as(a)
        return a + self._turned(_cross(self.omega_rate, arm) + _cross(om, _cross(om, arm)))

    @property
    def _arm(self) -> Tensor | None:
        """Origin from the base point, in body axes [3] (base_points.py); None: the same."""
        c = self._T.base_point(self._index)
        return None if c is None or not bool(c.any()) else -c

    def _turned(self, x: Tensor) -> Tensor:
        """Vectors [lanes, times, 3] in ground axes, of those in body axes."""
        return torch.einsum("ltij,ltj->lti", self.A, x)

    def _spin_rows(self) -> list[int]:
        return [(3 + i) * self._T.bodies + self._index for i in range(3)]

    def _flexible(self) -> int:
        if self._index >= self._T.flexible:
            raise InputError("body", self.name, allowed="a flexible body", state="is rigid", noun=f"body {self.name!r}")
        return self._index

    @property
    def w(self) -> Tensor:
        """Modal coordinates [lanes, times, modes]; derivatives are in the moving basis of `psi`, not of single modes."""
        return self.motion.signals.values("q", self._T.w_slice(self._flexible()))

    @property
    def dw_db(self) -> Tensor | None:
        """Sensitivities of the modal coordinates [lanes, times, modes, n_b]."""
        return self.motion.tangents("q", self._T.w_slice(self._flexible()))

    def _modal_rows(self) -> list[int]:
        return [row - self._T.bodies for row in self._T.w_slice(self._flexible())]

    @property
    def wd(self) -> Tensor:
        """Rates of the modal coordinates [lanes, times, modes]."""
        return self.motion.signals.values("v", self._modal_rows())

    @property
    def wdd(self) -> Tensor:
        """Accelerations of the modal coordinates [lanes, times, modes]."""
        return self.motion.signals.values("a", self._modal_rows())

    @property
    def stiffness(self) -> tuple[Tensor, Tensor | None]:
        """Reduced stiffness Kr [lanes, m, m] and its design tangent [lanes, m, m, n_b]."""
        Kr = self.motion.dynamics.data["Kr"]
        m, f = self._T.mode_counts[self._flexible()], self._index
        lanes = self.motion.lanes
        K = value(Kr)[:m, :m, f, 0].movedim(-1, 0).expand(lanes, m, m)
        if not isinstance(Kr, Pair):
            return K, None
        dK = Kr.tangent[:m, :m, f].movedim(-1, 0)
        return K, dK.expand(lanes, *dK.shape[1:])

    @property
    def bent_stiffness(self) -> Tensor | None:
        """K2 w, what bending adds to the stiffness [lanes, times, m, m]; None: nothing."""
        K2 = self.motion.dynamics.data.get("K2")
        if K2 is None:
            return None
        m = self._T.mode_counts[self._flexible()]
        block = value(K2)[:m, :m, :m, self._index, 0].movedim(-1, 0)
        return torch.einsum("labc,ltc->ltab", block.expand(self.motion.lanes, m, m, m), self.w)

    @property
    def mass(self) -> Tensor:
        """Mass of the body [lanes] [kg]."""
        return value(self.motion.dynamics.data["mass"])[self._index, 0].expand(self.motion.lanes)

    @property
    def strain_energy(self) -> Tensor:
        """U = 1/2 w' Kr w [lanes, times] [J], eq. (17), and 1/6 K2 www of a body with a quadratic stiffness."""
        w, bent = self.w, self.bent_stiffness
        (energy,) = by_groups(lambda w, K: (0.5 * ((w @ K) * w).sum(-1),), w, self.stiffness[0])
        return energy if bent is None else energy + (w * (bent @ w[..., None])[..., 0]).sum(-1) / 6.0

    @property
    def psi(self) -> Tensor:
        """Mode shapes [lanes, nodes, 6, modes] of the designs of this motion."""
        self._flexible()
        return self.motion.modes(self.name)

    @property
    def displacements(self) -> Tensor:
        """Elastic displacements of the nodes in body axes [lanes, times, nodes, 3] [m]."""
        return torch.einsum("lnim,ltm->ltni", self.psi[:, :, :3], self.w)

    @property
    def nodes(self) -> Tensor:
        """Positions of the deformed mesh in ground axes [lanes, times, nodes, 3] [m]."""
        self._flexible()
        body = self.motion.system.body(self.name)
        local = _node_positions(self.motion, body)[:, None] + self.displacements
        return self.r[:, :, None] + torch.einsum("ltij,ltnj->ltni", self.A, local)

    def _summary(self) -> list[tuple[str, Any]]:
        kind = f"flexible, {self.w.shape[-1]} modes" if self._index < self._T.flexible else "rigid"
        return [("body", f"{self.name} ({kind})"), *self.motion._summary()[:3]]

    def at(self, where: Where = None) -> PointMotion:
        """A point of the body.

        where   a node or node set of the mesh, a position in body axes on a rigid body, or a frame; None: the origin
        """
        return PointMotion.of(self, where)


def _node_positions(motion: MotionData, body: Any) -> Tensor:
    """Positions of the nodes of the undeformed body from its origin [lanes or 1, n, 3] [m]."""
    if not varying_nodes(body.mesh):
        return (body.mesh.nodes - body.origin)[None]
    positions = motion.of_designs(body.places)
    return positions if positions.dim() == 3 else positions[None]


def point_of(motion: MotionData, frame: Frame) -> Tensor:
    """Point of a frame in the axes of its body [lanes or 1, 1, 3] [m], as the designs have it."""
    if frame.interpolation is not None and varying_nodes(frame.body.mesh):
        nominal = frame.interpolation.center(frame.body.mesh.nodes - frame.body.origin)
        return (frame.interpolation.center(_node_positions(motion, frame.body)) + frame.point - nominal)[:, None]
    if frame.varying is None:
        return frame.point[None, None]
    places = [attached.varying if attached.is_point else None for attached in motion.dynamics.topology.attached]
    if frame.varying not in places:
        return frame.present_point[None, None]
    i = places.index(frame.varying)
    return motion.dynamics.topology.from_origin(i, value(motion.dynamics.data["x"])[:, i, 0].T[:, None])


def triad_of(motion: MotionData, frame: Frame) -> Tensor:
    """Columns: the axes of a frame in those of its body [lanes or 1, 1, 3, 3], as the designs have them."""
    place = frame.varying
    if place is None:
        return frame.axes[None, None]
    triad = motion.of_designs(lambda: place().triad(), place)
    return triad[:, None] if triad.dim() == 3 else triad[None, None]


@dataclass(frozen=True)
class PointMotion:
    """One point of a body along a trajectory [lanes, times, 3]; see the module header.

    rho           from the origin of the body frame to the point, in body axes [m]
    displacement  elastic displacement u' of the point in body axes [m]
    """

    body: BodyMotion
    displacement: Tensor
    rho: Tensor
    rho_rate: Tensor  # in body axes
    rho_acceleration: Tensor  # in body axes

    @classmethod
    def of(cls, body: BodyMotion, where: Where) -> PointMotion:
        """The point `where` of a body; InputError if it has no such point."""
        frame = _frame(body, where)
        zero = torch.zeros_like(body.r)
        if frame is None:
            return cls(body, zero, zero, zero, zero)
        if frame.interpolation is None:
            return cls(body, zero, point_of(body.motion, frame) + zero, zero, zero)
        psi = Attached(frame.body, frame.point, frame.interpolation, True).modal_rows(body.psi)
        u, rate, acceleration = (torch.einsum("lim,ltm->lti", psi, x) for x in (body.w, body.wd, body.wdd))
        return cls(body, u, point_of(body.motion, frame) + u, rate, acceleration)

    @property
    def position(self) -> Tensor:
        """In ground axes [m]."""
        return self.body.r + self.body._turned(self.rho)

    @property
    def velocity(self) -> Tensor:
        """In ground axes [m/s]."""
        return self.body.velocity + self.body._turned(_cross(self.body.omega, self.rho) + self.rho_rate)

    @property
    def acceleration(self) -> Tensor:
        """In ground axes [m/s2]."""
        om, turn = self.body.omega, self.body.omega_rate
        local = _cross(turn, self.rho) + _cross(om, _cross(om, self.rho) + 2.0 * self.rho_rate) + self.rho_acceleration
        return self.body._acceleration + self.body._turned(local)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return torch.linalg.cross(a, b, dim=-1)


def _frame(view: BodyMotion, where: Where) -> Frame | None:
    """The frame of a point of a body, None for its origin."""
    body = view.motion.system.body(view.name)
    if isinstance(where, Frame) and where.body.name != view.name:
        raise InputError("frame", allowed=f"a frame on {view.name!r}", state=f"is on another body, {where.body.name!r}")
    if where is None or isinstance(where, Frame):
        return where
    if view.mesh is not None:
        return body.at(where)
    if (
        isinstance(where, (str, int))
        or getattr(where, "ndim", 1) != 1
        or not hasattr(where, "__len__")
        or len(where) != 3
    ):
        raise InputError(
            "point", where, "three numbers in body axes [m]", noun=f"point of the rigid body {view.name!r}"
        )
    return body.at(*where)
