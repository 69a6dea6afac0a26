"""Geometric stiffness: change of the stiffness of a body by forces that already act on it; linear in these forces.

    u' Kg u = sum_points d' L(stress) d,     d = R u        R: rows of a cell, no design but the nodes of beams

Every part returns its stressed cells (part.py): of shells slopes and membrane forces (shell_geometric.py), of beams rotations,
slopes and curvatures with all six section forces (beam.py). From these come Kg on the degrees of freedom of all nodes, and
its projection onto some motions, such as modes, which needs no matrix of the size of the mesh.
Positive where it stiffens. Differentiable, forward and reverse, in the stress and in the motions, with lanes.
Checked in tests/fem/elements/test_geometric.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmbd.math.quadratic_forms import matrices, quadratic_forms
from torchmbd.math.sparse import Pattern

AT_ONCE = 4_000_000  # numbers of cells' matrices in memory


class StressedCells(NamedTuple):
    """Cells of one kind under k states of stress.

    nodes   corners of each cell, whose degrees of freedom u1 ... phi3 are the columns of the rows
    rows    R at the points of each cell; the law is the same for all s components
    law     L, with the length or area that each point stands for, as factors of the products d_i . d_j, i <= j
            (quadratic_forms.py)
    """

    nodes: Int[Tensor, "m c"]
    rows: Float[Tensor, "*lanes m p r s f"]
    law: Float[Tensor, "*lanes k m p pairs"]


def projected_geometric_stiffness(
    cells: Sequence[StressedCells], motions: Float[Tensor, "*lanes n 6 a"]
) -> Float[Tensor, "*lanes k a a"]:
    """Kg of each state of stress between motions of all nodes."""
    total: Tensor | None = None
    for part in cells:
        at = corner_motions(part.nodes, motions)  # [*lanes, m, f, a]
        d = (part.rows.flatten(-4, -2) @ at).unflatten(-2, part.rows.shape[-4:-1])  # [*lanes, m, p, r, s, a]
        values = quadratic_forms(part.law.flatten(-3, -2), d.flatten(-5, -4))
        total = values if total is None else total + values
    if total is None:
        return motions.new_zeros(*motions.shape[:-3], 0, motions.shape[-1], motions.shape[-1])
    return total


def corner_motions(nodes: Int[Tensor, "m c"], motions: Float[Tensor, "*lanes n 6 k"]) -> Float[Tensor, "*lanes m f k"]:
    """Motions of all nodes as those of the degrees of freedom of cells."""
    return motions.index_select(-3, nodes.flatten()).unflatten(-3, nodes.shape).flatten(-3, -2)


def assembled_geometric_stiffness(pattern: Pattern, cells: Sequence[StressedCells]) -> Float[Tensor, "*lanes k nnz"]:
    """Kg of each state of stress on a pattern of all degrees of freedom 6 * node + i that has the blocks of all cells."""
    key = pattern.rows * pattern.size + pattern.cols
    total: Tensor | None = None
    for part in cells:
        freedoms = (6 * part.nodes[:, :, None] + torch.arange(6)).flatten(1)
        place = freedoms[:, :, None] * pattern.size + freedoms[:, None, :]
        position = torch.searchsorted(key, place.flatten())
        some = max(1, AT_ONCE * part.law.shape[-4] // (part.law[..., 0].numel() * freedoms.shape[1] ** 2))
        rows, sums = part.rows.unsqueeze(-6), []  # [*lanes, 1, m, p, r, s, f]
        for law in part.law.split(some, -4):
            forces = matrices(law, rows.shape[-3]) @ rows.flatten(-2)
            # [*lanes, k, m, f, f].
            K = rows.flatten(-4, -2).mT @ forces.unflatten(-1, part.rows.shape[-2:]).flatten(-4, -2)
            K = 0.5 * (K + K.mT)
            sums.append(K.new_zeros(*K.shape[:-3], pattern.nnz).index_add(-1, position, K.flatten(-3)))
        values = torch.cat(sums, -2)
        total = values if total is None else total + values
    assert total is not None
    return total
