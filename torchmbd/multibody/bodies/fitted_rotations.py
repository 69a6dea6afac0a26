"""Rotations of nodes that have displacements only, such as those of solids: a least-squares fit of their neighbors.

Checked in tests/multibody/bodies/test_from_matrices.py, tests/extensions/nastran/test_elements.py.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.fem.elements import Assembly


class FittedRotations:
    """Adds fitted rotations to the motion of nodes.

    x         positions of the nodes [n, 3]
    pairs     nodes and their neighbors [p, 2]
    missing   whether a node has no rotational degrees of freedom [n]
    """

    def __init__(self, x: Tensor, pairs: Tensor, missing: Tensor) -> None:
        pairs = pairs[missing[pairs[:, 0]]]
        self.at, self.to = pairs.unbind(1)
        self.any = len(pairs) > 0
        self.d = x[self.to] - x[self.at]
        square = (self.d * self.d).sum(1)[:, None, None] * torch.eye(3, dtype=x.dtype)
        T = x.new_zeros(len(x), 3, 3).index_add(0, self.at, square - self.d[:, :, None] * self.d[:, None, :])
        self.inverse = torch.from_numpy(np.linalg.pinv(T.numpy(), rcond=1e-9, hermitian=True)) if self.any else T

    @classmethod
    def of(cls, assembly: Assembly) -> FittedRotations | None:
        """Return the rotations of nodes that have only displacements; None if there are none of these."""
        missing = torch.bincount(assembly.freedoms.absent // 6, minlength=len(assembly.mesh.nodes)) == 3
        if not missing.any():
            return None
        nodes = torch.cat([torch.stack([p.pattern.rows, p.pattern.cols], 1) // 6 for p in assembly.parts.values()])
        pairs = torch.unique(nodes[nodes[:, 0] != nodes[:, 1]], dim=0)
        return cls(assembly.mesh.nodes, pairs, missing)

    def __call__(self, psi: Float[Tensor, "*lanes n 6 m"]) -> Float[Tensor, "*lanes n 6 m"]:
        if not self.any:
            return psi
        u = psi[..., :3, :]
        relative = u.index_select(-3, self.to) - u.index_select(-3, self.at)
        moment = torch.linalg.cross(self.d[:, :, None].expand_as(relative), relative, dim=-2)
        turned = torch.zeros_like(u).index_add(-3, self.at, moment)
        return torch.cat([u, psi[..., 3:, :] + self.inverse @ turned], dim=-2)
