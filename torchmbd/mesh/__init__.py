"""Meshes of triangles and their generators."""

from torchmbd.mesh.mesh import Mesh
from torchmbd.mesh.rectangle import rectangle

__all__ = ["Mesh", "rectangle"]
