"""Frames on bodies: the virtual bodies of the paper.

Joints and forces act on frames only: a point and axes attached to a body of any kind. The massless rigid body of the paper
(section 2.2, refs. 24-25), fixed rigidly to a node of a flexible body, is eliminated by the chain rule: with b the position of
the node in the undeformed body, psi_t, psi_r the translation and rotation rows of its modes, w the modal coordinates, and e an
axis of the frame,

    point  r + A (b + psi_t w + (psi_r w) x d)          axis  A (e + (psi_r w) x e)

so both are *vectors attached to a body*: a constant part plus a map of the modal coordinates. d is the arm from the
node to the point. A frame on several nodes takes their mean motion for psi (interpolation.py).
Assumed: elastic rotations are small (linear floating-frame theory).
Checked in tests/physics/test_virtual_bodies.py, tests/multibody/bodies/test_interpolation.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from torchmbd.errors import InputError, Path
from torchmbd.math.checked_numbers import parameter
from torchmbd.math.gradients import refuse_gradients
from torchmbd.math.rigid_motion import exponential
from torchmbd.math.variable import Numbers, is_variable, number, stacked
from torchmbd.multibody.bodies.interpolation import InterpolationConstraint

_SHOWN = 6  # nodes that a frame without a name lists


class Body(Protocol):
    """What a frame needs of its body."""

    name: str
    position: Tensor
    axes: Tensor


@dataclass(frozen=True, eq=False)
class Frame:
    """A point and a triad of axes attached to a body; made by `body.at(...)`.

    point           position in the undeformed body, in body axes [3] [m]; of design variables, their first values
    axes            columns: the axes of the frame in body axes [3, 3]; of design variables, their first values
    interpolation   mesh nodes whose motion the frame takes; None on a rigid body
    varying         point and axes as a module (Numbers of Place) where numbers of them are design variables; else None

    >>> body = mbd.RigidBody("tool", 0.2, (1e-4, 1e-4, 1e-4))
    >>> frame = body.at(0.02, 0, 0, axes=[[0, -1, 0], [1, 0, 0], [0, 0, 1]])  # columns: its x is the body's y
    >>> frame.axis("x").tolist()
    [0.0, 1.0, 0.0]
    """

    body: Any
    point: Tensor
    axes: Tensor = field(default_factory=lambda: torch.eye(3, dtype=torch.float64))
    interpolation: InterpolationConstraint | None = None
    varying: Numbers | None = None

    def __post_init__(self) -> None:
        if not all(hasattr(self.body, name) for name in ("name", "position", "axes", "at")):
            raise InputError("body", self.body, "a body or the ground, as body.at(...) has it", noun="body of a Frame")
        refuse_gradients(f"a frame on {self.body.name!r}", (self.point, self.axes))
        object.__setattr__(self, "point", vector((self.body.name, "point"), self.point))
        object.__setattr__(self, "axes", rotation((self.body.name, "axes"), self.axes))
        if hasattr(self.body, "mesh") != isinstance(self.interpolation, InterpolationConstraint) or not isinstance(
            self.interpolation, (InterpolationConstraint, type(None))
        ):
            allowed = "nodes of its mesh, as body.at(...) mounts it" if hasattr(self.body, "mesh") else "None"
            raise InputError(
                "interpolation", self.interpolation, allowed, noun=f"interpolation of a Frame on {self.body.name!r}"
            )

    @property
    def present_point(self) -> Tensor:
        """The point in the present design [3], without a gradient."""
        return self.point if self.varying is None else self.varying().point().detach()

    def axis(self, name: str) -> Tensor:
        """Unit vector "x", "y" or "z" of the frame in the present design, in body axes [3], without a gradient."""
        k = axis_index(name)
        return self.axes[:, k] if self.varying is None else self.varying().triad()[..., k].detach()

    def __repr__(self) -> str:
        if self.interpolation is None:
            where = ", ".join(f"{float(x):.6g}" for x in self.present_point)
        else:
            where = _nodes_shown(self.body, self.interpolation)
        return f"{self.body.name}.at({where})"


def _nodes_shown(body: Any, interpolation: InterpolationConstraint) -> str:
    """The name of an interface or a node set of these nodes with equal weights; else the nodes, or how many there are."""
    nodes = interpolation.nodes
    if interpolation == InterpolationConstraint.on(nodes):
        sets = {name: constraint.nodes for name, constraint in getattr(body, "interfaces", {}).items()}
        sets |= {name: members for name, members in body.mesh.node_sets.items() if name not in sets}
        for name, members in sets.items():
            if sorted(map(int, members)) == sorted(nodes):
                return repr(name)
    if len(nodes) == 1:
        return f"node {nodes[0]}"
    return f"nodes {list(nodes)}" if len(nodes) <= _SHOWN else f"{len(nodes)} nodes, {min(nodes)} to {max(nodes)}"


@dataclass(frozen=True)
class Place:
    """A point of a body [m], and a triad: `axes` turned by a rotation vector in their own axes [rad]; in axes of the body."""

    axes: Tensor
    x: Any
    y: Any
    z: Any
    turn_x: Any = 0.0
    turn_y: Any = 0.0
    turn_z: Any = 0.0

    def point(self) -> Tensor:
        """[*lanes, 3]."""
        return stacked((self.x, self.y, self.z))

    def triad(self) -> Tensor:
        """Columns: the axes of the frame in body axes [*lanes, 3, 3]."""
        return self.axes @ exponential(stacked((self.turn_x, self.turn_y, self.turn_z)))

    @property
    def turns(self) -> bool:
        """True if the axes are design variables."""
        return any(map(is_variable, (self.turn_x, self.turn_y, self.turn_z)))


def frame_at(body: Any, coordinates: Sequence[Any], axes: Sequence | Tensor | None, turn: Sequence[Any]) -> Frame:
    """A frame at a point in body axes [m], turned by a rotation vector [rad]; InputError names the argument.

    Coordinates and components of the rotation vector may be design variables.
    """
    allowed = "three finite numbers, or mbd.variable(...) of one"
    if any(isinstance(x, (tuple, list)) or (isinstance(x, Tensor) and x.dim() > 0) for x in coordinates):
        raise InputError((body.name, "point"), coordinates[0], allowed, "at(x, y, z), or at(*point) of a tuple")
    point, vector_of_turn = (
        _three_numbers(label, x, allowed)
        for label, x in (((body.name, "point"), coordinates), ((body.name, "turn"), turn))
    )
    if float(vector_of_turn.norm()) > math.pi:
        raise InputError((body.name, "turn"), turn, "a rotation vector of at most pi", shown=f"{turn!r} rad")
    triad = rotation("axes", axes)
    varying = Numbers(Place(triad, *coordinates, *turn)) if any(map(is_variable, (*coordinates, *turn))) else None
    return Frame(body, point, triad @ exponential(vector_of_turn), varying=varying)


def _three_numbers(name: Path, x: Any, allowed: str) -> Tensor:
    if not isinstance(x, (tuple, list, Tensor)) or (isinstance(x, Tensor) and x.dim() != 1) or len(x) != 3:
        raise InputError(name, x, allowed)
    result = read_numbers(name, [number(y) for y in x], allowed)
    if result.shape != (3,) or not bool(torch.isfinite(result).all()):
        raise InputError(name, x, allowed)
    return result


def axis_index(name: str) -> int:
    """Index of an axis letter; InputError for anything else than x, y, z."""
    if not isinstance(name, str) or name not in ("x", "y", "z"):
        raise InputError("axis", name, "'x', 'y', 'z' (an axis of the first frame)")
    return "xyz".index(name)


def read_numbers(name: str | Path, x: Any, allowed: str) -> Tensor:
    """Read numbers of any shape as a tensor of their own; InputError names the argument."""
    refuse_gradients(name, x, allowed)
    try:
        return torch.as_tensor(x, dtype=torch.float64).detach().clone()
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(name, x, allowed) from error


def vector(name: str | Path, x: Sequence[float] | Tensor) -> Tensor:
    """Read three finite numbers as a vector [3]; InputError names the argument."""
    result = read_numbers(name, x, "three finite numbers")
    if result.shape != (3,) or not bool(torch.isfinite(result).all()):
        raise InputError(name, x, "three finite numbers")
    return result


def vector_or_parameter(name: str | Path, x: Sequence[float] | Tensor) -> Tensor:
    """A `vector`, or a Parameter [3] as it is: a design variable."""
    result = vector(name, x.detach() if isinstance(x, nn.Parameter) else x)
    return parameter(name, x) if isinstance(x, nn.Parameter) else result


def register(module: nn.Module, name: str, x: Tensor | None) -> None:
    """Register x as a parameter of the module if it is a Parameter, else as a buffer, in the place of an earlier x."""
    if name in module._parameters or name in module._buffers:
        delattr(module, name)
    (module.register_parameter if isinstance(x, nn.Parameter) else module.register_buffer)(name, x)  # pyright: ignore[reportCallIssue, reportArgumentType]


def rotation(name: str | Path, axes: Sequence | Tensor | None) -> Tensor:
    """Read a rotation matrix [3, 3]: columns are the axes of the body or frame; None is the identity."""
    if axes is None:
        return torch.eye(3, dtype=torch.float64)
    A = read_numbers(name, axes, "a 3 x 3 rotation matrix with the axes as columns")
    if A.shape != (3, 3):
        raise InputError(
            name, A, "a 3 x 3 rotation matrix with the axes as columns", state=f"has shape {tuple(A.shape)}"
        )
    error = float((A.T @ A - torch.eye(3, dtype=torch.float64)).abs().max())
    if not error < 1e-9 or float(torch.linalg.det(A)) < 0:
        raise InputError(
            name,
            allowed="must have orthonormal columns that form a right-handed triad",
            state=f"is not a rotation (|A'A - 1| = {error:.1e}, det A = {float(torch.linalg.det(A)):.3f})",
        )
    return A


def identifier(kind: str, name: str) -> str:
    """Check a name that becomes part of parameter names."""
    if not isinstance(name, str) or not name.isidentifier():
        raise InputError("name", name, "a Python identifier, such as 'rod_2'", noun=f"name of the {kind}")
    if name == "ground":
        raise InputError("name", name, "another name, because mbd.Ground() has this one", noun=f"name of the {kind}")
    return name


def set_start(
    body: Any,
    position: Sequence[float] | Tensor,
    axes: Sequence | Tensor | None,
    velocity: Sequence[float] | Tensor | None = None,
    angular_velocity: Sequence[float] | Tensor | None = None,
) -> None:
    """Set the approximate initial pose and velocities of a body; Parameters are design variables."""
    register(body, "position", vector_or_parameter((body.name, "position"), position))
    register(body, "axes", rotation((body.name, "axes"), axes))
    set_velocities(body, velocity, angular_velocity)


VELOCITIES = ("velocity", "angular_velocity")
MODAL = ("modal", "modal_velocity")  # of flexible bodies


def set_velocities(
    body: Any, velocity: Sequence[float] | Tensor | None, angular_velocity: Sequence[float] | Tensor | None
) -> None:
    """Set the initial velocities of a body; None: zero, which joints and other bodies may change (system/initial.py)."""
    for key, x in zip(VELOCITIES, (velocity, angular_velocity), strict=True):
        register(body, key, vector_or_parameter((body.name, key), (0.0, 0.0, 0.0) if x is None else x))
    body.velocities_given = tuple(x is not None for x in (velocity, angular_velocity))


def set_modal_start(body: Any, *start_values: Sequence[float] | Tensor | None) -> None:
    """Set the initial modal coordinates and rates of a flexible body, of at least the modes that every design retains; None:
    zero."""
    counts = body.mode_counts
    allowed = f"{counts[0]} finite numbers, one for each mode, or a torch.nn.Parameter"
    for key, x in zip(MODAL, start_values, strict=True):
        name = (body.name, key)
        plain = (
            x.detach()
            if isinstance(x, nn.Parameter)
            else torch.zeros(counts[0], dtype=torch.float64)
            if x is None
            else x
        )
        values = read_numbers(name, plain, allowed)
        if values.dim() != 1 or len(values) not in counts or not bool(torch.isfinite(values).all()):
            raise InputError(name, x, allowed)
        register(body, key, parameter(name, x) if isinstance(x, nn.Parameter) else values)
    body.modal_start_given = any(x is not None for x in start_values)


def has_modal_start(body: Any) -> bool:
    """True if a flexible body starts bent, or with modal rates: by set_modal_start, or by numbers that were loaded since."""
    return body.modal_start_given or any(bool(getattr(body, key).any()) for key in MODAL)


def given_velocities(body: Any) -> list[bool]:
    """True if a body was given a velocity, and an angular velocity."""
    present = (getattr(body, key) for key in VELOCITIES)
    return [flag or bool(x.any()) for flag, x in zip(body.velocities_given, present, strict=True)]
