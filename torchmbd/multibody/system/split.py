"""A beam as a chain of flexible bodies, each with its own floating frame: large bending by small displacements of each body.

Every piece is fixed to the end of the piece before it. Displacements in its frame, and the errors of linear elasticity, fall
with its length. Errors at the interfaces add up along the chain: a triad that turns by 1 + ~phi has the error
1/2 phi x (phi x e), so n pieces that bend in two planes or twist have n (1/n)^2. Pieces therefore have stiffening, whose second
order turns triads by 1 + ~phi + 1/2 ~phi ~phi and shortens lines (bodies/stiffening.py): errors fall with 1/n^2.
Checked in tests/convergence/test_split.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn

from torchmbd.errors import InputError
from torchmbd.fem.elements import BeamLine, Beams
from torchmbd.math.checked_numbers import is_whole
from torchmbd.multibody.bodies import FlexibleBody
from torchmbd.multibody.bodies.frame import Frame, given_velocities, has_modal_start
from torchmbd.multibody.bodies.interpolation import node_indices
from torchmbd.multibody.joints import Fixed


@dataclass(frozen=True, eq=False)
class Chain:
    """The result of `split`.

    bodies   the pieces from the start of the line to its end; they share sections, whose parameters have the first piece's name
    joints   fixed joints between neighboring pieces
    starts   first node of each piece in the whole line
    line     the whole line

    >>> steel = mbd.Ply.isotropic(E=210e9, nu=0.3, density=7850.0)
    >>> tube = mbd.sections.tube(0.02, steel, [0.0], 1e-3)
    >>> arm = mbd.FlexibleBody.beam("arm", mbd.BeamLine.straight(2.0, 8), tube)
    >>> chain = mbd.split(arm, 4)
    >>> [body.name for body in chain.bodies], chain.at("end")
    (['arm_0', 'arm_1', 'arm_2', 'arm_3'], arm_3.at('end'))
    """

    bodies: tuple[FlexibleBody, ...]
    joints: tuple[Fixed, ...]
    starts: tuple[int, ...]
    line: BeamLine

    def at(
        self, node: str | int, axes: Sequence | Tensor | None = None, offset: Sequence[float] | Tensor = (0.0, 0.0, 0.0)
    ) -> Frame:
        """Return a frame on a node of the whole line, as `FlexibleBody.at` does.

        Two pieces share the node between them; its frame is on the first of the two.
        """
        nodes = node_indices(self.line, node)
        if len(nodes) != 1:
            raise InputError("node", node, "one node", state=f"is {node!r}, {len(nodes)} nodes of a chain")
        piece = max(k for k, first in enumerate(self.starts) if k == 0 or first < nodes[0])
        return self.bodies[piece].at(nodes[0] - self.starts[piece], axes, offset)


def split(body: FlexibleBody, n: int, modes: int = 1, interface: str | int | Sequence[str | int] = ()) -> Chain:
    """A beam as a chain of n flexible bodies with about equal numbers of elements, for large bending.

    body        made by `FlexibleBody.beam` of one line without branches; the chain has its position, axes and damping. Joints
                and forces act on the pieces: `chain.at("end")`
    n           number of pieces, at most one for each element
    modes       of each piece, besides the six constraint modes of its end; a piece of few elements may have fewer
    interface   other nodes of the line that joints or forces act on: six constraint modes each
    Displacements converge with 1/n^2. Raises InputError for other bodies.

    >>> steel = mbd.Ply.isotropic(E=210e9, nu=0.3, density=7850.0)
    >>> tube = mbd.sections.tube(0.02, steel, [0.0], 1e-3)
    >>> arm = mbd.FlexibleBody.beam("arm", mbd.BeamLine.straight(2.0, 8), tube)
    >>> chain = mbd.split(arm, 4)
    >>> clamp = mbd.Fixed(mbd.Ground().at(), chain.at("start"))
    >>> system = mbd.System(chain.bodies, [clamp, *chain.joints])
    >>> len(system.bodies)
    4
    """
    line = _line(body)
    count = len(line.elements)
    if not is_whole(n) or not 1 <= n <= count:
        raise InputError("n", n, f"1 to {count}, the elements of {body.name!r}")
    if not is_whole(modes) or modes < 0:
        raise InputError("modes", modes, "0, 1, 2, ...")
    bounds = [round(k * count / n) for k in range(n + 1)]
    nodes = interface if isinstance(interface, (list, tuple)) else [interface]
    interface_nodes = {k for node in nodes for k in node_indices(line, node)}
    pieces = tuple(_piece(body, line, k, modes, ends, interface_nodes) for k, ends in enumerate(pairwise(bounds)))
    joints = tuple(Fixed(a.at("end"), b.at("start")) for a, b in pairwise(pieces))
    return Chain(pieces, joints, tuple(bounds[:-1]), line)


def _line(body: Any) -> BeamLine:
    """The line of a body; InputError for a body that cannot be split."""
    allowed = "a body of FlexibleBody.beam, before it is moved or bent"
    if not isinstance(body, FlexibleBody):
        raise InputError("body", body, allowed, noun="body of split")
    if not all(isinstance(part, Beams) for part in body.parts.values()) or not body.parts or body.links:
        raise InputError((body.name,), allowed=allowed, noun=f"body {body.name!r}", state="of split is not a beam")
    if any(given_velocities(body)) or has_modal_start(body) or isinstance(body.position, nn.Parameter):
        raise InputError(
            (body.name,),
            allowed=allowed,
            noun=f"body {body.name!r}",
            state="has an initial velocity, initial modal coordinates or a variable position",
        )
    if body.damping.ratios is not None or body.damping.rate != 0.0:
        raise InputError(
            (body.name,),
            allowed="damped in proportion to stiffness (damping=...), for split",
            noun=f"body {body.name!r}",
            state="has damping ratios, or a rate",
        )
    line: BeamLine = body.mesh
    chain = torch.arange(len(line.nodes))
    if line.node_module is not None or not torch.equal(line.elements, torch.stack([chain[:-1], chain[1:]], 1)):
        raise InputError(
            (body.name, "line"),
            allowed="a chain of elements from each node to the next, for split",
            state="has branches, or nodes that are design variables",
        )
    return line


def _piece(
    body: FlexibleBody, line: BeamLine, k: int, modes: int, ends: tuple[int, int], interface_nodes: set[int]
) -> FlexibleBody:
    """Piece k: the elements between two end nodes as a body whose frame is fixed to the first; interface_nodes: of the line."""
    first, last = ends
    sets = {
        name: [i - first for i in members if first <= i <= last]
        for name, members in line.node_sets.items()
        if name not in ("start", "end")
    }
    sets = {name: members for name, members in sets.items() if members} | {"start": [0], "end": [last - first]}
    middles = None if line.middles is None else line.middles[first:last]
    pairs = torch.stack([torch.arange(last - first), torch.arange(1, last - first + 1)], 1)
    mesh = BeamLine(line.nodes[first : last + 1], pairs, sets, middles)
    parts = {key: part.on_line(mesh, range(first, last)) for key, part in body.beams.items()}
    position = body.position + body.axes @ (line.nodes[first] - body.origin)
    inner = sorted(i - first for i in interface_nodes if first < i < last)
    free = 6 * (last - first - 1 - len(inner))
    modes, reduction = (
        (min(modes, free), {"reduction": "craig-bampton", "interface": (*inner, "end")})
        if free
        else (6 * (last - first), {})  # all vibration modes: there are no other freedoms than those of the interface
    )
    return FlexibleBody(
        f"{body.name}_{k}",
        mesh,
        {key: part for key, part in parts.items() if part is not None},
        modes,
        position,
        body.axes,
        reference="start",
        damping=body.damping.time,
        stiffening=True,
        **reduction,
    )
