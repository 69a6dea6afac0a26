"""Rotations by Euler parameters p = (e0, e1, e2, e3), |p| = 1; angular velocities in body axes.

    A(p) = (2 e0^2 - 1) 1 + 2 (e e' + e0 ~e)            body -> ground
    dp/dt = 1/2 p * (0, omega)                          (* the quaternion product)
    p <- p * exp(delta / 2)                             delta a rotation vector in body axes [rad]

Components first, then any axes; each function takes tensors and pairs (see pair.py).
Source: Nikravesh, Computer-Aided Analysis of Mechanical Systems, chapter 6.
Checked in tests/math/test_rotation.py.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchmbd.math.pair import CROSS_FORM, Pair, cat, constant_map, cross, dot

# A_ij = sum_ab _A[3 i + j, 4 a + b] p_a p_b, symmetric in a and b; with |p| = 1 the form of the header.
_A = torch.zeros(3, 3, 4, 4, dtype=torch.float64)
for _i in range(3):
    for _a in range(4):
        _A[_i, _i, _a, _a] = 1.0 if _a in (0, _i + 1) else -1.0
    for _j in range(3):
        if _i != _j:
            _A[_i, _j, _i + 1, _j + 1] = _A[_i, _j, _j + 1, _i + 1] = 1.0
            _k = 3 - _i - _j
            _sign = 1.0 if (_j - _i) % 3 == 2 else -1.0
            _A[_i, _j, 0, _k + 1] = _A[_i, _j, _k + 1, 0] = _sign
ROTATION_FORM = _A.reshape(9, 16)

# ~x = skew(x): (~x)_ij = -eps_ijk x_k, so that ~x y = x cross y.
SKEW = torch.zeros(9, 3, dtype=torch.float64)
# axial(Y)_i = eps_ijk Y_kj: the axial vector of a matrix; axial(x b') = b cross x.
AXIAL = torch.zeros(3, 9, dtype=torch.float64)
for _i, _j, _k, _sign in ((0, 1, 2, 1), (1, 2, 0, 1), (2, 0, 1, 1), (0, 2, 1, -1), (2, 1, 0, -1), (1, 0, 2, -1)):
    SKEW[3 * _i + _j, _k] = -_sign
    AXIAL[_i, 3 * _k + _j] = _sign


# (p d)_0 = p0 d0 - e.x, and p0 x + d0 e + e x x below it, out of the 16 products of p = (p0, e) and d = (d0, x).
PRODUCT_FORM = torch.zeros(4, 4, 4, dtype=torch.float64)
PRODUCT_FORM[0] = torch.diag(torch.tensor([1.0, -1.0, -1.0, -1.0], dtype=torch.float64))
for _i in range(3):
    PRODUCT_FORM[1 + _i, 0, 1 + _i] = PRODUCT_FORM[1 + _i, 1 + _i, 0] = 1.0
PRODUCT_FORM[1:, 1:, 1:] = CROSS_FORM.reshape(3, 3, 3)
PRODUCT_FORM = PRODUCT_FORM.reshape(4, 16)


def rotation_matrix(p):
    """Rotation matrices [3, 3, ...] of Euler parameters [4, ...], body -> ground."""
    products = p[:, None] * p[None]
    return constant_map(ROTATION_FORM, products.flatten(0, 1)).unflatten(0, (3, 3))


def skew(x):
    """Skew matrices [3, 3, ...] of vectors [3, ...]."""
    return constant_map(SKEW, x).unflatten(0, (3, 3))


def axial(Y):
    """Axial vectors [3, ...] of matrices [3, 3, ...]: eps_ijk Y_kj."""
    return constant_map(AXIAL, Y.flatten(0, 1))


def quaternion_product(p, d):
    """Product of Euler parameters [4, ...]: rotate by p after d (d in the axes of p's body)."""
    products = p.unsqueeze(1) * d.unsqueeze(0)
    return constant_map(PRODUCT_FORM, products.flatten(0, 1))


def euler_rates(p, omega):
    """Time derivative [4, ...] of Euler parameters for an angular velocity in body axes [3, ...] [rad/s]."""
    p0, e = p[:1], p[1:]
    return 0.5 * cat([-dot(e, omega)[None], p0 * omega + cross(e, omega)])


def exponential(delta):
    """Euler parameters [4, ...] of a rotation vector [3, ...] [rad]: cos n, delta / 2 sin(n) / n with n = |delta| / 2."""
    quarter = dot(delta, delta) * 0.25
    if not isinstance(quarter, Pair):
        c, s, _ = _half_angle(quarter)
        return cat([c[None], delta * (0.5 * s)])
    c, s, slope = _half_angle(quarter.value)
    cosine = Pair.of(c, (-0.5 * s) * quarter.tangent)
    sinc = Pair.of(s, slope * quarter.tangent)
    return cat([cosine[None], delta * (0.5 * sinc)])


def increment_torque(th, torque):
    """(1 + ~th/2 + ~th~th/6) torque, to third order what a torque does on changes of an increment th [3, ...].

    A change d of th turns a body by (1 - ~th/2 + ~th~th/6) d, to third order.
    """
    once = cross(th, torque)
    return torque + 0.5 * once + (1.0 / 6.0) * cross(th, once)


def _half_angle(square: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """cos n, sin(n) / n and d(sin(n) / n)/d(n^2) of n^2.

    1e-60 keeps n from zero without a change of any digit. Near zero the slope loses digits, but it is multiplied by delta
    twice, so its contribution is exact to rounding.
    """
    square = square + 1e-60
    n = torch.sqrt(square)
    c = torch.cos(n)
    s = torch.sin(n) / n
    return c, s, (c - s) / (2.0 * square)


def euler_parameters(A: Tensor) -> Tensor:
    """Euler parameters [4] of one rotation matrix [3, 3], by its largest component (no branch loses digits)."""
    trace = A.trace()
    squares = torch.stack([1 + trace, *(1 + 2 * A.diagonal() - trace)]) / 4
    k = int(squares.argmax())
    root = torch.sqrt(squares[k])
    spin = torch.stack([A[2, 1] - A[1, 2], A[0, 2] - A[2, 0], A[1, 0] - A[0, 1]])
    if k == 0:
        p = torch.cat([root[None], spin / (4 * root)])
    else:
        i = k - 1
        e = (A[i] + A[:, i]) / (4 * root)
        e[i] = root
        p = torch.cat([spin[i:k] / (4 * root), e])
    return p if p[0] >= 0 else -p
