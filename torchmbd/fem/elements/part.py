"""The interface of the parts of an assembly (assembly.py), and the parts that are numbers: constant elements, point masses.

    K = sum over elements of their matrices at their degrees of freedom 6 * node + i

Degrees of freedom that no part of a body gives stiffness or mass to, such as rotations of nodes of solids, are left out by
the assembly. Checked in tests/fem/elements/test_assembly.py, tests/extensions/nastran/test_elements.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from torchmbd.errors import InputError
from torchmbd.fem.elements.geometric import StressedCells
from torchmbd.fem.mesh import Mesh
from torchmbd.math.gradients import constant_arguments
from torchmbd.math.sparse import Pattern

#: Kind of change -> its unit.
#:
#:     temperature   change of the temperature at the nodes
#:     gradient      change of the temperature per meter, along the normal of a plate or the z-axis of a section
#:     gradient_y    change of the temperature per meter, along the y-axis of a section
#:     moisture      change of the moisture, a share of the mass
CHANGES = {"temperature": "K", "gradient": "K/m", "gradient_y": "K/m", "moisture": "-"}


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
        """True if one of them has."""
        ...

    def loss_values(self, entries: Int[Tensor, " k"] | None) -> Float[Tensor, "*lanes nnz"]:
        """The derivative of `values` where the moduli of each ply grow by its loss factor."""
        ...


@runtime_checkable
class ExpandingPart(Part, Protocol):
    """A part that expands with temperature or moisture; `changes`: the kinds of change that it knows, of `CHANGES`."""

    changes: ClassVar[tuple[str, ...]]

    def expansion_forces(self, change: str) -> Float[Tensor, "*lanes n 6"]:
        """Forces and moments on all nodes that cause the free expansion by a unit change [N, N m per unit].

        Raises InputError for a ply, or a section, without the coefficient.
        """
        ...

    def stressed(self, motion: Float[Tensor, "*lanes n 6 k"], change: str | None = None) -> list[StressedCells]:
        """Its cells under the stress of k motions, less that of the free strains of a unit change."""
        ...


class GivenElements:
    """Elements of constant stiffness and lumped masses.

    mesh      its nodes have the degrees of freedom
    freedoms  of each element, 6 * node + i; those of different numbers of freedoms as several groups
    matrices  their stiffness [N/m, N, N m], symmetric, for each group
    nodes     nodes with mass, and their masses [kg]
    mass      of each of these
    """

    def __init__(
        self,
        mesh: Any,
        freedoms: list[Int[Tensor, "m k"]],
        matrices: list[Float[Tensor, "m k k"]],
        nodes: Int[Tensor, " points"] | None = None,
        mass: Float[Tensor, " points"] | None = None,
    ) -> None:
        rows = torch.cat([f[:, :, None].expand(-1, -1, f.shape[1]).flatten() for f in freedoms])
        cols = torch.cat([f[:, None, :].expand(-1, f.shape[1], -1).flatten() for f in freedoms])
        values = torch.cat([K.flatten() for K in matrices])
        kept = values != 0.0
        self.pattern, position = Pattern.gather(rows[kept], cols[kept], 6 * len(mesh.nodes))
        self._values = torch.zeros(self.pattern.nnz, dtype=torch.float64).index_add(0, position, values[kept])
        self._nodes = torch.zeros(0, dtype=torch.long) if nodes is None else nodes
        self._mass = torch.zeros(0, dtype=torch.float64) if mass is None else mass

    def values(self, entries: Int[Tensor, " k"] | None = None) -> Float[Tensor, " nnz"]:
        """K, or only some entries of it."""
        return self._values if entries is None else self._values[entries]

    def stressed(self, motion: Float[Tensor, "*lanes n 6 k"]) -> list[StressedCells]:
        """InputError: a matrix of numbers has no stress."""
        raise InputError(
            "parts",
            allowed="plates or beams, for geometric stiffness",
            state="have no stress and no geometric stiffness in torchmbd",
            noun=f"{type(self).__name__} of a body",
        )

    def modules(self) -> dict[str, nn.Module]:
        """Nothing to design."""
        return {}

    def masses(self) -> MassPoints:
        """The lumped masses."""
        return MassPoints(self._nodes[:, None].expand(-1, 2), self._mass, torch.zeros_like(self._mass))


class PointMasses:
    """Masses [kg] with isotropic rotary inertias [kg m2] at nodes, or on arms from them [m]; no stiffness."""

    @constant_arguments
    def __init__(
        self,
        mesh: Mesh,
        nodes: Sequence[int],
        mass: Sequence[float],
        rotary: Sequence[float],
        arms: Sequence[Sequence[float]] | None = None,
    ) -> None:
        none = torch.empty(0, dtype=torch.long)
        self.pattern = Pattern(none, none, 6 * len(mesh.nodes))
        self._nodes = torch.tensor(list(nodes), dtype=torch.long)
        self._arms = None if arms is None else torch.tensor(arms, dtype=torch.float64)
        self._mass, self._rotary = (torch.tensor(list(x), dtype=torch.float64) for x in (mass, rotary))

    def values(self, entries: Int[Tensor, " k"] | None = None) -> Float[Tensor, " 0"]:
        """No stiffness."""
        return torch.zeros(0, dtype=torch.float64)

    def stressed(self, motion: Float[Tensor, "*lanes n 6 k"]) -> list[StressedCells]:
        """No stress."""
        return []

    def modules(self) -> dict[str, nn.Module]:
        """Nothing to design."""
        return {}

    def masses(self) -> MassPoints:
        """The masses."""
        return MassPoints(self._nodes[:, None].expand(-1, 2), self._mass, self._rotary, self._arms)
