"""Laminated shells on meshes of other programs: gmsh, Abaqus, VTK and others, by meshio."""

from torchmbd.extensions.meshes.reader import read_mesh

__all__ = ["read_mesh"]
