"""Pressure: a uniform load on the area of a plate or shell.

    f_k = p a_k        a_k = sum over the triangles at node k of a third of their (directed) area; of
                           quadrilaterals the mean of both ways to cut them (mesh.py)

Along the normals the load follows the body. The forces on nodes along axis i of the body, of one sign, act as one force p N_i,
N_i the sum of their areas, on the mean motion of the nodes (multibody/bodies/interpolation.py). So the resultant, the moment
about the undeformed nodes and the modal forces are exact; normals turn with that mean, not one by one.
The areas are those of the mesh that the body has when the system is joined, so that a finer mesh has a finer load.
Checked in tests/multibody/forces/test_pressure.py.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.mesh import Mesh, directed_area
from torchmbd.multibody.bodies.frame import Frame, vector
from torchmbd.multibody.bodies.rigid import Ground
from torchmbd.multibody.forces.action import Push
from torchmbd.multibody.forces.force import Applied, ForceElement
from torchmbd.multibody.forces.laws import Scaled, check_law
from torchmbd.multibody.joints.joint import AttachmentTable

_ZERO = 1e-12  # share of the largest component of area that counts as none


Part = tuple[Frame, str, float]  # of the load: frame on its nodes, axis, and area along the axis [m2]


class Pressure(ForceElement):
    """`Pressure(body, p)` [Pa] along the normals of the mesh, or `Pressure(body, p, direction=(0, 0, -1))`.

    body       a flexible body with triangles or quadrilaterals
    pressure   a number, or a torch function of time, [] [s] -> [] [Pa]; a design variable "NAME.pressure" as
               mbd.variable(5e3), "NAME.factor" as mbd.forces.Scaled(mbd.variable(1.0), function)
    direction  constant direction of the load, in ground axes [3]; its length does not matter
    name       of the element, and of its design variables

    >>> laminate = mbd.Laminate(mbd.examples.carbon(), mbd.deg([0, 90]), thickness=1e-3)
    >>> wing = mbd.FlexibleBody.plate("wing", mbd.mesh.rectangle(0.5, 0.1, (4, 2)), laminate, 2, reference="left_edge")
    >>> hold = mbd.Fixed(mbd.Ground().at(-0.25, 0, 0), wing.at("left"))
    >>> system = mbd.System([wing], [hold], [mbd.Pressure(wing, 100.0)])
    >>> motion = mbd.simulate(system, 0.1, steps=40)
    >>> bool(mbd.Max(mbd.Displacement("wing", "z", node="right"))(motion) > 0)
    True
    """

    def __init__(
        self,
        body: Any,
        pressure: float | Tensor | Callable[[Tensor], Tensor] | Scaled,
        direction: Sequence[float] | Tensor | None = None,
        name: str | None = None,
    ):
        mesh = getattr(body, "mesh", None)
        if not isinstance(mesh, Mesh) or mesh.cell_count == 0:
            raise InputError(
                "body",
                body,
                "must act on a flexible body with triangles or quadrilaterals",
                state=f"acts on {body!r}",
                noun="Pressure",
            )
        self.body, self.pressure, self.direction = body, pressure, direction
        super().__init__((self.parts[0][0],), name or f"pressure_{body.name}")
        for _, _, area in self.parts:
            self._law(area)

    @property
    def parts(self) -> list[Part]:
        """The parts of the load on the present mesh of the body."""
        mesh = self.body.mesh
        nodes, share, _ = mesh.covering_triangles
        area = share[:, None] * directed_area(mesh.nodes[nodes])
        return list(_following(self.body, area) if self.direction is None else _fixed(self.body, area, self.direction))

    def actions(self, attachments: AttachmentTable) -> Iterator[Applied]:
        for frame, axis, area in self.parts:
            along = attachments.axis(Ground().at() if self.direction is not None else frame, axis)
            yield Applied(Push, (attachments.point(frame), along), self._law(area))

    def _law(self, area: float) -> Any:
        """The force [N] on an area [m2] as a law."""
        return check_law(self.name, self.law_variables.law_of_time(self.pressure, "pressure", area))


def _following(body: Any, area: Tensor) -> Iterator[Part]:
    """Parts along the axes of the body, out of the directed areas of the mesh's pieces [m, 3]."""
    nodal = _at_nodes(body, area)
    small = _ZERO * float(nodal.abs().sum(0).max())
    for axis, column in zip("xyz", nodal.T, strict=True):
        for sign in (1.0, -1.0):
            nodes = torch.nonzero(sign * column > small)[:, 0].tolist()
            if nodes:
                weights = (sign * column[nodes]).tolist()
                yield body.at(nodes, weights=weights), axis, sign * sum(weights)


def _fixed(body: Any, area: Tensor, direction: Sequence[float] | Tensor) -> Iterator[Part]:
    """Parts along the axes of the ground."""
    u = vector("direction", direction)
    if not bool(u.any()):
        raise InputError("direction", direction, "three numbers that are not all zero")
    nodal = _at_nodes(body, area.norm(dim=1, keepdim=True))[:, 0]
    nodes = torch.nonzero(nodal)[:, 0].tolist()
    frame = body.at(nodes, weights=nodal[nodes].tolist())
    for axis, share in zip("xyz", (u / u.norm()).tolist(), strict=True):
        if share:
            yield frame, axis, share * float(nodal.sum())


def _at_nodes(body: Any, area: Tensor) -> Tensor:
    """Areas of nodes [n, k]: a third of the areas [m, k] of the pieces around each."""
    nodal = area.new_zeros(len(body.mesh.nodes), area.shape[1])
    return nodal.index_add(0, body.mesh.covering_triangles.nodes.T.flatten(), (area / 3.0).repeat(3, 1))
