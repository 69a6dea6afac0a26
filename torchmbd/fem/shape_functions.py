"""Shape functions of elements from the monomials that they consist of.

    N_k(x) = sum_m c_mk x^m,     N_k(x_l) = delta_kl

x: natural coordinates; m: the powers of each. Checked in tests/fem/sections/test_shapes.py,
tests/extensions/nastran/test_solids.py.
"""

from __future__ import annotations

from itertools import product

import torch
from jaxtyping import Float
from torch import Tensor


def shape_functions(
    nodes: Float[Tensor, "k d"], powers: list[tuple[int, ...]], points: Float[Tensor, "g d"]
) -> tuple[Float[Tensor, "g k"], Float[Tensor, "g k d"]]:
    """Return shape functions and their derivatives at points, of k nodes and the powers of as many monomials."""
    exponents = torch.tensor(powers)
    coefficients = torch.linalg.inv(_monomials(exponents, nodes))  # [monomial, k]
    slopes = [_monomials(exponents, points, by) @ coefficients for by in range(nodes.shape[1])]
    return _monomials(exponents, points) @ coefficients, torch.stack(slopes, -1)


def simplex_powers(degree: int) -> list[tuple[int, ...]]:
    """Powers on a triangle of this degree."""
    return [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]


def serendipity_powers(degree: int, dimensions: int) -> list[tuple[int, ...]]:
    """Powers on a square or a cube with nodes on its sides: of this degree, linear factors not counted."""
    every = product(range(degree + 1), repeat=dimensions)
    return [powers for powers in every if sum(n for n in powers if n > 1) <= 2]


def _monomials(powers: Tensor, at: Tensor, by: int | None = None) -> Tensor:
    """Monomials at points [g, m], or their derivatives with respect to one coordinate."""
    factors = at[:, None] ** powers
    if by is not None:
        factors[..., by] = powers[:, by] * at[:, None, by] ** (powers[:, by] - 1).clamp_min(0)
    return factors.prod(-1)
