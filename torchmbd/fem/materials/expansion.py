"""Thermal and moisture expansion of laminates, by classical lamination.

    e_k(z) = alpha_k (T0 + z T1) + beta_k C        free strain of a ply, 11 and 22, in its axes; shear is zero
    N = sum_k Qbar_k int ebar_k dz,    M = sum_k Qbar_k int ebar_k z dz
    [A B; B D] (eps, kappa) = (N, M)               the free laminate carries no forces
    sigma_k(z) = Q_k (T_k (eps + z kappa) - e_k(z))

T0, T1         change of temperature at z = 0, the surface of the nodes [K], and per meter along the normal [K/m]
C              change of moisture, a share of the mass [-]
N, M           forces [N/m] and moments [N] that would cause the same strains; the opposite ones hold the laminate as it was
eps, kappa     strains xx, yy, xy of this surface, and curvatures [1/m], of the free laminate
sigma          residual stresses 11, 22, 12 in ply axes [Pa]

Differentiable, forward and reverse, in angles, thicknesses, numbers of plies, and in the changes.
Source: R. M. Jones, Mechanics of Composite Materials, 2nd ed., section 4.5; J. N. Reddy, Mechanics of Laminated Composite
Plates and Shells, 2nd ed., section 3.3.
Checked in tests/fem/materials/test_expansion.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.math.checked_numbers import is_real
from torchmbd.math.variable import stacked

_COEFFICIENTS = {"temperature": ("alpha1", "alpha2"), "moisture": ("beta1", "beta2")}
_KINDS = {"temperature": ("temperature", "gradient"), "moisture": ("moisture",)}  # changes by the coefficients of each


class Expansion(NamedTuple):
    """Strains and stresses of a free laminate.

    force      N [..., 3] [N/m], moment M [..., 3] [N]: loads that would cause the same strain and curvature
    strain     xx, yy, xy of the surface of the nodes [..., 3], curvature [..., 3] [1/m]: of the free laminate
    stress     11, 22, 12 of each layer at its bottom and top, from the bottom of the stack [..., layers, 2, 3] [Pa]
    """

    force: Float[Tensor, "*lanes 3"]
    moment: Float[Tensor, "*lanes 3"]
    strain: Float[Tensor, "*lanes 3"]
    curvature: Float[Tensor, "*lanes 3"]
    stress: Float[Tensor, "*lanes layers 2 3"]


class HeldExpansion(NamedTuple):
    """Loads and stresses that would cause the free strains of a laminate; a laminate that is held carries the opposite ones.

    force      N [..., 3] [N/m], moment M [..., 3] [N]
    stress     11, 22, 12 of each layer at its bottom and top, from the bottom of the stack [..., layers, 2, 3] [Pa]
    """

    force: Float[Tensor, "*lanes 3"]
    moment: Float[Tensor, "*lanes 3"]
    stress: Float[Tensor, "*lanes layers 2 3"]


class FreeStrains(NamedTuple):
    """Free strains 11, 22, 12 of each layer in its axes: at z = 0, and by height [1/m]."""

    middle: Float[Tensor, "*lanes layers 3"]
    slope: Float[Tensor, "*lanes layers 3"]


def free_strains(plies: Sequence[Any], temperature: Any, gradient: Any, moisture: Any) -> FreeStrains:
    """Return the free strains of all layers; InputError for a change that is not a number, or a ply without coefficients."""
    changes = {"temperature": temperature, "gradient": gradient, "moisture": moisture}
    for name, x in changes.items():
        is_number = isinstance(x, Tensor) and x.is_floating_point() and bool(torch.isfinite(x.detach()).all())
        if not ((is_real(x) and math.isfinite(x)) or is_number):
            raise InputError(name, x, "a finite number, or a tensor of them [lanes]")
    acting = {name: any(_acts(changes[key]) for key in keys) for name, keys in _KINDS.items()}
    rows = {name: coefficients(plies, name) if acts else None for name, acts in acting.items()}
    none = torch.zeros(len(plies), 3, dtype=torch.float64)
    thermal, moist = (none if row is None else row for row in rows.values())
    T0, T1, C = (_column(x) for x in (temperature, gradient, moisture))
    return FreeStrains(thermal * T0 + moist * C, thermal * T1)


def _acts(change: Any) -> bool:
    return isinstance(change, Tensor) or change != 0.0


def _column(change: Any) -> Tensor:
    """A change [] or [lanes] as a factor of numbers [lanes, layers, 3]."""
    return torch.as_tensor(change, dtype=torch.float64)[..., None, None]


def coefficients(plies: Sequence[Any], change: str, owner: str = "laminate") -> Float[Tensor, "*lanes layers 3"]:
    """Return the coefficients 11, 22, 12 of all layers for "temperature" or "moisture"; InputError that names a ply without."""
    rows = []
    for k, ply in enumerate(plies):
        values = [getattr(ply, name, None) for name in _COEFFICIENTS[change]]
        missing = [name for name, x in zip(_COEFFICIENTS[change], values, strict=True) if x is None]
        if missing:
            raise InputError(
                missing[0],
                None,
                f"must have {' and '.join(missing)}",
                hint=f"mbd.Ply(..., {', '.join(f'{name}=...' for name in _COEFFICIENTS[change])})",
                noun=f"{change} acts on layer {k} of the {owner}, whose ply",
                state=f"has no {' and no '.join(missing)}",
            )
        rows.append(stacked([*values, 0.0]))
    lanes = torch.broadcast_tensors(*rows)
    return torch.stack(lanes, -2)


def held_expansion(
    strains: FreeStrains,
    T: Float[Tensor, "*lanes layers 3 3"],
    Q: Float[Tensor, "*lanes layers 3 3"],
    faces: Float[Tensor, "*lanes layers 2"],
    moments: tuple[Tensor, Tensor, Tensor],
) -> HeldExpansion:
    """Return loads and stresses that would cause the free strains.

    T        strains in plate axes to ply axes
    Q        stiffness of the layers in their axes [Pa]
    faces    heights of bottom and top of each layer [m]
    moments  integrals of 1, z, z^2 over each layer
    """
    plies = [(Q @ x[..., None])[..., 0] for x in strains]
    middle, slope = ((T.mT @ x[..., None])[..., 0] for x in plies)  # in plate axes
    H0, H1, H2 = (h[..., None] for h in moments)
    force, moment = (middle * H0 + slope * H1).sum(-2), (middle * H1 + slope * H2).sum(-2)
    return HeldExpansion(force, moment, plies[0][..., None, :] + faces[..., None] * plies[1][..., None, :])


def free_expansion(
    held: HeldExpansion,
    T: Float[Tensor, "*lanes layers 3 3"],
    Q: Float[Tensor, "*lanes layers 3 3"],
    faces: Float[Tensor, "*lanes layers 2"],
    ABD: tuple[Tensor, Tensor, Tensor],
) -> Expansion:
    """Return the strains and residual stresses of a free laminate.

    held   loads and stresses that would cause the free strains of its layers
    ABD    plate stiffness A, B, D, each [..., 3, 3]
    """
    force, moment, stress = held
    A, B, D = ABD
    matrix = torch.cat([torch.cat([A, B], -1), torch.cat([B, D], -1)], -2)
    loads = torch.cat([force, moment], -1)
    strain, curvature = torch.linalg.solve(matrix.expand(*loads.shape[:-1], 6, 6), loads).split(3, -1)
    z = faces[..., None]
    total = strain[..., None, None, :] + z * curvature[..., None, None, :]
    elastic = torch.einsum("...kij,...kfj->...kfi", Q @ T, total)
    return Expansion(force, moment, strain, curvature, elastic - stress)
