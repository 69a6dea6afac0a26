"""The polynomial that has given values and derivatives at both ends of an interval (Hermite), and its derivatives.

    y(t0 + s h) = sum_k h^k ( L_k(s) y0^(k) + (-1)^k L_k(1 - s) y1^(k) ),   0 <= s <= 1

    L_0 = 1 - 3 s^2 + 2 s^3,              L_1 = s - 2 s^2 + s^3                                              cubic
    L_0 = 1 - 10 s^3 + 15 s^4 - 6 s^5,    L_1 = s - 6 s^3 + 8 s^4 - 3 s^5,    L_2 = (s^2 - 3 s^3 + 3 s^4 - s^5)/2  quintic

The error is h^4/384 times the fourth derivative, or h^6/46080 times the sixth.
Differentiable in the ends. Source: any textbook of numerical analysis. Checked in tests/design/test_spline.py.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

_LEFT: dict[int, tuple[tuple[float, ...], ...]] = {
    2: ((1, 0, -3, 2), (0, 1, -2, 1)),
    3: ((1, 0, 0, -10, 15, -6), (0, 1, 0, -6, 8, -3), (0, 0, 0.5, -1.5, 1.5, -0.5)),
}


def hermite(ends: Sequence[tuple[Tensor, Tensor]], h: Tensor, s: Tensor, derivative: int = 0) -> Tensor:
    """The polynomial, or a derivative by time, at t0 + s h.

    ends   (value, value), (slope, slope) and, for the quintic, (curvature, curvature) by time at both ends
    h      length of the interval [s]
    """
    weights, r = [], 1.0 - s
    for k, left in enumerate(_LEFT[len(ends)]):
        slope, size = _differentiated(left, derivative), h ** (k - derivative)
        weights += [size * _polynomial(slope, s), (-1.0) ** (k + derivative) * size * _polynomial(slope, r)]
    # One product of what depends on the design with what does not.
    shape = torch.broadcast_shapes(ends[0][0].shape, s.shape)
    known, given = ([x.expand(shape) for x in parts] for parts in (weights, [x for pair in ends for x in pair]))
    return (torch.stack(known) * torch.stack(given)).sum(0)


def _differentiated(coefficients: tuple[float, ...], times: int) -> tuple[float, ...]:
    for _ in range(times):
        coefficients = tuple(power * c for power, c in enumerate(coefficients))[1:]
    return coefficients


def _polynomial(coefficients: tuple[float, ...], s: Tensor) -> Tensor:
    *rest, last = coefficients
    value = torch.full_like(s, last)
    for c in reversed(rest):
        value = value * s + c if c else value * s
    return value
