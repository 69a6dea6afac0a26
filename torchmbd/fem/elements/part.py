"""The interface of the parts of an assembly (assembly.py)."""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

from jaxtyping import Float, Int
from torch import Tensor, nn

from torchmbd.fem.elements.geometric import StressedCells
from torchmbd.math.sparse import Pattern


class MassPoints(NamedTuple):
    """Point masses [kg] and rotary inertias [kg m2] at the middles of node pairs; a pair (k, k) is node k.

    arm: from there to the point [m], rigid, in mesh axes; it may depend on the design. None: no arms, in any design
    """

    ends: Int[Tensor, "points 2"]
    mass: Float[Tensor, "*lanes points"]
    rotary: Float[Tensor, "*lanes points"]
    arm: Float[Tensor, "*lanes points 3"] | None = None


@runtime_checkable
class Part(Protocol):
    """A part of an assembly. `pattern`: of its stiffness, size 6 * nodes of the mesh."""

    @property
    def pattern(self) -> Pattern: ...

    def values(self, entries: Int[Tensor, " k"] | None = None) -> Float[Tensor, "*lanes nnz"]:
        """K of the present design on the pattern, or only some entries of it."""
        ...

    def stressed(self, motion: Float[Tensor, "*lanes n 6 k"]) -> list[StressedCells]:
        """Its cells under the stress of k motions of all nodes (geometric.py); none for a part without stiffness."""
        ...

    def masses(self) -> MassPoints:
        """Masses of the present design."""
        ...

    def modules(self) -> dict[str, nn.Module]:
        """Modules whose parameters are design variables: the body registers them under these names."""
        ...


@runtime_checkable
class LosingPart(Part, Protocol):
    """A part whose plies may have loss factors."""

    @property
    def loses(self) -> bool:
        """Whether one of them has."""
        ...

    def loss_values(self, entries: Int[Tensor, " k"] | None = None) -> Float[Tensor, "*lanes nnz"]:
        """The derivative of `values` where the moduli of each ply grow by its loss factor."""
        ...
