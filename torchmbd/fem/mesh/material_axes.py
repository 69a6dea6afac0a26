"""Material directions of shells that are not flat: axes of a coordinate system at each cell, projected into it by the plate.

    rectangular    e1, e2, e3                  columns of `axes`
    cylindrical    e_r, e_theta, e_z           z is the third column, theta from the first
    along          tangent of the nearest point of a curve, normal of the cell x tangent

A rule may be a mapping, as an experiment file has it: {"around": {"axis": [0, 0, 1]}}.
The direction is the first of the axes, from the one that is named, that is not normal to the cell: a rib across a cylinder has
no direction around it and takes the next axis of the system.
Lengths in m; all in mesh axes. Constants: a direction has no gradient with respect to the nodes of the mesh.
Source: the material coordinate system MCID of Nastran.
Checked in tests/fem/mesh/test_material_axes.py.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError, argument_names, unknown
from torchmbd.fem.mesh.mesh import Mesh
from torchmbd.math.checked_numbers import reals

_NORMAL = 0.05  # sine of the angle between an axis and a cell's normal (3 degrees) below which the next axis is taken
_KINDS = {"rectangular": "xyz", "cylindrical": ("r", "theta", "z")}


@dataclass(frozen=True, eq=False)
class MaterialAxes:
    """A rule for `direction` of plates: made by `around`, `along` and `in_system`.

    axes_at   centers [m, 3] and normals [m, 3] of cells -> their axes in the order in which they are tried [m, k, 3]
    """

    axes_at: Callable[[Tensor, Tensor], Tensor]

    def of_cells(self, mesh: Mesh) -> Float[Tensor, "m 3"]:
        """Directions of all cells of a mesh, unit vectors. Raises InputError if no axis lies in a cell."""
        centers = torch.cat([mesh.nodes.detach()[corners].mean(1) for corners in mesh.cells.values()])
        normals = mesh.normals.detach()
        axes = self.axes_at(centers, normals)
        in_plane = axes - (axes * normals[:, None]).sum(2, keepdim=True) * normals[:, None]
        good = in_plane.norm(dim=2) > _NORMAL
        if not bool(good.any(1).all()):
            k = int((~good.any(1)).nonzero()[0])
            raise InputError(
                "direction",
                hint="a direction for each cell [m, 3]",
                state=f"has no axis in {mesh.cell_name(k)}, center {centers[k].tolist()}, which lies on the axis of the system",
            )
        first = good.double().argmax(1)
        return axes[torch.arange(len(axes)), first]


def rule_of(mapping: Mapping[str, Any]) -> MaterialAxes:
    """Return the rule that a mapping names, with its arguments: {"along": {"points": ...}}; InputError for others."""
    rules: dict[str, Callable[..., MaterialAxes]] = {"around": around, "along": along, "in_system": in_system}
    if len(mapping) != 1 or not isinstance(next(iter(mapping.values())), Mapping):
        raise InputError("direction", dict(mapping), "one rule with its arguments, such as around: {axis: ...}")
    [(name, arguments)] = mapping.items()
    if name not in rules:
        raise unknown("direction", name, rules)
    for key in arguments:
        if key not in (names := argument_names(rules[name])):
            raise InputError(("direction", name, key), key, names, noun=f"argument of {name}")
    first = argument_names(rules[name])[0]  # the others have defaults
    if first not in arguments:
        raise InputError(("direction", name, first), allowed="given", state="is missing")
    return rules[name](**arguments)


def in_system(
    axes: Sequence[Sequence[float]] | Tensor,
    origin: Sequence[float] | Tensor = (0.0, 0.0, 0.0),
    kind: str = "rectangular",
    axis: str | None = None,
) -> MaterialAxes:
    """Directions along an axis of a coordinate system, as MCID of Nastran; default: its first axis.

    axes   columns, orthonormal [3, 3];  kind: "rectangular" with axes x, y, z, "cylindrical" with r, theta, z
    """
    A, center = reals("axes", axes), reals("origin", origin)
    if A.shape != (3, 3) or not torch.allclose(A.mT @ A, torch.eye(3, dtype=A.dtype), atol=1e-6):
        raise InputError("axes", axes, "three orthonormal columns [3, 3]")
    if center.shape != (3,):
        raise InputError("origin", origin, "three numbers [m]")
    if kind not in _KINDS:
        raise unknown("kind", kind, list(_KINDS))
    names = _KINDS[kind]
    if axis is not None and axis not in names:
        raise unknown("axis", axis, list(names))
    first = 0 if axis is None else tuple(names).index(axis)

    def axes_at(x: Tensor, n: Tensor) -> Tensor:
        triads = A.mT.expand(len(x), 3, 3)
        if kind == "cylindrical":
            arm = (x - center) @ A  # in the axes of the system
            radial = torch.nn.functional.normalize(arm * arm.new_tensor([1.0, 1.0, 0.0]), dim=1) @ A.mT
            along = A[:, 2].expand_as(radial)
            triads = torch.stack([radial, torch.linalg.cross(along, radial), along], 1)
        return triads.roll(-first, 1)

    return MaterialAxes(axes_at)


def around(axis: Sequence[float] | Tensor, point: Sequence[float] | Tensor = (0.0, 0.0, 0.0)) -> MaterialAxes:
    """Directions around an axis [3] through a point [3] [m], right-handed; where a cell is normal to them, along the axis.

    >>> plate = mbd.mesh.rectangle(0.2, 0.1, (2, 2))
    >>> mbd.mesh.around((0, 0, 1), (0.0, -1.0, 0.0)).of_cells(plate).shape
    torch.Size([4, 3])
    """
    z = reals("axis", axis)
    if z.shape != (3,) or not float(z.norm()) > 0.0:
        raise InputError("axis", axis, "three numbers, not all zero")
    z = z / z.norm()
    x = torch.eye(3, dtype=z.dtype)[int(z.abs().argmin())]
    x = torch.nn.functional.normalize(x - (x @ z) * z, dim=0)
    return in_system(torch.stack([x, torch.linalg.cross(z, x), z], 1), point, "cylindrical", "theta")


def along(points: Sequence[Sequence[float]] | Tensor) -> MaterialAxes:
    """Directions along a curve through points [k, 3] [m]: the tangent of its nearest segment."""
    p = reals("points", points)
    if p.dim() != 2 or p.shape[1:] != (3,) or len(p) < 2 or not bool(((p[1:] - p[:-1]).norm(dim=1) > 0.0).all()):
        raise InputError(
            "points",
            noun="points of a curve",
            allowed="must have shape [k, 3] with k > 1, without equal points in sequence",
            state=f"have shape {tuple(p.shape)}",
        )

    def axes_at(x: Tensor, n: Tensor) -> Tensor:
        d = p[1:] - p[:-1]
        share = (((x[:, None] - p[:-1]) * d).sum(2) / (d * d).sum(1)).clamp(0.0, 1.0)
        distance = (x[:, None] - p[:-1] - share[..., None] * d).norm(dim=2)
        tangent = torch.nn.functional.normalize(d, dim=1)[distance.argmin(1)]
        return torch.stack([tangent, torch.linalg.cross(n, tangent)], 1)

    return MaterialAxes(axes_at)
