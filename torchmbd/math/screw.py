"""Screws of relative motions, as in rigid_motion.py, for tensors, pairs and traced arrays with components first.

    l = log(u, R) = (rho, phi)          dl = B+ eta_2 - B- eta_1

eta  displacement and rotation of a frame, both in its own axes

There are no branches, so that steps can be translated to C++: the angle is halved twice before its series. Up to LARGEST
(rigid_motion.py) screws are exact to rounding; near half a turn they are not finite, so that such a step fails.
Checked in tests/math/test_screw.py: against rigid_motion.py.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torchmbd.math.elementwise import reciprocal, sqrt
from torchmbd.math.pair import cat, cross, dot
from torchmbd.math.rigid_motion import SERIES, SLOPES
from torchmbd.math.rotation import axial

_HALVINGS, _ARC_TANGENT = 2, 11  # terms: tan(LARGEST / 16)^2 = 0.027, to the 11th 1e-17


def screw(u: Any, R: Any) -> Any:
    """l [6, ...] of the motion by u [3, ...] and R [3, 3, ...], in the axes of the first frame."""
    whole = 0.5 * sqrt(R[0, 0] + R[1, 1] + R[2, 2] + 1.0)  # cosine of half the angle
    part = axial(R) * reciprocal(4.0 * whole * (whole + 1.0))  # along the axis: tangent of a quarter of the angle
    for _ in range(_HALVINGS):
        part = part * reciprocal(sqrt(dot(part, part) + 1.0) + 1.0)
    z = dot(part, part)
    series = z * 0.0 + _arc(_ARC_TANGENT - 1)
    for k in range(_ARC_TANGENT - 2, -1, -1):
        series = series * z + _arc(k)
    phi = part * (series * (4.0 * 2.0**_HALVINGS))
    turned = cross(phi, u)
    c = _polynomial(SERIES[:, 0].tolist(), dot(phi, phi))
    return cat([u - 0.5 * turned + c * cross(phi, turned), phi])


def _arc(k: int) -> float:
    return (-1.0) ** k / (2 * k + 1)


def _polynomial(series: list[float], s: Any) -> Any:
    total = s * series[-1] + series[-2]
    for c in series[-3::-1]:
        total = total * s + c
    return total


def wrenches(l: Any, f: Any) -> tuple[Any, Any]:
    """Forces and moments -B-' f on the first frame and B+' f on the second [6, ...], each in its own axes: f' dl is their work.

    l may have axes of length 1 where f [6, ...] has more.
    """
    c2, c4 = _coefficients(l)
    first = _ad_transposed(l, f)
    second = _ad_transposed(l, first)
    even = f + c2 * second + c4 * _ad_transposed(l, _ad_transposed(l, second))
    return 0.5 * first - even, 0.5 * first + even


def screw_rate(l: Any, first: Any, second: Any) -> Any:
    """l' = B+ second - B- first, of the velocities of both frames [6, ...] in their own axes."""
    c2, c4 = _coefficients(l)
    apart = second - first
    square = _ad(l, _ad(l, apart))
    return apart + 0.5 * _ad(l, second + first) + c2 * square + c4 * _ad(l, _ad(l, square))


def rate_slopes(l: Any, first: Any, second: Any) -> Any:
    """Derivative of `screw_rate` by l, velocities held [6, 6, ...]: values only."""
    return 0.5 * _ad_by_screw(second + first) + _even_slopes(l, second - first, _ad, _ad_by_screw)


def wrench_slopes(l: Any, f: Any) -> tuple[Any, Any]:
    """Derivatives of both `wrenches` by l, f held [6, 6, ...]: values only."""
    half, even = 0.5 * _ad_transposed_by_screw(f), _even_slopes(l, f, _ad_transposed, _ad_transposed_by_screw)
    return half - even, half + even


def _even_slopes(l: Any, x: Any, bracket: Callable[[Any, Any], Any], by_screw: Callable[[Any], Any]) -> Any:
    """d(c2 A^2 x + c4 A^4 x) / dl with constant x [6, 6, ...]; A y = bracket(l, y), `by_screw(y)` is d(A y) / dl."""
    s = dot(l[3:], l[3:])
    (c2, c4), (d2, d4) = _coefficients(l), (_polynomial(SLOPES[:, k].tolist(), s) for k in (1, 2))
    wide, slope = l.unsqueeze(1), None
    powers, slopes = [], []
    for _ in range(4):
        direct = by_screw(x)
        slope = direct if slope is None else direct + bracket(wide, slope)
        x = bracket(l, x)
        powers.append(x)
        slopes.append(slope)
    by_square = cat([l[:3] * 0.0, 2.0 * l[3:]])
    outer = (d2 * powers[1] + d4 * powers[3]).unsqueeze(1) * by_square.unsqueeze(0)
    return c2 * slopes[1] + c4 * slopes[3] + outer


def _coefficients(l: Any) -> tuple[Any, Any]:
    s = dot(l[3:], l[3:])
    return _polynomial(SERIES[:, 1].tolist(), s), _polynomial(SERIES[:, 2].tolist(), s)


def _ad(l: Any, x: Any) -> Any:
    """ad x."""
    rho, phi, straight, turn = l[:3], l[3:], x[:3], x[3:]
    return cat([cross(phi, straight) + cross(rho, turn), cross(phi, turn)])


def _ad_transposed(l: Any, x: Any) -> Any:
    """ad' x."""
    rho, phi, force, moment = l[:3], l[3:], x[:3], x[3:]
    return -cat([cross(phi, force), cross(rho, force) + cross(phi, moment)])


def _ad_transposed_by_screw(x: Any) -> Any:
    """ad' x as a matrix [6, 6, ...] times the screw."""
    force, moment = _hat(x[:3]), _hat(x[3:])
    return cat([cat([force * 0.0, force], 1), cat([force, moment], 1)])


def _ad_by_screw(x: Any) -> Any:
    """ad x as a matrix [6, 6, ...] times the screw."""
    straight, turn = -_hat(x[:3]), -_hat(x[3:])
    return cat([cat([turn, straight], 1), cat([turn * 0.0, turn], 1)])


def _hat(x: Any) -> Any:
    """Matrices ~x [3, 3, ...]."""
    a, b, c = x[:1], x[1:2], x[2:]
    o = a * 0.0
    return cat([y.unsqueeze(1) for y in (cat([o, c, -b]), cat([-c, o, a]), cat([b, -a, o]))], 1)
