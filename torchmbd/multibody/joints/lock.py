"""Lock: the frames of a joint keep the relative pose that they have when a phase begins.

The joint stays active; the lock adds one equation for each degree of freedom that the joint leaves, of these six:

    plane          the point of b stays in the plane through a marked point on a with the normal e_k, k = x, y, z
    perpendicular  axis e_i of a stays perpendicular to a marked axis on b, (i, j, k) cyclic: no rotation about e_k

The degrees of freedom follow from the equations of the joint at the given initial positions. The marks depend on the design:
a point on a and three axes on b are attached vectors like those of every joint, but their components are set at the switch
(integrate/phases/switch.py), with their design tangents. Locks are made by the phases of a simulation, never by users.
Checked in tests/multibody/joints/test_lock.py, tests/integrate/phases/test_phase.py.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import scipy.linalg
import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.math.forward_mode import jacfwd
from torchmbd.multibody.joints.joint import Attached, AttachmentTable, Equation, Joint
from torchmbd.multibody.joints.primitive import Perpendicular, Plane

_RANK = 1e-6  # share of the largest singular value that counts as zero: the given positions are approximate


@dataclass(frozen=True, eq=False)
class Marks:
    """Attached vectors of a lock: those of both frames, and the marks `point` and `axes`, which are set at the switch."""

    point_a: Attached
    axes_a: list[Attached]
    point_b: Attached
    axes_b: list[Attached]
    point: Attached
    axes: list[Attached]


class Lock(Joint):
    """`Lock(joint, name)`: fixes a joint in its pose at a switch; its reaction is part of that of the joint, `of`."""

    marks: Marks
    of: str

    def __init__(self, joint: Joint, name: str):
        super().__init__(joint.a, joint.b, name)
        self.of = joint.name
        self.freedoms = freedoms(joint)
        if not self.freedoms:
            raise InputError(
                (joint.name,),
                allowed="a joint that moves",
                noun=repr(joint.name),
                state="cannot be locked, because it leaves no degree of freedom",
            )

    def equations(self, attachments: AttachmentTable) -> Iterator[Equation]:
        vectors = attachments.vectors
        points = attachments.point(self.a), attachments.point(self.b)
        axes_a, axes_b = ([attachments.axis(frame, k) for k in "xyz"] for frame in (self.a, self.b))
        first = len(vectors)
        vectors += [replace(vectors[i]) for i in (points[0], *axes_b)]
        self.marks = Marks(
            vectors[points[0]],
            [vectors[i] for i in axes_a],
            vectors[points[1]],
            [vectors[i] for i in axes_b],
            vectors[first],
            vectors[first + 1 : first + 4],
        )
        for freedom in self.freedoms:
            if freedom < 3:
                yield Equation(Plane, (first, points[1], axes_a[freedom]))
            else:
                i, j = (freedom + 1) % 3, (freedom + 2) % 3
                yield Equation(Perpendicular, (axes_a[i], first + 1 + j))


def freedoms(joint: Joint) -> list[int]:
    """Degrees of freedom that a joint leaves body b, in the axes of frame a: translations 0, 1, 2, rotations 3, 4, 5.

    If it leaves only combinations of these, those with the largest entries in the null space of its Jacobian.
    """
    jacobian: Any = jacfwd(lambda twist: _phi(joint, twist))
    J = jacobian(torch.zeros(6, dtype=torch.float64))
    _, s, Vh = torch.linalg.svd(J, full_matrices=True)
    N = Vh[int((s > _RANK * s[0]).sum()) :]
    if not len(N):
        return []
    factors: Any = scipy.linalg.qr(N.numpy(), mode="economic", pivoting=True)
    return sorted(factors[2][: len(N)].tolist())


def _phi(joint: Joint, twist: Tensor) -> Tensor:
    """Violations [rows] of a joint at the given positions, body b moved by a twist [6] in the axes of frame a."""
    attachments = AttachmentTable()
    equations = list(joint.equations(attachments))
    axes = joint.a.body.axes @ joint.a.axes
    origin = joint.a.body.position.detach() + joint.a.body.axes @ joint.a.present_point
    shift, turn = axes @ twist[:3], axes @ twist[3:]

    def ground(x: Attached) -> Tensor:
        g = x.body.axes @ x.vector
        g = g + x.body.position.detach() if x.is_point else g
        if x.body is not joint.b.body:
            return g
        turned = g + torch.linalg.cross(turn, g - origin if x.is_point else g)
        return turned + shift if x.is_point else turned

    vectors = [ground(x)[:, None, None, None] for x in attachments.vectors]
    rows = []
    for kind, members, data in equations:
        primitive = kind((torch.zeros(1, dtype=torch.long),), (data,))
        rows.append(primitive.phi([vectors[i] for i in members]).flatten())
    return torch.cat(rows)
