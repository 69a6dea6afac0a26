"""The element of each kind of cell (strains.py defines what an element is)."""

from __future__ import annotations

from collections.abc import Callable

from torchmbd.fem.elements.facet import Facets
from torchmbd.fem.elements.quad import quad_strains
from torchmbd.fem.elements.strains import Strains
from torchmbd.fem.elements.triangle import triangle_strains
from torchmbd.fem.materials import IsotropicMean

ELEMENTS: dict[str, Callable[[Facets, IsotropicMean], Strains]] = {
    "triangle": triangle_strains,
    "quad": quad_strains,
}
