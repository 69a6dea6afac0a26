"""Meshes, modes and motions for ParaView: VTU files, and a PVD file that lists them with their times.

    save_mesh(body, "rod.vtu")            the undeformed mesh, with the zone and x-axis of the laminates, and
                                          the fibers of each layer
    save_modes(body, "modes.vtu")         one vector field for each mode: warp by it
    save_motion(motion, "motion.pvd")     every body at every frame; the frames lie in a folder beside it

Fields of a motion: "displacement" (elastic, ground axes), and a failure index of the plies on the cells if a
criterion is asked for. Rigid bodies are lines through their joints.
Format: XML, numbers inline in base64 (little endian, 8 bytes of length before them), no compression. Nothing but NumPy:
meshio would save some twenty lines of these, and make every picture for ParaView need an extra.
Source: The VTK User's Guide, "VTK File Formats" (XML, unstructured grid).
Checked in tests/extensions/test_paraview.py.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
import torch

from torchmbd.errors import InputError
from torchmbd.fem.elements import BeamLine
from torchmbd.multibody.bodies import FlexibleBeam, FlexibleBody
from torchmbd.multibody.bodies.flexible_beam import BeamNode
from torchmbd.results.ply_history import PlyHistory
from torchmbd.viz.animation import require_lane, require_motion, spread_frames

__all__ = ["save_mesh", "save_modes", "save_motion"]

_TYPES = {"float64": "Float64", "int64": "Int64", "uint8": "UInt8"}
_LINE, _TRIANGLE, _QUAD = 3, 5, 9  # VTK's numbers of cells


def save_mesh(body: Any, path: str | Path) -> Path:
    """Write the undeformed mesh of a flexible body, or a mesh; body axes with the mesh's own origin. Returns the path.

    path  the VTU file

    >>> mbd.viz.save_mesh(mbd.mesh.rectangle(0.5, 0.05, (4, 2)), "plate.vtu").name
    'plate.vtu'
    """
    mesh = getattr(body, "mesh", body)
    fields = {}
    plates = getattr(body, "plates", {})
    if plates:
        zone, axis = np.full(_cell_count(mesh), -1, dtype=np.int64), np.zeros((_cell_count(mesh), 3))
        for k, part in enumerate(plates.values()):
            zone[part.matrices.members], axis[part.matrices.members] = k, part.matrices.axes[:, 0]
        fields = {"laminate": zone, "laminate_x": axis} | _fibers(mesh, plates.values())
    return write_vtu(path, mesh.nodes, _cells(mesh), cell_data=fields)


def _fibers(mesh: Any, plates: Iterable[Any]) -> dict[str, np.ndarray]:
    """Direction of the fibers of each layer from the bottom, "fiber_1", ...; zero where a cell has fewer layers."""
    fields: dict[str, np.ndarray] = {}
    for part in plates:
        for k, direction in enumerate(part.fibers()):
            field = fields.setdefault(f"fiber_{k + 1}", np.zeros((_cell_count(mesh), 3)))
            field[part.matrices.members] = direction
    return fields


def save_modes(body: Any, path: str | Path) -> Path:
    """Write the modes of a flexible body as vector fields "mode_1_12.3Hz", ..., normalized to the size of the body.

    path  the VTU file, which is returned

    >>> mbd.viz.save_modes(mbd.examples.arm().body("arm"), "arm.vtu").name
    'arm.vtu'
    """
    with torch.no_grad():
        structure = body.structure()
    values, turn = torch.linalg.eigh(structure["Kr"])
    shapes = (structure["psi"] @ turn)[:, :3]
    size = float((body.mesh.nodes.amax(0) - body.mesh.nodes.amin(0)).norm())
    fields = {}
    for k, value in enumerate(values.tolist()):
        shape = shapes[..., k]
        name = f"mode_{k + 1}_{math.sqrt(max(value, 0.0)) / (2 * math.pi):.4g}Hz"
        fields[name] = 0.1 * size / float(shape.norm(dim=-1).max()) * shape
    return write_vtu(path, body.mesh.nodes, _cells(body.mesh), fields)


def save_motion(
    motion: Any, path: str | Path, lane: int = 0, max_frames: int = 200, criterion: str | None = None
) -> Path:
    """Write the motion of one lane.

    path        of the .pvd file to open; frames go to a folder of its name
    max_frames  of more time points every n-th is kept
    criterion   failure index to be written on the cells: "tsai_wu", "tsai_wu_irf", "max_stress"; None: none

    >>> motion = mbd.simulate(mbd.examples.arm(), 0.1, steps=4)
    >>> mbd.viz.save_motion(motion, "arm.pvd", criterion="tsai_wu").name
    'arm.pvd'
    """
    path = Path(path)
    if path.suffix != ".pvd":
        raise InputError("path", str(path), "a name that ends in .pvd")
    require_motion(motion)
    motion = motion.detach()
    require_lane(motion, lane)
    frames = spread_frames(motion, max_frames)
    folder = path.with_suffix("")
    folder.mkdir(parents=True, exist_ok=True)
    entries = []
    for part, body in enumerate((*motion.system.bodies, *motion.system.beams)):
        if isinstance(body, BeamNode):
            continue  # drawn with its beam
        flexible = isinstance(body, FlexibleBody | FlexibleBeam)
        frame = _flexible(motion, body, lane, criterion) if flexible else _rigid(motion, body, lane)
        if frame is None:
            continue
        for number, index in enumerate(frames.tolist()):
            points, cells, point_data, cell_data = frame(index)
            file = write_vtu(folder / f"{body.name}_{number:05d}.vtu", points, cells, point_data, cell_data)
            where = quoteattr(f"{folder.name}/{file.name}")
            time = float(motion.t[index])
            entries.append(f'<DataSet timestep="{time:.17g}" part="{part}" name={quoteattr(body.name)} file={where}/>')
    head = '<?xml version="1.0"?>\n<VTKFile type="Collection" version="1.0" byte_order="LittleEndian">\n<Collection>\n'
    path.write_text(head + "\n".join(entries) + "\n</Collection>\n</VTKFile>\n", encoding="utf-8")
    return path


def write_vtu(
    path: str | Path,
    points: Any,
    cells: list[tuple[int, Any]],
    point_data: Mapping[str, Any] | None = None,
    cell_data: Mapping[str, Any] | None = None,
) -> Path:
    """Write one unstructured grid: points [n, 3], cells as (VTK type, nodes [k, corners]), fields by name."""
    path = Path(path)
    if path.suffix != ".vtu":
        raise InputError("path", str(path), "a name that ends in .vtu")
    blocks = [(kind, np.asarray(nodes, dtype=np.int64)) for kind, nodes in cells if len(nodes)]
    connectivity = np.concatenate([nodes.ravel() for _, nodes in blocks])
    offsets = np.cumsum(np.concatenate([np.full(len(nodes), nodes.shape[1]) for _, nodes in blocks]))
    types = np.concatenate([np.full(len(nodes), kind, dtype=np.uint8) for kind, nodes in blocks])
    x = np.asarray(points, dtype=np.float64)
    lines = [
        '<?xml version="1.0"?>',
        '<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian" header_type="UInt64">',
        f'<UnstructuredGrid><Piece NumberOfPoints="{len(x)}" NumberOfCells="{len(types)}">',
        f"<Points>{_array('points', x)}</Points>",
        f"<Cells>{_array('connectivity', connectivity)}{_array('offsets', offsets)}{_array('types', types)}</Cells>",
        f"<PointData>{''.join(_array(name, f) for name, f in (point_data or {}).items())}</PointData>",
        f"<CellData>{''.join(_array(name, f) for name, f in (cell_data or {}).items())}</CellData>",
        "</Piece></UnstructuredGrid></VTKFile>\n",
    ]
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def _array(name: str, values: Any) -> str:
    array = np.ascontiguousarray(values.detach() if isinstance(values, torch.Tensor) else values)
    if array.dtype.kind == "i":
        array = array.astype(np.int64)
    if array.dtype.name not in _TYPES:
        array = array.astype(np.float64)
    raw = array.astype(array.dtype.newbyteorder("<")).tobytes()
    text = base64.b64encode(len(raw).to_bytes(8, "little") + raw).decode("ascii")
    width = f' NumberOfComponents="{array.shape[1]}"' if array.ndim == 2 else ""
    return (
        f'<DataArray type="{_TYPES[array.dtype.name]}" Name={quoteattr(name)}{width} format="binary">{text}</DataArray>'
    )


def _cells(mesh: Any) -> list[tuple[int, Any]]:
    """Return the cells by VTK type: plates in the order of their numbers, then lines."""
    if isinstance(mesh, BeamLine):
        return [(_LINE, mesh.elements)]
    return [(_TRIANGLE, mesh.triangles), (_QUAD, mesh.quads), (_LINE, mesh.lines)]


def _cell_count(mesh: Any) -> int:
    return sum(len(nodes) for _, nodes in _cells(mesh))


def _flexible(motion: Any, body: Any, lane: int, criterion: str | None) -> Any:
    view, cells = motion.body(body.name), _cells(body.mesh)
    with torch.no_grad():
        nodes = view.nodes[lane]
        u = torch.einsum("tij,tnj->tni", view.A[lane], view.displacements[lane])
        plies = PlyHistory(motion, body.name) if criterion and getattr(body, "plates", None) else None

    def frame(index: int) -> tuple:
        fields = {}
        if plies is not None and criterion is not None:
            with torch.no_grad():
                values = plies.indices(criterion, slice(index, index + 1))[lane, 0]
            worst = torch.zeros(_cell_count(body.mesh), dtype=torch.float64)
            fields[criterion] = worst.scatter_reduce(0, plies.points[:, 0], values, "amax")
        return nodes[index], cells, {"displacement": u[index]}, fields

    return frame


def _rigid(motion: Any, body: Any, lane: int) -> Any:
    """Return a function of frames: lines from the origin of a rigid body to its joints; None for a body without joints."""
    sides = [side for joint in motion.system.joints for side in (joint.a, joint.b) if side.body.name == body.name]
    if not sides:
        return None
    local = torch.stack([torch.zeros(3, dtype=torch.float64), *(side.point for side in sides)])
    view = motion.body(body.name)
    cells = [(_LINE, np.stack([np.zeros(len(sides)), np.arange(1, len(sides) + 1)], axis=1))]

    def frame(index: int) -> tuple:
        return view.r[lane, index] + local @ view.A[lane, index].T, cells, {}, {}

    return frame
