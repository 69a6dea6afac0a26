"""Static displacements of a flexible body under unit loads, without the part of its modes.

    U = K^-1 P - Psi Kr^-1 Psi' P        K: reference held;  Psi, Kr: modes and reduced stiffness

P: the twelve unit loads of inertia (bodies/stiffening.py), then unit forces and moments in body axes on each interpolation
constraint of frames, then those of unit changes of temperature and moisture (bodies/expansion.py). Under loads P c of a
motion with modal coordinates w the displacements of the body are Psi w + U c: those of the retained modes, and the static
ones of all others.
Differentiable, forward and reverse, in every parameter of the body, and in Psi and Kr.
Source: R. L. Bisplinghoff, H. Ashley, R. L. Halfman, Aeroelasticity (1955) (mode acceleration); D. J. Rixen, "Generalized mode
acceleration methods", 2001 (residual flexibility).
Checked in tests/extensions/buckling/test_buckling_index.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.fem.reduction import StaticLoads
from torchmbd.fem.reduction.padding import with_stiff_padding
from torchmbd.math.module_call import outside_transforms
from torchmbd.multibody.bodies import FlexibleBody
from torchmbd.multibody.bodies.expansion import Load
from torchmbd.multibody.bodies.interpolation import InterpolationConstraint
from torchmbd.multibody.bodies.stiffening import inertial_loads


class UnitLoads:
    """Unit loads of one body, on the nodes of frames (mounts), and of changes of temperature and moisture."""

    def __init__(
        self, body: FlexibleBody, mounts: Sequence[InterpolationConstraint], changes: Sequence[Load] = ()
    ) -> None:
        self.body, self.changes = body, changes
        self._static = outside_transforms(lambda: StaticLoads(body.assembly.pattern))
        self._on_mounts = outside_transforms(lambda: [_on_nodes(body, mount) for mount in mounts])

    def __call__(
        self, psi: Float[Tensor, "*lanes n 6 m"], Kr: Float[Tensor, "*lanes m m"]
    ) -> Float[Tensor, "*lanes n 6 k"]:
        """U of the present design, with modes psi and reduced stiffness Kr."""
        assembly, body = self.body.assembly, self.body
        points = assembly.masses()
        x = assembly.mass_positions(body.places(), points.arm)
        P = assembly.forces_on_nodes(inertial_loads(points, x), points.arm)
        free = [body.expansion.forces(*change)[..., None] for change in self.changes]
        lanes = torch.broadcast_shapes(*(x.shape[:-3] for x in (P, *free)))
        P = torch.cat([x.expand(*lanes, *x.shape[-3:]) for x in (P, *self._on_mounts, *free)], -1)
        whole = assembly.freedoms.expand(self._static(assembly.stiffness(), assembly.freedoms.gathered(P)))
        share = torch.linalg.solve(with_stiff_padding(Kr), psi.flatten(-3, -2).mT @ P.flatten(-3, -2))
        return whole - (psi.flatten(-3, -2) @ share).unflatten(-2, psi.shape[-3:-1])


def _on_nodes(body: FlexibleBody, mount: InterpolationConstraint) -> Float[Tensor, "n 6 6"]:
    """Unit forces and moments on a mount as those on the nodes of the body: the transpose of its motion."""
    nodes, x = list(mount.nodes), body.mesh.nodes.detach()
    local = replace(mount, nodes=tuple(range(len(nodes))))
    motion = local.motion(x[nodes], torch.eye(6 * len(nodes), dtype=x.dtype).unflatten(0, (-1, 6)))
    return x.new_zeros(len(x), 6, 6).index_add(0, torch.tensor(nodes), motion.mT.unflatten(0, (-1, 6)))
