"""Rigid motions (u, R) and their logarithms l = (rho, phi): the screw that leads from one frame to another.

    R = exp(~phi),    u = J(phi) rho             u: origin of the second frame in the axes of the first
    ad = [[~phi, ~rho], [0, ~phi]]
    B+ = 1 + ad / 2 + c2 ad^2 + c4 ad^4          dl = B+ eta_2 - B- eta_1,   B-: with -ad / 2
    J(phi)^-1 = 1 - ~phi / 2 + c ~phi^2

eta  displacement and rotation of a frame, both in its own axes

c, c2, c4 are power series in (|phi| / 2 pi)^2 with Bernoulli's numbers: up to LARGEST 20 terms leave 1e-15.
Sources: J. M. Selig, Geometric Fundamentals of Robotics (2005), chapter 7; V. Sonneville, A. Cardona, O. Bruls, Geometrically
exact beam finite element on the special Euclidean group, Comput. Methods Appl. Mech. Eng. 268 (2014) 451-474.
Differentiable, forward and reverse, any number of times. Checked in tests/math/test_rigid_motion.py.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from scipy.special import zeta
from torch import Tensor

#: Rotations up to which logarithms are exact to rounding [rad].
LARGEST = 2.6
_TERMS = 20


def _series() -> Tensor:
    """Coefficients of |phi|^(2k) in c, c2 and c4 [terms, 3]: reductions of sum B_2k / (2k)! ad^2k, where
    ad^2k = (2 - k) (-s)^(k-1) ad^2 + (k - 1) (-s)^(k-2) ad^4."""
    beta = [2.0 * float(zeta(2.0 * k)) / (2.0 * math.pi) ** (2 * k) for k in range(1, _TERMS + 2)]
    return torch.tensor(
        [[beta[j], beta[j] * (1 - j), -beta[j + 1] * (j + 1)] for j in range(_TERMS)], dtype=torch.float64
    )


SERIES = _series()
SLOPES = SERIES[1:] * torch.arange(1, _TERMS, dtype=torch.float64)[:, None]


def hat(x: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """Matrices ~x: ~x y = x cross y."""
    a, b, c = x.unbind(-1)
    o = torch.zeros_like(a)
    return torch.stack([o, -c, b, c, o, -a, -b, a, o], -1).unflatten(-1, (3, 3))


def exponential(phi: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """Rotation matrices of rotation vectors [rad]."""
    return torch.linalg.matrix_exp(hat(phi))


def rotation_vector(R: Float[Tensor, "*n 3 3"]) -> Float[Tensor, "*n 3"]:
    """Rotation vectors of rotation matrices, up to LARGEST [rad]."""
    spin = torch.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1)
    whole = 0.5 * (1.0 + R.diagonal(dim1=-2, dim2=-1).sum(-1)).sqrt()  # cosine of half the angle
    quarter = spin / (4.0 * whole * (1.0 + whole))[..., None]  # along the axis: tangent of a quarter of the angle
    z = (quarter * quarter).sum(-1)
    small = z < 1e-2
    root = torch.where(small, 1.0, z).sqrt()
    series = torch.zeros_like(z)
    for k in range(9, -1, -1):
        series = series * z + (-1.0) ** k / (2 * k + 1)
    return 4.0 * torch.where(small, series, torch.atan(root) / root)[..., None] * quarter


def coefficients(phi: Float[Tensor, "*n 3"]) -> tuple[Tensor, Tensor, Tensor]:
    """c, c2, c4 of the module header [*n, 1]."""
    c, c2, c4 = _polynomials(SERIES, (phi * phi).sum(-1, keepdim=True)).split(1, -1)
    return c, c2, c4


def _polynomials(series: Float[Tensor, "terms 3"], s: Float[Tensor, "*n 1"]) -> Float[Tensor, "*n 3"]:
    total = series[-1].expand(*s.shape[:-1], 3)
    for row in series[:-1].flip(0):
        total = total * s + row
    return total


def logarithm(u: Float[Tensor, "*n 3"], R: Float[Tensor, "*n 3 3"]) -> Float[Tensor, "*n 6"]:
    """l = (rho, phi) of the motion by u [m] and R, in the axes of the first frame."""
    phi = rotation_vector(R)
    cross = torch.linalg.cross
    turned = cross(phi, u)
    return torch.cat([u - 0.5 * turned + coefficients(phi)[0] * cross(phi, turned), phi], -1)


def adjoint(screw: Float[Tensor, "*n 6"]) -> Float[Tensor, "*n 6 6"]:
    """The matrix ad of the module header."""
    rho, phi = hat(screw[..., :3]), hat(screw[..., 3:])
    return torch.cat([torch.cat([phi, rho], -1), torch.cat([torch.zeros_like(phi), phi], -1)], -2)


def end_map(screw: Float[Tensor, "*n 6"]) -> Float[Tensor, "*n 6 6"]:
    """B+ of the module header."""
    ad = adjoint(screw)
    _, c2, c4 = (c[..., None] for c in coefficients(screw[..., 3:]))
    square = ad @ ad
    return torch.eye(6, dtype=ad.dtype) + 0.5 * ad + c2 * square + c4 * (square @ square)


def end_wrenches(screw: Float[Tensor, "*n 6"], f: Float[Tensor, "*n 6"]) -> tuple[Tensor, Tensor]:
    """Forces and moments -B-' f on the first frame and B+' f on the second, each in its own axes: f' dl is their work."""
    rho, phi = screw.split(3, -1)
    _, c2, c4 = coefficients(phi)
    cross = torch.linalg.cross

    def back(x: Tensor) -> Tensor:
        """ad' x."""
        force, moment = x.split(3, -1)
        return -torch.cat([cross(phi, force), cross(rho, force) + cross(phi, moment)], -1)

    first = back(f)
    second = back(first)
    even = f + c2 * second + c4 * back(back(second))
    return 0.5 * first - even, 0.5 * first + even


def wrench_slopes(screw: Float[Tensor, "*n 6"], f: Float[Tensor, "*n 6"]) -> Float[Tensor, "*n 12 6"]:
    """Derivatives of both `end_wrenches` by the screw, f held."""
    phi = screw[..., 3:]
    A = adjoint(screw).mT
    _, c2, c4 = (c[..., None] for c in coefficients(phi))
    _, d2, d4 = _polynomials(SLOPES, (phi * phi).sum(-1, keepdim=True)).split(1, -1)
    by_square = torch.cat([torch.zeros_like(phi), 2.0 * phi], -1)
    powers, slopes = [f], [torch.zeros_like(A)]
    for _ in range(4):  # ad'^k f
        slopes.append(_back_by_screw(powers[-1]) + A @ slopes[-1])
        powers.append((A @ powers[-1][..., None])[..., 0])
    even = c2 * slopes[2] + c4 * slopes[4] + (d2 * powers[2] + d4 * powers[4])[..., None] * by_square[..., None, :]
    return torch.cat([0.5 * slopes[1] - even, 0.5 * slopes[1] + even], -2)


def _back_by_screw(x: Float[Tensor, "*n 6"]) -> Float[Tensor, "*n 6 6"]:
    """ad' x as a matrix times the screw."""
    force, moment = hat(x[..., :3]), hat(x[..., 3:])
    return torch.cat([torch.cat([torch.zeros_like(force), force], -1), torch.cat([force, moment], -1)], -2)
