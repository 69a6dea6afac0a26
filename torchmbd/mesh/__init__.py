"""Meshes of triangles, quadrilaterals and lines, their generators and readers."""

from torchmbd.mesh.bulk_cards import Card, read_cards
from torchmbd.mesh.bulk_data import Bar, BulkData
from torchmbd.mesh.bulk_mesh import BulkMesh, bulk_mesh
from torchmbd.mesh.mesh import Mesh, Pieces
from torchmbd.mesh.mesh_checks import directed_area
from torchmbd.mesh.mesh_file import MeshFile, read_mesh
from torchmbd.mesh.quads import cut_quads
from torchmbd.mesh.rectangle import rectangle

__all__ = [
    "Bar", "BulkData", "BulkMesh", "Card", "Mesh", "MeshFile", "Pieces", "bulk_mesh", "cut_quads", "directed_area",
    "read_cards", "read_mesh", "rectangle",
]  # fmt: skip
