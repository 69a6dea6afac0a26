"""A flexible body with more vibration modes, or on a finer mesh, to see what its modes and its mesh leave out.

    n' = max(n + 2, 3 n / 2)     modes at least; at most as many as the mesh has. n: modes that a design retains

The interface of Craig-Bampton stays as it is. The span of the modes contains the one before.
The finer mesh has twice as many cells in each direction: plates and straight beams, of the same modes, on the same flat cells
and straight lines. Nodes keep their numbers, so that frames and responses are at the same places. Clamped and rigid sets take
the new nodes between theirs; mean motions stay those of the same nodes.
Checked in tests/diagnosis/test_richer.py, tests/multibody/bodies/test_finer_mesh.py.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch

from torchmbd.fem.elements import BeamLine, Beams, Plates
from torchmbd.fem.elements.beam_line import Straight, varying_nodes
from torchmbd.fem.mesh import Mesh
from torchmbd.fem.mesh.refinement import Middles, refined
from torchmbd.multibody.bodies.frame import set_modal_start
from torchmbd.multibody.bodies.interfaces import Interface
from torchmbd.multibody.bodies.interpolation import node_indices
from torchmbd.multibody.bodies.reduced import matrices

MORE, LEAST = 1.5, 2  # times the vibration modes, and at least so many more
MOST = 5_000  # nodes of a mesh that is refined: four times as many have the factor of a minute
_OF_START = ("velocity", "angular_velocity")  # buffers or parameters of the start that the mesh does not change


def has_reduction(body: Any) -> bool:
    """True if the modes of a flexible body were chosen here: not given by the user, nor by another program."""
    return hasattr(body if body.given_structure is None else body.given_structure, "reduction")


def enrich(body: Any, modes: int) -> bool:
    """Give a flexible body of so many modes that has a reduction more; False: it has all modes of its mesh, and nothing was
    changed.

    Its modal start is zero afterwards. Damping ratios of the further modes are that of the last one.
    """
    structure = body.given_structure
    with torch.no_grad():
        K, M = matrices(body.assembly) if structure is None else structure.pencil()
        before = body.reduction if structure is None else structure.reduction
        kept, most = max(before.n, modes - before.kept), K.size - before.kept
        n = min(max(kept + LEAST, math.ceil(MORE * kept)), most)
        if n <= kept:
            return False
        reduction = replace(before, n=n)
        if structure is None:
            vars(body)["reduction"] = reduction
        else:
            structure.keep(reduction)
        vars(body)["modes"] = reduction(K, M).stiffness.shape[-1]
    set_modal_start(body, None, None)
    return True


def obstacle(body: Any) -> str:
    """Why the mesh of a flexible body cannot be refined, "" where it can."""
    if body.given_structure is not None:
        return "it has matrices, and no mesh of elements"
    links = body.arguments[2]
    if len(body.mesh.nodes) > MOST:
        return f"its mesh has {len(body.mesh.nodes)} nodes, and up to {MOST} are refined"
    if type(body.mesh) is Mesh and not len(body.mesh.lines):
        flat = all(isinstance(part, Plates) and part.laminates[0].field is None for part in body.parts.values())
        return "" if flat and not links else "it has links, or parts that are not plates of equal plies"
    if isinstance(body.mesh, BeamLine) and body.mesh.middles is None:
        if varying_nodes(body.mesh) and not isinstance(body.mesh.node_module, Straight):
            return "its nodes vary one by one"
        even = all(isinstance(x, Beams) and torch.as_tensor(x.arguments[2]).ndim < 2 for x in body.parts.values())
        return "" if even and not links else "it has links, or elements that are twisted"
    return "its mesh has arcs, lines, or elements that are neither plates nor beams"


def refine(body: Any) -> None:
    """Put a flexible body without an obstacle on the finer mesh; its modal start is zero afterwards."""
    mesh, parts, middles = _refined_line(body) if isinstance(body.mesh, BeamLine) else _refined_plates(body)

    def on_mesh(item: Any) -> Interface:
        item = item if isinstance(item, Interface) else Interface(item)
        nodes = node_indices(body.mesh, item.nodes)
        return replace(item, nodes=middles.with_middles(nodes) if item.rigid and len(nodes) > 1 else nodes)

    reduction, interface, _, rigid = body.arguments
    if isinstance(interface, Mapping):
        interface = {key: on_mesh(item) for key, item in interface.items()}
    elif isinstance(interface, Interface):
        interface = [on_mesh(interface)]
    elif isinstance(interface, (list, tuple)) and any(isinstance(x, Interface) for x in interface):
        interface = [on_mesh(x) if isinstance(x, Interface) else node_indices(body.mesh, x)[0] for x in interface]
    else:
        interface = node_indices(body.mesh, interface)
    finer = type(body)(
        body.name,
        mesh,
        parts,
        body.reduction.n,
        body.position,
        body.axes,
        reference=middles.with_middles(body.reference) if len(body.reference) > 1 else list(body.reference),
        reduction=reduction,
        interface=interface,
        updated=body.reduction.updated,
        rigid=[middles.with_middles(node_indices(body.mesh, nodes)) for nodes in rigid],
        stiffening=body.stiffening is not None,
        expansion=body.expansion_zones,
    )
    finer.damping = body.damping
    for name in _OF_START:
        setattr(finer, name, getattr(body, name))
    finer.velocities_given = body.velocities_given
    body.__dict__.clear()
    body.__dict__.update(finer.__dict__)


def _refined_plates(body: Any) -> tuple[Mesh, dict[str, Any], Middles]:
    mesh, parents, middles = refined(body.mesh)
    return mesh, {name: part.on_mesh(mesh, parents) for name, part in body.parts.items()}, middles


def _refined_line(body: Any) -> tuple[BeamLine, dict[str, Any], Middles]:
    line = body.mesh
    middles = Middles.of([line.elements], torch.empty(0, 4, dtype=torch.long), len(line.nodes))
    start, end = line.elements.T
    between = middles.of_sides(start, end)
    elements = torch.stack([torch.stack([start, between], 1), torch.stack([between, end], 1)], 1).flatten(0, 1)
    nodes: Any = middles.nodes(line.nodes)
    if varying_nodes(line):
        nodes = Straight(line.node_module.length, middles.nodes(line.node_module._unit))
    finer = BeamLine(nodes, elements, line.node_sets)
    parents = torch.arange(len(line.elements)).repeat_interleave(2).tolist()
    return finer, {name: part.on_line(finer, parents) for name, part in body.parts.items()}, middles
