"""The element of each kind of cell (strains.py tells what an element is)."""

from __future__ import annotations

from collections.abc import Callable

from torchmbd.elements.facet import Facets
from torchmbd.elements.quad import quad_strains
from torchmbd.elements.strains import Strains
from torchmbd.elements.triangle import triangle_strains
from torchmbd.materials import IsotropicMean

ELEMENTS: dict[str, Callable[[Facets, IsotropicMean], Strains]] = {
    "triangle": triangle_strains,
    "quad": quad_strains,
}
