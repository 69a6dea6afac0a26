"""Roots of functions between numbers at which their signs differ, of many functions at once.

    a, b      enclose the root: f(a) f(b) <= 0; a is the last number at which f was evaluated
    next      inverse quadratic interpolation through a, b and the number before, where that is monotonic; else the middle

The first number is that of the secant: the functions here are smooth mostly, and nearly linear between their ends.
A function may stay zero after its root, as max(0, -x) does. Where f is exactly zero at a root, f a little before shows whether
it is zero there already: then the first zero is bisected, and the root is a number a little before, at which f has a slope.
Source: Chandrupatla, Adv. Eng. Software 28 (1997) 145-149.
Checked in tests/math/test_roots.py.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

_ROUND = 1e-13  # of a root
_MOST = 100  # evaluations: a function that jumps takes about 50
_BEFORE = 1e-9  # of the distance between low and high: how far before a root that stays zero f has its slope


def roots(
    f: Callable[[Tensor, list[int]], Tensor], low: Tensor, high: Tensor, f_low: Tensor, f_high: Tensor
) -> tuple[Tensor, Tensor]:
    """Roots [n] between low and high, and which were solved; f(x, numbers): some of the functions, at x."""
    x, fx, solved = _changes_of_sign(f, low, high, f_low, f_high)
    return _first_zeros(f, low, high, x, solved & (fx == 0.0)), solved


def _first_zeros(
    f: Callable[[Tensor, list[int]], Tensor], low: Tensor, high: Tensor, x: Tensor, zero: Tensor
) -> Tensor:
    """x [n], or the numbers a little before the first zeros of those functions (a mask) that are zero before x as well."""
    least = _BEFORE * (high - low)
    a, b, stays = low, x - least, zero & (x - least > low)
    some = torch.nonzero(stays)[:, 0]
    if len(some):
        stays = stays.index_copy(0, some, f(b[some], some.tolist()) == 0.0)
    while bool((active := stays & (b - a > 0.5 * least)).any()):
        some, middle = torch.nonzero(active)[:, 0], 0.5 * (a + b)
        at_zero = torch.zeros_like(stays).index_copy(0, some, f(middle[some], some.tolist()) == 0.0)
        a, b = torch.where(active & ~at_zero, middle, a), torch.where(at_zero, middle, b)
    return torch.where(stays, (2.0 * a - b).maximum(low), x)


def _changes_of_sign(
    f: Callable[[Tensor, list[int]], Tensor], low: Tensor, high: Tensor, f_low: Tensor, f_high: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Numbers at which functions change their signs, the functions there, and which were solved."""
    a, b, fa, fb = high, low, f_high, f_low
    t, solved = fa / (fa - fb), torch.zeros_like(a, dtype=torch.bool)
    active = f_low * f_high <= 0.0
    for _ in range(_MOST):
        some = torch.nonzero(active)[:, 0]
        if not len(some):
            break
        x = a + t * (b - a)
        fx = fa.index_copy(0, some, f(x[some], some.tolist()))
        same = fx.sign() == fa.sign()  # the root is between x and b
        c, fc = torch.where(same, a, b), torch.where(same, fa, fb)
        b, fb = (torch.where(active, torch.where(same, y, z), y) for y, z in ((b, a), (fb, fa)))
        a, fa = (torch.where(active, y, z) for y, z in ((x, a), (fx, fa)))
        xi, phi = (a - b) / (c - b), (fa - fb) / (fc - fb)
        smooth = (phi * phi < xi) & ((1.0 - phi) ** 2 < 1.0 - xi)
        t = fa / (fb - fa) * fc / (fb - fc) + (c - a) / (b - a) * fa / (fc - fa) * fb / (fc - fb)
        t = torch.where(smooth, t, 0.5)
        step = torch.where(smooth, t * (b - a), b - a).abs()
        solved = solved | (active & ((fa == 0.0) | (step <= _ROUND * a.abs())))
        active = active & ~solved & torch.isfinite(fa)
    return a, fa, solved
