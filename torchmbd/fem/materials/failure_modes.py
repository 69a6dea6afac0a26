"""Criteria of ply failure with modes: Hashin (1980), Puck and the maximum stress.

hashin   fiber tension        (s1 / Xt)^2 + (t12 / S12)^2 + (t13 / S13)^2                                 s1 >= 0
         fiber compression    (s1 / Xc)^2                                                                 s1 < 0
         matrix tension       (s2 / Yt)^2 + t                                                             s2 >= 0
         matrix compression   (s2 / 2 S23)^2 + ((Yc / 2 S23)^2 - 1) s2 / Yc + t                           s2 < 0
         t = (t12 / S12)^2 + (t13 / S13)^2 + (t23 / S23)^2
         Hashin has one strength for shear along the fibers; here S12 and S13 are two. With infinite S23 the first term of
         matrix compression is zero, and the second -s2 / Yc.
puck     fiber tension        s1 / Xt
         fiber compression    -s1 / Xc
         matrix A             sqrt((t12 / S12)^2 + (1 - p Yt / S12)^2 (s2 / Yt)^2) + p s2 / S12           s2 >= 0
         matrix B             (sqrt(t12^2 + (q s2)^2) + q s2) / S12              s2 < 0, |s2 / t12| <= R / T
         matrix C             ((t12 / (2 (1 + q R / S12) S12))^2 + (s2 / Yc)^2) Yc / -s2                  else
         transverse shear     sqrt((t13 / S13)^2 + (t23 / S23)^2)
         R = S12 / (2 q) (sqrt(1 + 2 q Yc / S12) - 1),   T = S12 sqrt(1 + 2 q R / S12)
         p = 0.35, q = 0.30: inclinations for carbon fibers in epoxy. Of plane stress; Puck's criterion in space searches the
         plane of fracture, here transverse shear is a mode of its own. All grow in proportion to the load.
interlaminar   shear         sqrt((t13 / S13)^2 + (t23 / S23)^2)
         Brewer and Lagace without the normal stress, which plates do not have: delamination by shear. It is the same on both
         sides of an interface, where the stresses of equilibrium are continuous, if its plies have the same S13 and S23.

The index is the largest of the modes; each is one under a single stress component that fails. Modes that a sign rules out are
zero. Differentiable in the stress but where two modes are equal, and at the stress zero, where the gradient given is zero.
Source: Z. Hashin, Failure criteria for unidirectional fiber composites, J. Appl. Mech. 47 (1980) 329-334; A. Puck, J. Kopp,
M. Knops, Guidelines for the determination of the parameters in Puck's action plane strength criterion, Compos. Sci. Technol. 62
(2002) 371-378; J. C. Brewer and P. A. Lagace, Quadratic stress criterion for initiation of delamination, J. Compos. Mater. 22
(1988) 1141-1155. Checked in tests/fem/materials/test_strength.py and test_failure_modes.py.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

INCLINATION_TENSION, INCLINATION_COMPRESSION = 0.35, 0.30


class FailureModes(NamedTuple):
    """Names of the modes, and (stress [..., 5], strength [..., 8]) -> the index of each [..., modes]."""

    names: tuple[str, ...]
    indices: Callable[[Tensor, Tensor], Tensor]

    def __call__(self, stress: Float[Tensor, "*n 5"], strength: Float[Tensor, "*n 8"]) -> Float[Tensor, "*n"]:
        """Return the largest index of the modes."""
        return self.indices(stress, strength).amax(-1)


def _max_stress(stress: Tensor, strength: Tensor) -> Tensor:
    Xt, Xc, Yt, Yc, S12, S13, S23, _ = strength.unbind(-1)
    s1, s2, t12, t13, t23 = stress.unbind(-1)
    parts = (s1 / Xt, -s1 / Xc, s2 / Yt, -s2 / Yc, t12.abs() / S12, t13.abs() / S13, t23.abs() / S23)
    return torch.stack(parts, dim=-1)


def _hashin(stress: Tensor, strength: Tensor) -> Tensor:
    Xt, Xc, Yt, Yc, S12, S13, S23, _ = strength.unbind(-1)
    s1, s2, t12, t13, t23 = stress.unbind(-1)
    along = (t12 / S12) ** 2 + (t13 / S13) ** 2
    shear = along + (t23 / S23) ** 2
    zero = torch.zeros_like(shear)
    parts = (
        torch.where(s1 >= 0.0, (s1 / Xt) ** 2 + along, zero),
        torch.where(s1 < 0.0, (s1 / Xc) ** 2, zero),
        torch.where(s2 >= 0.0, (s2 / Yt) ** 2 + shear, zero),
        torch.where(s2 < 0.0, (s2 / (2 * S23)) ** 2 + ((Yc / (2 * S23)) ** 2 - 1.0) * s2 / Yc + shear, zero),
    )
    return torch.stack(parts, dim=-1)


def _puck(stress: Tensor, strength: Tensor) -> Tensor:
    Xt, Xc, Yt, Yc, S12, *_ = strength.unbind(-1)
    s1, s2, t12, *_ = stress.unbind(-1)
    p, q = INCLINATION_TENSION, INCLINATION_COMPRESSION
    R = S12 / (2 * q) * ((1 + 2 * q * Yc / S12).sqrt() - 1)
    T = S12 * (1 + 2 * q * R / S12).sqrt()
    opened, steep = s2 >= 0.0, -s2 * T > t12.abs() * R
    A = _root((t12 / S12) ** 2 + ((1 - p * Yt / S12) * s2 / Yt) ** 2) + p * s2 / S12
    B = (_root(t12**2 + (q * s2) ** 2) + q * s2) / S12
    pressure = torch.where(steep, -s2, 1.0)
    C = ((t12 / (2 * (1 + q * R / S12) * S12)) ** 2 + (s2 / Yc) ** 2) * Yc / pressure
    zero = torch.zeros_like(A)
    parts = (
        s1 / Xt,
        -s1 / Xc,
        torch.where(opened, A, zero),
        torch.where(opened | steep, zero, B),
        torch.where(steep, C, zero),
        *_interlaminar(stress, strength).unbind(-1),
    )
    return torch.stack(torch.broadcast_tensors(*parts), dim=-1)


def _interlaminar(stress: Tensor, strength: Tensor) -> Tensor:
    S13, S23 = strength[..., 5], strength[..., 6]
    return _root((stress[..., 3] / S13) ** 2 + (stress[..., 4] / S23) ** 2)[..., None]


def _root(x: Tensor) -> Tensor:
    """Square root, of zero with the derivative zero."""
    loaded = x > 0.0
    return torch.where(loaded, torch.where(loaded, x, 1.0).sqrt(), 0.0 * x)


FIBER = ("fiber tension", "fiber compression")
MODES: dict[str, FailureModes] = {
    "max_stress": FailureModes(
        (*FIBER, "matrix tension", "matrix compression", "shear 12", "shear 13", "shear 23"), _max_stress
    ),
    "hashin": FailureModes((*FIBER, "matrix tension", "matrix compression"), _hashin),
    "puck": FailureModes((*FIBER, "matrix A", "matrix B", "matrix C", "transverse shear"), _puck),
    "interlaminar": FailureModes(("shear between layers",), _interlaminar),
}
