"""Steered fibers: laminates whose angles vary over a mesh, limits on the paths of their fibers, and pictures of these."""

from torchmbd.extensions.fibers.field import FiberField
from torchmbd.extensions.fibers.figure import fiber_paths
from torchmbd.extensions.fibers.measures import FiberCurvature, FiberDivergence
from torchmbd.extensions.fibers.steered_laminate import SteeredLaminate

__all__ = ["FiberCurvature", "FiberDivergence", "FiberField", "SteeredLaminate", "fiber_paths"]
