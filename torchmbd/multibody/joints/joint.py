"""The base class of joints: a joint is a list of constraint primitives between the frames of two bodies.

A joint states its equations once, at the given initial positions of the bodies; it has no state of the motion:

    class Revolute(Joint):
        def equations(self, attachments):
            yield Equation(Coincide, (attachments.point(self.a), attachments.point(self.b)))
            ...

`AttachmentTable` turns points and axes of frames into indices of attached vectors. The axes of a joint are those of its
first frame; the second body has the axis that coincides with it at the given initial positions.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torchmbd.errors import HintedKeywords, InputError
from torchmbd.fem.elements.beam_line import varying_nodes
from torchmbd.fixed_arguments import FixedArguments
from torchmbd.math.variable import Numbers, ParameterVector
from torchmbd.multibody.bodies.frame import Frame, axis_index
from torchmbd.multibody.bodies.interpolation import InterpolationConstraint
from torchmbd.multibody.bodies.rigid import same_body
from torchmbd.multibody.bodies.stiffening import turned_arm

_LEAST_ARM = 0.1  # rad, as that of `common_axis`: deformations of a body turn its axes by less


class Equation(NamedTuple):
    """One primitive: its kind, the indices of its vectors, and its own data (a length or a law)."""

    kind: type
    vectors: tuple[int, ...]
    data: Any = None


@dataclass(frozen=True, eq=False)
class Attached:
    """A vector attached to a body: a point or an axis, in the axes of the undeformed body.

    vector    of design variables, their first values
    varying   place of a frame whose design variables it follows, as in Frame; None: it is constant
    axis      letter of the axis of this frame; of a point, none
    matrix    from axes of the body of this frame to those of `body`; None: they are the same body
    """

    body: Any
    vector: Tensor
    interpolation: InterpolationConstraint | None
    is_point: bool
    varying: Numbers | None = None
    axis: str = ""
    matrix: Tensor | None = None

    @property
    def varies(self) -> bool:
        """True if it depends on the design."""
        on_nodes = self.is_point and self.interpolation is not None and varying_nodes(self.body.mesh)
        return on_nodes or self.varying is not None

    @property
    def key(self) -> tuple:
        """Key that is equal for equal vectors."""
        axis = self.axis if self.varying is not None else ""
        return id(self.body), self.interpolation, self.is_point, tuple(self.vector.tolist()), id(self.varying), axis

    def now(self) -> Tensor:
        """The vector in the present design [*lanes, 3]."""
        if self.varying is not None and self.is_point:
            return self.varying().point()
        if self.varying is not None:
            axis = self.varying().triad()[..., axis_index(self.axis)]
            return axis if self.matrix is None else (self.matrix @ axis[..., None])[..., 0]
        if self.interpolation is None or not self.varies:
            return self.vector
        return (
            self.vector
            + self.interpolation.center(self.body.places())
            - self.interpolation.center(self.body.mesh.nodes - self.body.origin)
        )

    def modal_rows(self, psi: Tensor) -> Tensor:
        """Derivative of the vector by the modal coordinates [..., 3, modes], out of mode shapes psi [..., nodes, 6, modes]."""
        if self.interpolation is None:
            return torch.zeros_like(psi[..., 0, :3, :])
        x = self.body.mesh.nodes - self.body.origin
        moved = self.interpolation.motion(x, psi)
        lever = self.vector - self.interpolation.center(x) if self.is_point else self.now()
        turned = torch.linalg.cross(*torch.broadcast_tensors(moved[..., 3:, :], lever[..., :, None]), dim=-2)
        return moved[..., :3, :] + turned if self.is_point else turned

    def quadratic_rows(self, psi: Tensor, psi2: Tensor, nodes: Sequence[int]) -> Tensor:
        """Second derivative of the vector by the modal coordinates [..., 3, modes, modes], symmetric.

        psi2   displacements and rotations of second order (bodies/stiffening.py) of `nodes` [..., k, 6, modes, modes]
        nodes  k nodes, among which are those of the interpolation
        """
        if self.interpolation is None:
            return psi2.new_zeros(*psi2.shape[:-4], 3, *psi2.shape[-2:])
        x = self.body.mesh.nodes - self.body.origin
        members = list(self.interpolation.nodes)
        index = [list(nodes).index(k) for k in members]
        local = InterpolationConstraint(tuple(range(len(index))), self.interpolation.weights)
        moved = local.motion(x[members], psi2[..., index, :, :, :].flatten(-2)).unflatten(-1, psi2.shape[-2:])
        lever = self.vector - self.interpolation.center(x) if self.is_point else self.now()
        turn = moved[..., 3:, :, :]
        turned = torch.linalg.cross(*torch.broadcast_tensors(turn, lever[..., :, None, None]), dim=-3)
        turned = turned + turned_arm(self.interpolation.motion(x, psi)[..., 3:, :], lever)
        return moved[..., :3, :, :] + turned if self.is_point else turned


@dataclass
class AttachmentTable:
    """Collects the attached vectors of all joints and forces; equal ones are stored once."""

    vectors: list[Attached] = field(default_factory=list)
    _index: dict[tuple, int] = field(default_factory=dict)

    def _add(
        self,
        body: Any,
        vector: Tensor,
        interpolation: InterpolationConstraint | None,
        is_point: bool,
        varying: Numbers | None = None,
        axis: str = "",
        matrix: Tensor | None = None,
    ) -> int:
        if varying is not None and axis and not varying.record.turns:
            varying = None
        return self.add(Attached(body, vector, interpolation, is_point, varying, axis, matrix))

    def add(self, attached: Attached) -> int:
        """Index of an attached vector."""
        if attached.key not in self._index:
            self._index[attached.key] = len(self.vectors)
            self.vectors.append(attached)
        return self._index[attached.key]

    def point(self, frame: Frame) -> int:
        """Index of the frame's point."""
        return self._add(frame.body, frame.present_point, frame.interpolation, True, frame.varying)

    def axis(self, frame: Frame, axis: str) -> int:
        """Index of an axis of the frame."""
        return self._add(frame.body, frame.axis(axis), frame.interpolation, False, frame.varying, axis)

    def coincident_axis(self, frame: Frame, axis: str, other: Frame) -> int:
        """Index of the axis on the other body that coincides with an axis of the first frame at the given positions."""
        matrix = other.body.axes.T @ frame.body.axes
        vector = other.body.axes.T @ (frame.body.axes @ frame.axis(axis))
        return self._add(other.body, vector, other.interpolation, False, frame.varying, axis, matrix)

    def turning_axes(self, name: str, a: Frame, b: Frame, axis: str) -> tuple[int, int, int]:
        """Indices of three axes: x and y of frame a, which follow `axis`, and x of frame b. The angle is from x of a to x of b.

        Raises InputError if x of b is within 0.1 rad of `axis` at the given positions, because the angle is then undefined.
        """
        x, y = other_axes(axis)
        arm = b.body.axes @ b.axis(x)
        if float(torch.linalg.cross(a.body.axes @ a.axis(axis), arm).norm()) < _LEAST_ARM:
            raise InputError(
                (name, "b"),
                allowed=f"a frame whose {x} axis is perpendicular to the axis {axis!r} of {a!r}",
                noun=f"{b!r} of {name!r}",
                state=f"has its {x} axis along the axis of the joint, but the angle is measured from this {x} axis",
                hint="axes=..., of the frame: body.at(point, axes=...)",
            )
        return self.axis(a, x), self.axis(a, y), self.axis(b, x)

    def coincident_point(self, frame: Frame, other: Frame) -> int:
        """Index of the point on the other body that coincides with the point of the first frame at the given positions."""
        varying = any(f.interpolation is not None and varying_nodes(f.body.mesh) for f in (frame, other))
        if frame.varying is not None or varying:
            raise InputError(
                "frame",
                frame,
                "must have constant coordinates and axes",
                state="has coordinates or axes that vary, but the displacement is measured from its given position",
                noun=f"{frame!r}",
            )
        for body in (frame.body, other.body):
            if isinstance(body.position, nn.Parameter):
                raise InputError(
                    (body.name, "position"),
                    allowed="a position without a gradient",
                    state=f"is a Parameter, but a displacement is measured from the given positions of {frame!r} and {other!r}",
                )
        ground = frame.body.position + frame.body.axes @ frame.point
        return self._add(other.body, other.body.axes.T @ (ground - other.body.position), other.interpolation, True)


@dataclass(frozen=True, eq=False)
class JointCoordinate:
    """The angle of b from a about the axis of a joint [rad], or its travel along it [m], from the given initial positions.

    joint   with frames a and b and an axis of frame a
    turns   whether it is the angle
    """

    joint: Any
    turns: bool

    def vectors(self, attachments: AttachmentTable) -> tuple[int, int, int]:
        """Indices of its vectors: axes x and y of a and x of b, or the points of a and b and the axis."""
        a, b, axis = self.joint.a, self.joint.b, self.joint.axis
        if not self.turns:
            return attachments.coincident_point(b, a), attachments.point(b), attachments.axis(a, axis)
        x, y = other_axes(axis)
        return attachments.axis(a, x), attachments.axis(a, y), attachments.coincident_axis(a, x, b)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, JointCoordinate) and other.joint is self.joint and other.turns == self.turns

    def __hash__(self) -> int:
        return hash((id(self.joint), self.turns))

    def __repr__(self) -> str:
        return f"{self.joint.name}.{'angle' if self.turns else 'travel'}"


class Joint(FixedArguments, HintedKeywords):
    """Base of all joints: two frames on two different bodies, and a name."""

    def __init__(self, a: Frame, b: Frame, name: str | None = None):
        kind = type(self).__name__
        for key, frame in (("a", a), ("b", b)):
            if not isinstance(frame, Frame):
                raise InputError(key, frame, "must get frames, such as body.at(...)", state=f"got {frame!r}", noun=kind)
        if same_body(a.body, b.body):
            raise InputError(
                "b", b, "must join frames on two different bodies", state=f"joins {a!r} with {b!r}", noun=kind
            )
        if name is not None and not isinstance(name, str):
            raise InputError("name", name, "a string", noun=f"name of a {kind}")
        self.a, self.b = a, b
        self.name = name or f"{kind.lower()}_{a.body.name}_{b.body.name}"

    def equations(self, attachments: AttachmentTable) -> Iterator[Equation]:
        """Yield the primitives of the joint."""
        raise NotImplementedError(type(self).__name__)

    @property
    def frames(self) -> tuple[Frame, ...]:
        """Both frames; of a coupling, those of all joints that it couples."""
        return self.a, self.b

    @property
    def joints(self) -> tuple[Joint, ...]:
        """Other joints that it couples."""
        return ()

    @property
    def variables(self) -> ParameterVector | None:
        """Design variables, parameters of the system by the joint's name; None: there are none."""
        return None

    def common_axis(self, axis: str) -> str:
        """The letter of an axis of frame a, checked: a second frame with axes of its own must have it in the same direction, to
        0.1 rad. On the second body joints use `coincident_axis`."""
        axis_index(axis)
        a, b = self.a, self.b
        axis_a, axis_b = a.body.axes @ a.axis(axis), b.body.axes @ b.axis(axis)
        if not torch.equal(b.axes, torch.eye(3, dtype=torch.float64)) and float((axis_a - axis_b).norm()) > 0.1:
            raise InputError(
                (self.name, "axes"),
                allowed="must give the same direction",
                state=f"contradict each other, because at the given positions {axis!r} is {_shown(axis_a)} "
                f"by {a!r} and {_shown(axis_b)} by {b!r}",
                hint="no axes on the second frame",
            )
        return axis

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.a!r}, {self.b!r})"


def _shown(direction: Tensor) -> str:
    return f"({', '.join(f'{x:.3g}' for x in direction.tolist())})"


def other_axes(axis: str) -> tuple[str, str]:
    """The two axes that follow an axis in the right-handed order: "x" -> ("y", "z")."""
    k = axis_index(axis)
    return "xyz"[(k + 1) % 3], "xyz"[(k + 2) % 3]


def as_frame(x: Any) -> Frame:
    """A frame as it is, or the frame at the origin of a body, for joints that need directions only."""
    if isinstance(x, Frame):
        return x
    if hasattr(x, "mesh"):
        return x.at(x.reference)
    if hasattr(x, "at"):
        return x.at()
    raise InputError("frame", x, "must get a body or a frame, such as body.at(...)", state=f"got {x!r}", noun="joint")
