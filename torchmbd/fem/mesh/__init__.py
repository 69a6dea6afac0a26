"""Meshes of triangles, quadrilaterals and lines, and their generators."""

from torchmbd.fem.mesh.mesh import Mesh, Pieces
from torchmbd.fem.mesh.mesh_checks import directed_area
from torchmbd.fem.mesh.quads import cut_quads
from torchmbd.fem.mesh.rectangle import rectangle

__all__ = ["Mesh", "Pieces", "cut_quads", "directed_area", "rectangle"]
