"""A laminated body as nodes, cells, stacks and materials: what files of other programs are written from.

    ShellModel.of(body)     numbers of the present design, SI units and radians

Checked in tests/extensions/shell_models/test_write_model.py.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import Any

import numpy as np

from torchmbd.errors import InputError
from torchmbd.fem.materials import Laminate, Ply
from torchmbd.math.variable import without_variables
from torchmbd.multibody.bodies import FlexibleBody


@dataclass(frozen=True, eq=False)
class Stack:
    """The layers of a part, from the bottom; `materials` are indices; `bottom` is the height of the lowest face [m]."""

    name: str
    angles: list[float]
    thickness: list[float]
    materials: list[int]
    bottom: float


@dataclass(frozen=True, eq=False)
class ShellModel:
    """Cells are triangles, then quadrilaterals.

    nodes      positions in mesh axes [n, 3] [m]
    cells      corners of each cell
    stack      index of the stack of each cell
    axes       x, y axis and normal of the laminate in each cell [cells, 3, 3]
    reference  nodes that the body's frame is fixed to
    """

    name: str
    nodes: np.ndarray
    cells: list[list[int]]
    stack: np.ndarray
    axes: np.ndarray
    stacks: list[Stack]
    materials: list[Ply]
    reference: list[int]

    @classmethod
    def of(cls, body: FlexibleBody) -> ShellModel:
        """Make the model; InputError for a body that has more than laminated shells."""
        if body.given_structure is not None or not body.plates:
            raise InputError(
                (body.name,),
                hint="body.save_matrices",
                noun=f"body {body.name!r}",
                allowed="made of laminates",
                state="has no shells",
            )
        others = body.parts.keys() - body.plates.keys()
        if others or body.links:
            names = ", ".join(sorted(others)) or "rigid or linked nodes"
            raise InputError(
                (body.name,),
                hint="body.save_matrices",
                noun=f"body {body.name!r}",
                allowed="made of shells alone",
                state=f"has {names}",
            )
        mesh = body.mesh
        cells = [*mesh.triangles.tolist(), *mesh.quads.tolist()]
        stack, axes = np.full(len(cells), -1), np.zeros((len(cells), 3, 3))
        stacks: list[Stack] = []
        materials: dict[Any, Ply] = {}
        for k, (name, part) in enumerate(body.plates.items()):
            members = part.matrices.members.numpy()
            if bool((stack[members] >= 0).any()):
                raise InputError(
                    (body.name, name),
                    noun=f"part {name!r} of {body.name!r}",
                    allowed="must have its own",
                    state="shares cells with another part",
                )
            stack[members], axes[members] = k, part.matrices.axes.numpy()
            stacks.append(_stack(f"{body.name}.{name}", name, part.laminates[0], materials))
        if bool((stack < 0).any()):
            raise InputError(
                (body.name,),
                noun=f"body {body.name!r}",
                allowed="must have a laminate for each cell",
                state="has cells without a laminate",
            )
        return cls(
            body.name, mesh.nodes.numpy(), cells, stack, axes, stacks, list(materials.values()), list(body.reference)
        )


def _stack(full_name: str, name: str, laminate: Laminate, materials: dict[Any, Ply]) -> Stack:
    """The stack of a laminate; its plies are entered into `materials` by their numbers."""
    if type(laminate) is not Laminate or laminate.field is not None:
        kind = type(laminate).__name__
        raise InputError((full_name,), allowed="a mbd.Laminate of plies", state=f"is a {kind} or varies over the mesh")
    if laminate.angles.dim() > 1:
        raise InputError(
            (full_name,),
            hint="one design",
            allowed="must have one",
            state=f"has {laminate.angles.shape[0]} designs at once",
        )
    numbers = []
    for layer in laminate.layer_plies:
        ply = _constant(layer)
        numbers.append(list(materials).index(key) if (key := astuple(ply)) in materials else len(materials))
        materials.setdefault(key, ply)
    angles, thickness = (x.detach().tolist() for x in (laminate.layer_angles, laminate.layer_thickness))
    return Stack(name, angles, thickness, numbers, float(laminate.faces.detach()[0, 0]))


def _constant(layer: Any) -> Ply:
    """The ply with the present values of its variables."""
    ply = without_variables(layer)
    E1, E2, G12, G13, G23 = (float(x) for x in (ply.E1, ply.E2, ply.G12, ply.G13, ply.G23))
    expansion = [None if x is None else float(x) for x in (ply.alpha1, ply.alpha2)]
    return Ply(E1, E2, G12, G13, G23, float(ply.nu12), float(ply.density), ply.strength, float(ply.loss), *expansion)
