"""Stiffness of single cells of one kind, by its element (`ELEMENTS`): only of those that differ in shape or laminate.

    K_cell = sum_i s_i K_i + area J' C(A, B) J,     K_i = sum_points weight E' C_i E

C_i   the pattern of entry i in the 8 x 8 law (N, M, Q) = C (eps, kappa, gamma)
E     strains of the shape (strains.py)
J, C  membrane forces that vary over a quadrilateral (inner_forces.py)

A variant is a shape with a laminate of its own. The cells of a mesh of rectangles have nine shapes, by what lies at their
sides. Matrices are symmetric: their upper triangles, row by row, are the h numbers of a variant.
Checked in tests/fem/elements/test_plate_matrices.py, tests/fem/elements/test_inner_forces.py.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmbd.fem.elements.facet import Facets
from torchmbd.fem.elements.inner_forces import CellForces, InnerForces
from torchmbd.fem.elements.quad import quad_strains
from torchmbd.fem.elements.strains import Strains
from torchmbd.fem.elements.triangle import triangle_strains
from torchmbd.fem.materials import ENTRIES, IsotropicMean, LaminateStiffness
from torchmbd.math.distinct_rows import distinct_rows

#: The element of each kind of cell (strains.py says what an element is).
ELEMENTS: dict[str, Callable[[Facets, IsotropicMean], Strains]] = {
    "triangle": triangle_strains,
    "quad": quad_strains,
}


_FIRST_ROW = {"A": (0, 0), "B": (0, 3), "D": (3, 3), "As": (6, 6)}
_SAME = 1e-12  # of the largest number: cells that differ by less have one shape


def distinct_shapes(plane: Facets) -> tuple[Int[Tensor, " shapes"], Int[Tensor, " m"]]:
    """Return one cell of each shape, and the shape of every cell; Facets of one shape agree but for rounding."""
    columns = []
    for x in vars(plane).values():
        flat = x.to(torch.float64).flatten(1) if x.dim() > 1 else x[:, None]
        columns.append((flat / (_SAME * flat.abs().max()).clamp_min(torch.finfo(flat.dtype).tiny)).round())
    return distinct_rows(torch.cat(columns, 1))


class CellStiffness:
    """The linear map (linear_map.py) from laminates to the numbers of the matrices of all variants.

    strains    of the shapes
    variants   shape and laminate of each, sorted by shape [variants, 2]
    laminates  number of laminates
    entry_index  of each entry of a matrix among its h numbers [f, f]
    """

    def __init__(self, strains: Strains, variants: Int[Tensor, "variants 2"], laminates: int) -> None:
        self.shape, self.laminate = variants.unbind(1)
        f = strains.at.shape[-1]
        self.upper, self.laminates = torch.triu_indices(f, f), laminates
        place = torch.zeros(f, f, dtype=torch.long)
        place[self.upper[0], self.upper[1]] = torch.arange(self.upper.shape[1])
        self.entry_index = place.maximum(place.mT)
        self.basis = _basis(strains, self.upper)
        self.counts = torch.bincount(self.shape, minlength=self.basis.shape[1]).tolist()
        forces = strains.forces
        self.inner = None
        if forces is not None:
            constants = {
                name: x[:, self.shape] if name == "sides" else x[self.shape] for name, x in forces._asdict().items()
            }
            self.inner = CellForces(InnerForces(**constants))

    @property
    def each(self) -> int:
        """Number of numbers of a variant: h."""
        return self.basis.shape[-1]

    @property
    def numbers(self) -> int:
        """Number of numbers of all variants."""
        return len(self.laminate) * self.each

    @property
    def laws(self) -> int:
        """Number of laws of inner forces: one or none."""
        return int(self.inner is not None)

    def law(self, A: Float[Tensor, "lanes z 3 3"], B: Float[Tensor, "lanes z 3 3"]) -> list[Tensor]:
        """Return the law of inner forces of all variants, if cells have them."""
        if self.inner is None:
            return []
        return [self.inner.law(*((X if self.laminates == 1 else X[:, self.laminate]) for X in (A, B)))]

    def __call__(self, entries: Float[Tensor, "lanes z 21"], *law: Tensor) -> Float[Tensor, "lanes numbers"]:
        """Numbers of all variants."""
        if self.laminates == 1:
            numbers = (entries[:, 0] @ self.basis.flatten(1)).unflatten(1, (-1, self.each))
        else:
            parts = zip(entries[:, self.laminate].split(self.counts, 1), self.basis.unbind(1), strict=True)
            numbers = torch.cat([values @ basis for values, basis in parts], 1)
        if self.inner is not None:
            numbers = numbers + self.inner.stiffness(law[0])[..., self.upper[0], self.upper[1]]
        return numbers.flatten(1)

    def moved(self, strains: Strains, law: LaminateStiffness) -> Float[Tensor, "lanes numbers"]:
        """Numbers of all variants with other strains, of [lanes variants]; law [lanes, laminates, ...]."""
        A, B, D, As = (X[:, self.laminate].flatten(0, 1) for X in law)
        membrane, curvature, shear = strains.at.split([3, 3, 2], -2)  # [lanes variants, points, ., f]
        A, B, D, As = (X[:, None] for X in (A, B, D, As))
        forces = [A @ membrane + B @ curvature, B @ membrane + D @ curvature, As @ shear]
        weighted = torch.cat(forces, -2) * strains.weight[..., None, None]
        K = strains.at.flatten(1, 2).mT @ weighted.flatten(1, 2)
        if strains.forces is not None:
            inner = CellForces(strains.forces)
            K = K + inner.stiffness(inner.law(A[:, 0], B[:, 0]))
        return K[:, self.upper[0], self.upper[1]].reshape(len(law.A), -1)

    def adjoint(self, y: Float[Tensor, "lanes numbers"]) -> list[Tensor]:
        """Return the adjoint: cotangents of entries and law from those of the numbers."""
        y = y.unflatten(1, (len(self.laminate), -1))
        if self.laminates == 1:
            entries = (y.flatten(1) @ self.basis.flatten(1).mT)[:, None]
        else:
            parts = zip(y.split(self.counts, 1), self.basis.unbind(1), strict=True)
            each = torch.cat([values @ basis.mT for values, basis in parts], 1)
            entries = each.new_zeros(len(y), self.laminates, len(ENTRIES)).index_add(1, self.laminate, each)
        if self.inner is None:
            return [entries]
        f = int(self.upper[0, -1]) + 1
        full = y.new_zeros(*y.shape[:2], f, f)
        full[..., self.upper[0], self.upper[1]] = y
        return [entries, self.inner.adjoint(full)]


def _basis(strains: Strains, upper: Int[Tensor, "2 h"]) -> Float[Tensor, "21 shapes h"]:
    """sum_points weight E' C_i E of every entry i: the upper triangles."""
    weighted = strains.at * strains.weight[..., None, None]
    basis = strains.at.new_empty(len(ENTRIES), len(strains.at), upper.shape[1])
    for numbers, (name, i, j) in zip(basis, ENTRIES, strict=True):
        p0, q0 = _FIRST_ROW[name]
        pairs = sorted({(p0 + i, q0 + j), (p0 + j, q0 + i)})  # two, where i differs from j
        first, second = [p for p, _ in pairs], [q for _, q in pairs]
        matrix = weighted[:, :, first].flatten(1, 2).mT @ strains.at[:, :, second].flatten(1, 2)
        matrix = matrix + matrix.mT if name == "B" else matrix  # B stands in C twice, above and below the diagonal
        numbers[:] = matrix[:, upper[0], upper[1]]
    return basis
