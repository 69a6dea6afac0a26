"""Steered fibers: laminates whose angles vary over a mesh, limits on the paths of their fibers, and pictures of these.

>>> sheet = mbd.mesh.rectangle(0.3, 0.2, cells=(6, 4))
>>> field = mbd.fibers.FiberField(sheet, (3, 3))  # angles at 3 x 3 controls
"""

from torchmbd.extensions.fibers.field import FiberField
from torchmbd.extensions.fibers.figure import fiber_paths
from torchmbd.extensions.fibers.measures import FiberCurvature, FiberDivergence
from torchmbd.extensions.fibers.steered_laminate import SteeredLaminate

__all__ = ["FiberCurvature", "FiberDivergence", "FiberField", "SteeredLaminate", "fiber_paths"]


def __dir__() -> list[str]:
    return [*__all__]
