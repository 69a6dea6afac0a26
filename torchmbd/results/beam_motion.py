"""A flexible beam along a trajectory: positions, rotations, displacements, strains and section forces.

    f = K (l - l_0)     of each element (multibody/equations/beams.py); its dampers are left out

Differentiable as the motion is. Checked in tests/multibody/bodies/test_flexible_beam.py.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.fem.exact_beam.sections import ElementProperties
from torchmbd.math.rigid_motion import end_wrenches, logarithm
from torchmbd.math.rotation import rotation_matrix
from torchmbd.results.body_motion import BodyMotion, PointMotion
from torchmbd.results.motion_data import MotionData
from torchmbd.summary import Summary

_SIDES = torch.tensor([-1.0, 1.0], dtype=torch.float64)  # section forces act on the face whose normal is along the beam


class BeamMotion(Summary):
    """One flexible beam along a trajectory, as `motion.body(NAME)` gives it.

    r, A            origin [lanes, times, 3] [m] and rotation [lanes, times, 3, 3] of the first node
    nodes           positions of the nodes in ground axes [lanes, times, n, 3] [m]
    omega           angular velocity of the first node in its axes [lanes, times, 3] [rad/s]
    rotations       of the nodes, from mesh axes to ground axes [lanes, times, n, 3, 3]
    displacements   of the nodes from the beam without strain, in the axes of its first node [lanes, times, n, 3] [m]
    strains         mean of each element: stretch, shear y, shear z [1], twist, curvature y, curvature z [1/m]
                    [lanes, times, m, 6]
    forces          (N, V_y, V_z, T, M_y, M_z) of the sections at start and end of each element [lanes, times, m, 2, 6]
    strain_energy   [lanes, times] [J]
    """

    def __init__(self, motion: MotionData, name: str):
        self.motion, self.name = motion, name
        self.beam = motion.system.body(name)
        self.mesh = self.beam.mesh

    @property
    def r(self) -> Float[Tensor, "lanes times 3"]:
        """Position of the first node in ground axes [m]."""
        return self.nodes[:, :, 0]

    @property
    def A(self) -> Float[Tensor, "lanes times 3 3"]:
        """Rotation of the first node."""
        return self.rotations[:, :, 0]

    @property
    def omega(self) -> Float[Tensor, "lanes times 3"]:
        """Angular velocity of the first node in its axes [rad/s]."""
        return self._node(0).omega

    @property
    def omega_rate(self) -> Float[Tensor, "lanes times 3"]:
        """Angular acceleration of the first node in its axes [rad/s2]."""
        return self._node(0).omega_rate

    @property
    def mass(self) -> Tensor:
        """Mass of the beam [kg]."""
        return torch.stack([self._node(k).mass for k in range(len(self.beam.node_bodies))]).sum(0)

    def at(self, where: str | int | None = None) -> PointMotion:
        """A node of the beam, by name or number; None: the first."""
        frame = self.beam.at(0 if where is None else where)
        point = BodyMotion(self.motion, frame.body.name).at()
        return replace(point, displacement=self.displacements[:, :, frame.body.index])

    def _node(self, number: int) -> BodyMotion:
        return BodyMotion(self.motion, self.beam.node_bodies[number].name)

    @cached_property
    def nodes(self) -> Float[Tensor, "lanes times n 3"]:
        """Positions of the nodes in ground axes [m]."""
        return self._rows("r_slice", 3)

    @cached_property
    def rotations(self) -> Float[Tensor, "lanes times n 3 3"]:
        """Of the nodes, from mesh axes to ground axes."""
        p = self._rows("p_slice", 4)
        return rotation_matrix(p.movedim(-1, 0)).movedim((0, 1), (-2, -1))

    def _rows(self, slices: str, each: int) -> Tensor:
        T = self.motion.dynamics.topology
        which = [T.names.index(node.name) for node in self.beam.node_bodies]
        rows = [row for k in which for row in getattr(T, slices)(k)]
        return self.motion.signals.values("q", rows).unflatten(-1, (len(which), each))

    @property
    def displacements(self) -> Float[Tensor, "lanes times n 3"]:
        """From the beam without strain, in the axes of its first node [m]."""
        apart = self.nodes - self.nodes[:, :, :1]
        x = self.mesh.nodes - self.mesh.nodes[0]
        return torch.einsum("ltji,ltnj->ltni", self.A, apart) - x

    @cached_property
    def _elements(self) -> ElementProperties:
        """In the designs of the motion [lanes or 1, ...]."""
        return self.motion.of_designs(self.beam._elements)

    @cached_property
    def _strains(self) -> tuple[Tensor, Tensor, Tensor]:
        """Screws [lanes, times, m, 6], their parts by strain, and the conjugate forces."""
        elements, (i, j) = self._elements, self.mesh.elements.unbind(1)
        axes = elements.axes.expand(self.motion.lanes, *elements.axes.shape[-4:])[:, None]
        A, B = self.rotations[:, :, i] @ axes[..., 0, :, :], self.rotations[:, :, j] @ axes[..., 1, :, :]
        apart = self.nodes[:, :, j] - self.nodes[:, :, i]
        screw = logarithm((A.mT @ apart[..., None])[..., 0], A.mT @ B)
        strain = screw - _wide(elements.screws, 2)
        return screw, strain, (_wide(elements.stiffness, 3) @ strain[..., None])[..., 0]

    @property
    def strains(self) -> Float[Tensor, "lanes times m 6"]:
        """Mean of each element: stretch, shear along y and z [1], twist, curvature about y and z [1/m]."""
        length = self._elements.screws[..., :3].norm(dim=-1, keepdim=True)
        return self._strains[1] / _wide(length, 2)

    @property
    def forces(self) -> Float[Tensor, "lanes times m 2 6"]:
        """(N, V_y, V_z, T, M_y, M_z) of the sections at both ends of the elements, about their axes.

        Weight and inertia act at nodes: N and V are those of the middle of an element.
        """
        screw, _, f = self._strains
        ends = torch.stack(end_wrenches(screw, f), -2)
        return (_wide(self._elements.recover, 4) @ ends[..., None])[..., 0] * _SIDES[:, None]

    @property
    def strain_energy(self) -> Float[Tensor, "lanes times"]:
        """[J]."""
        _, strain, f = self._strains
        return 0.5 * (strain * f).sum((-2, -1))

    def _summary(self) -> list[tuple[str, Any]]:
        return [("body", f"{self.name} (flexible beam, {len(self.mesh.elements)} elements)")]


def _wide(x: Tensor, rank: int) -> Tensor:
    """[lanes or none, *core] of that rank as [lanes or 1, 1, *core]."""
    return (x if x.dim() > rank else x[None])[:, None]
