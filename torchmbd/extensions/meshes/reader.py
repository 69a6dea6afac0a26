"""A laminated shell on the mesh of a file.

Checked in tests/extensions/meshes/test_read_mesh.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from torchmbd.extensions.meshes.mesh_file import mesh_file
from torchmbd.extensions.meshes.zones import zone_parts
from torchmbd.fem.materials import Laminate
from torchmbd.multibody.bodies import FlexibleBody
from torchmbd.multibody.bodies.unit_checks import warn_units


def read_mesh(
    path: str | Path,
    name: str,
    laminate: Laminate | Mapping[str, Laminate],
    modes: int = 8,
    scale: float | str = 1.0,
    direction: Sequence[float] | Tensor = (1.0, 0.0, 0.0),
    mass: str = "lumped",
    **options: Any,
) -> FlexibleBody:
    """A laminated shell on a mesh of another program: gmsh, Abaqus, VTK (by meshio).

    path        the file
    name        of the body
    laminate    one for all, or one for each named zone of the file
    modes       number of vibration modes
    scale       meters per unit of the file, or its name: "mm", "cm", "in", "ft"
    direction   the laminate's x-axis in mesh axes, projected into each cell: [3], or one for each [m, 3]
    mass        "lumped", or "consistent", for comparison
    options     position, axes, damping, reference, reduction, interface, updated, stiffening: as in `FlexibleBody.plate`
    Raises InputError that names the file. Warns if size, density or speed of sound is implausible.

    >>> from importlib.util import find_spec
    >>> laminate = mbd.Laminate(mbd.examples.carbon(), mbd.deg([45, -45]), thickness=1e-3)
    >>> with open("plate.vtk", "w") as file:
    ...     _ = file.write("# vtk DataFile Version 4.2\\na plate\\nASCII\\nDATASET UNSTRUCTURED_GRID\\nPOINTS 4 double\\n"
    ...                    "0 0 0 400 0 0 400 100 0 0 100 0\\nCELLS 2 8\\n3 0 1 2\\n3 0 2 3\\nCELL_TYPES 2\\n5\\n5\\n")
    >>> if find_spec("meshio"):
    ...     body = mbd.io.read_mesh("plate.vtk", "plate", laminate, modes=2, scale="mm")
    """
    file = mesh_file(path, scale)
    body = FlexibleBody(name, file.mesh, zone_parts(file, laminate, direction, mass), modes, **options)
    warn_units(name, file.mesh, body.plates.values(), body.structure)
    return body
