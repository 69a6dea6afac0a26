"""The polynomial that has given values and derivatives at both ends of an interval (Hermite), and its derivatives.

    y(t0 + s h) = sum_k h^k ( L_k(s) y0^(k) + (-1)^k L_k(1 - s) y1^(k) ),   0 <= s <= 1

    L_0 = 1 - 3 s^2 + 2 s^3,              L_1 = s - 2 s^2 + s^3                                              cubic
    L_0 = 1 - 10 s^3 + 15 s^4 - 6 s^5,    L_1 = s - 6 s^3 + 8 s^4 - 3 s^5,    L_2 = (s^2 - 3 s^3 + 3 s^4 - s^5)/2  quintic

The error is h^4/384 times the fourth derivative, or h^6/46080 times the sixth. With z = (y0, y1, h y0', h y1', ...) and the
polynomials P in their order, the integrals over the interval are h g'z of y, h z'G z of y^2: g = int P ds, G = int P P' ds.
Differentiable in the ends. Source: any textbook of numerical analysis. Checked in tests/design/test_spline.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import torch
from numpy.polynomial import Polynomial
from torch import Tensor

_LEFT: dict[int, tuple[tuple[float, ...], ...]] = {
    2: ((1, 0, -3, 2), (0, 1, -2, 1)),
    3: ((1, 0, 0, -10, 15, -6), (0, 1, 0, -6, 8, -3), (0, 0, 0.5, -1.5, 1.5, -0.5)),
}


def hermite(ends: Sequence[tuple[Tensor, Tensor]], h: Tensor, s: Tensor, derivative: int = 0) -> Tensor:
    """The polynomial, or a derivative of it by time, at t0 + s h [..., n].

    ends   (value, value), (slope, slope) and, for the quintic, (curvature, curvature) by time at both ends [..., n]
    h, s   length of the interval [s] and position in it [n], or [..., n]
    """
    table = torch.tensor(_table(len(ends), derivative), dtype=s.dtype)
    powers = [torch.ones_like(s)]
    for _ in range(table.shape[1] - 1):
        powers.append(powers[-1] * s)
    sizes = torch.stack([h ** (k - derivative) for k in range(len(ends)) for _ in range(2)])
    weights = _leading(torch.tensordot(table, torch.stack(powers), 1), h.dim()) * _leading(sizes, s.dim())
    # One product: weights do not depend on the design but by moving ends; values and derivatives at the ends do.
    at_ends = torch.stack([x for pair in ends for x in pair])
    return (_leading(weights, at_ends.dim() - 1) * at_ends).sum(0)


def hermite_integral(ends: Sequence[tuple[Tensor, Tensor]], h: Tensor, power: int = 1) -> Tensor:
    """Integral of the polynomial over its interval, or of its square (power 2) [..., n]; arguments as in `hermite`."""
    rows = torch.tensor(_table(len(ends), 0), dtype=h.dtype)
    z = torch.stack([h**k * x for k, pair in enumerate(ends) for x in pair])
    exponent = torch.arange(rows.shape[1], dtype=h.dtype)
    if power == 1:
        return h * torch.tensordot(rows @ (1.0 / (exponent + 1.0)), z, 1)
    G = rows @ (1.0 / (exponent[:, None] + exponent + 1.0)) @ rows.T
    return h * (z * torch.tensordot(G, z, 1)).sum(0)


def coefficients(ends: Sequence[tuple[Tensor, Tensor]], h: Tensor) -> Tensor:
    """Coefficients [powers, ..., n] of the polynomial in the position s, lowest power first; arguments as in `hermite`."""
    at_ends = torch.stack([x * h**k for k, pair in enumerate(ends) for x in pair])
    table = torch.tensor(_table(len(ends), 0), dtype=at_ends.dtype)
    return torch.tensordot(table.T, at_ends, 1)


def polynomial(terms: Sequence[Tensor], s: Tensor) -> Tensor:
    """sum_k terms_k s^k by Horner's rule."""
    result = terms[-1]
    for term in reversed(terms[:-1]):
        result = torch.addcmul(term, result, s)
    return result


def _leading(x: Tensor, dims: int) -> Tensor:
    """[k, n] with as many dimensions between as make `dims` behind the first."""
    return x.reshape(len(x), *[1] * (dims - x.dim() + 1), *x.shape[1:])


@cache
def _table(kinds: int, derivative: int) -> list[list[float]]:
    """Coefficients, by powers of s, of the weights of value, value, slope, slope, ... at both ends."""
    rows = []
    for k, weights in enumerate(_LEFT[kinds]):
        start = Polynomial(weights)
        end = (-1.0) ** k * start(Polynomial([1.0, -1.0]))  # L(1 - s)
        rows += [x.deriv(derivative).coef.tolist() for x in (start, end)]
    return rows
