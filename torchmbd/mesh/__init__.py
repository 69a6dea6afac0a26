"""Meshes of triangles, quadrilaterals and lines, and their generators."""

from torchmbd.mesh.mesh import Mesh, Pieces
from torchmbd.mesh.mesh_checks import directed_area
from torchmbd.mesh.quads import cut_quads
from torchmbd.mesh.rectangle import rectangle

__all__ = ["Mesh", "Pieces", "cut_quads", "directed_area", "rectangle"]
