"""Meshes of triangles, quadrilaterals and lines, and their generators.

>>> mbd.mesh.rectangle(length=0.5, width=0.05, cells=(8, 2))
Mesh(27 nodes, 0 triangles, 16 quadrilaterals, 0 lines)
"""

from torchmbd.fem.mesh.material_axes import MaterialAxes, along, around, in_system
from torchmbd.fem.mesh.mesh import CoveringTriangles, Mesh, NodeCloud
from torchmbd.fem.mesh.mesh_checks import directed_area
from torchmbd.fem.mesh.quads import cut_quads
from torchmbd.fem.mesh.rectangle import rectangle

__all__ = [
    "CoveringTriangles",
    "MaterialAxes",
    "Mesh",
    "NodeCloud",
    "along",
    "around",
    "cut_quads",
    "directed_area",
    "in_system",
    "rectangle",
]


def __dir__() -> list[str]:
    return [*__all__]
