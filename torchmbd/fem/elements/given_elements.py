"""A part of elements whose stiffness is a matrix of numbers: rods, springs, bushings, solids.

    K = sum over elements of their matrices at their freedoms 6 * node + i

Freedoms that no part of a body gives stiffness or mass to, such as rotations of nodes of solids, are left out by the assembly.
Checked in tests/extensions/nastran/test_elements.py.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from torchmbd.errors import InputError
from torchmbd.fem.elements.geometric import StressedCells
from torchmbd.fem.elements.part import MassPoints
from torchmbd.math.sparse import Pattern


class GivenElements:
    """Elements of constant stiffness and lumped masses.

    mesh      its nodes have the freedoms
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
        raise InputError(f"geometric stiffness of {type(self).__name__} is not known; allowed: plates and beams")

    def modules(self) -> dict[str, nn.Module]:
        """Nothing to design."""
        return {}

    def masses(self) -> MassPoints:
        """The lumped masses."""
        return MassPoints(self._nodes[:, None].expand(-1, 2), self._mass, torch.zeros_like(self._mass))
