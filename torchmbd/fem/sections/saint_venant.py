"""Saint-Venant's solutions of a section, its compliance, and the compliance's derivative in closed form.

<a, b> is the integral of a'b over the section. Columns: c, the classical unit forces (N, T, M_y, M_z); v, the unit shear
forces; T, the moments that grow along the beam under v: M_z' = -V_y, M_y' = V_z, so (..)_T = (..)_c J.

    <B w, D eps_c> = 0              for all warpings w; U the warping of eps_c, <P Z, D eps_c> = 1
    <B w, D eps_v> = <P H w, D eps_T>                     eps_v holds P H U_T; no classical resultants
    S = <eps, D eps>,   K4 = S_cc^-1,   s = S_cv

For a change dD of the stiffness of the layers, with E = B'DB:

    dS_cc = -<eps_c, dD eps_c>
    dS_cv = <zeta, dD eps_T> - <eps_c, dD alpha>
    dS_vv = <eps_v, dD eps_v> - 2 sym <alpha, dD eps_v> + 2 sym <eta, dD eps_T>

    E y = H'P'D eps_T,   E z = B'D P H U,   alpha = B y + eps_c K4 s,   h = y + U K4 s
    zeta = P H U - B z - eps_c K4 <P H U, D eps_c>'
    E n = B'D P H h + H'P'D (eps_v - alpha)
    eta  = P H h - B n - eps_c K4 (<P H h, D eps_c> + <D (eps_v - alpha), P H U>)'

So derivatives in any number of angles cost eight more solutions with the same factors. Derived from the equations
above by reciprocity; y, z, n are the adjoint warpings.
Source of the solutions: V. Giavotto et al. (1983), see section.py.
Checked in tests/fem/sections/test_section_gradients.py.
"""

from __future__ import annotations

from functools import partial
from types import FunctionType
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.fem.sections.geometry import SectionGeometry
from torchmbd.fem.sections.warping import WarpingProblem, solve
from torchmbd.math.forward_mode import jvp
from torchmbd.math.inverse import balanced_inverse
from torchmbd.math.vmap import FirstDerivative, apply_as_lanes
from torchmbd.process import one_thread

CLASSICAL, SHEAR = [0, 3, 4, 5], [1, 2]

_NUMBERS = 1_000_000  # entries of a field of the designs that are analyzed at once: 8 MB
_NUMBERS_OF_DIRECTIONS = 4_000_000  # of its tangents: all share what is computed for the values

#: J of the module header: growth of (N, T, M_y, M_z) along the beam for unit V_y, V_z.
_GROWTH = torch.zeros(4, 2, dtype=torch.float64)
_GROWTH[3, 0], _GROWTH[2, 1] = -1.0, 1.0


class UnitFields(NamedTuple):
    """Fields [..., m, g, 6, columns] of unit forces, and the warping U [..., freedoms, 4] of the classical ones."""

    warping: Tensor
    strain: Float[Tensor, "*lanes m g 6 6"]
    stress: Float[Tensor, "*lanes m g 6 6"]


def unit_fields(problem: WarpingProblem, g: SectionGeometry, D: Float[Tensor, "*lanes layers 6 6"]) -> UnitFields:
    """Solve for the six unit forces, in the order N, V_y, V_z, T, M_y, M_z. Differentiable in D and in the geometry g."""
    E = g.element_stiffness(D)
    rigid = g.rigid_strain(torch.eye(6, dtype=D.dtype)[:, CLASSICAL])
    u0 = -solve(problem, E, g.warp_force(g.stress(D, rigid)))
    strain = rigid + g.warp_strain(u0)
    stress = g.stress(D, strain)
    S4 = balanced_inverse(g.resultant(stress)[..., CLASSICAL, :])
    U, pure, pure_stress = u0 @ S4, strain @ _columns(S4), stress @ _columns(S4)
    rate_strain = g.warping_rate_strain(U @ _GROWTH)
    u1 = solve(problem, E, g.face_force(pure_stress @ _GROWTH) - g.warp_force(g.stress(D, rate_strain)))
    bent = rate_strain + g.warp_strain(u1)
    bent_stress = g.stress(D, bent)
    rest = _columns(g.resultant(bent_stress)[..., CLASSICAL, :])
    shear, shear_stress = bent - pure @ rest, bent_stress - pure_stress @ rest
    return UnitFields(U, _ordered(pure, shear), _ordered(pure_stress, shear_stress))


def held_stress(
    problem: WarpingProblem,
    g: SectionGeometry,
    D: Float[Tensor, "*lanes layers 6 6"],
    free: Float[Tensor, "*lanes m g 6 1"],
) -> Float[Tensor, "*lanes m g 6 1"]:
    """Return the stress of free strains in a section whose generalized strains are zero; its warping is free."""
    held = -free
    u = -solve(problem, g.element_stiffness(D), g.warp_force(g.stress(D, held)))
    return g.stress(D, held + g.warp_strain(u))


def compliance(
    problem: WarpingProblem, x: Float[Tensor, "*lanes e"], D: Float[Tensor, "*lanes layers 6 6"]
) -> Float[Tensor, "*lanes 6 6"]:
    """Return S of a section of dimensions x; differentiable once in x and D. Equal designs are computed once."""
    lanes = torch.Size(np.broadcast_shapes(x.shape[:-1], D.shape[:-3]))
    one_axis = (x.expand(*lanes, -1).reshape(lanes.numel(), -1), D.expand(*lanes, -1, 6, 6).reshape(-1, *D.shape[-3:]))
    return _Compliance.apply(problem, *one_axis).reshape(*lanes, 6, 6)


class _Compliance(torch.autograd.Function):
    """(x [lane, e], D [lane, layers, 6, 6]) -> S [lane, 6, 6]."""

    @staticmethod
    def forward(problem: WarpingProblem, x: Tensor, D: Tensor) -> Tensor:
        return _for_distinct_designs(_energy, problem, x, D)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Tensor) -> None:
        ctx.problem, *saved = inputs
        ctx.set_materialize_grads(False)
        ctx.save_for_forward(*saved)
        ctx.save_for_backward(*saved)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, problem: WarpingProblem, x: Tensor, D: Tensor) -> tuple:
        return apply_as_lanes(partial(_Compliance.apply, problem), info, in_dims[1:], x, D)

    @staticmethod
    def jvp(ctx: Any, _: Any, dx: Tensor | None, dD: Tensor | None) -> Tensor:
        dS: Any = 0.0
        if dx is not None:
            dS = torch.einsum("lije,le->lij", _Jacobian.apply(_by_dimensions, ctx.problem, *ctx.saved_tensors), dx)
        if dD is not None:
            by_D = _Jacobian.apply(_by_stiffness, ctx.problem, *ctx.saved_tensors)
            dS = dS + torch.einsum("lijkab,lkab->lij", by_D, dD)
        return dS

    @staticmethod
    def backward(ctx: Any, S_bar: Tensor | None) -> Any:
        x_bar = D_bar = None
        if S_bar is not None and ctx.needs_input_grad[1]:
            by_x = _Jacobian.apply(_by_dimensions, ctx.problem, *ctx.saved_tensors)
            x_bar = torch.einsum("lij,lije->le", S_bar, by_x)
        if S_bar is not None and ctx.needs_input_grad[2]:
            by_D = _Jacobian.apply(_by_stiffness, ctx.problem, *ctx.saved_tensors)
            D_bar = torch.einsum("lij,lijkab->lkab", S_bar, by_D)
        return None, x_bar, D_bar


class _Jacobian(FirstDerivative):
    """dS / dx or dS / dD, by `_by_dimensions` or `_by_stiffness`."""

    of = "section stiffness"

    @staticmethod
    def forward(f: FunctionType, problem: WarpingProblem, x: Tensor, D: Tensor) -> Tensor:
        return _for_distinct_designs(f, problem, x, D)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, f: FunctionType, problem: WarpingProblem, x: Tensor, D: Tensor) -> tuple:
        return apply_as_lanes(partial(_Jacobian.apply, f, problem), info, in_dims[2:], x, D)


@one_thread()
def _for_distinct_designs(f: FunctionType, problem: WarpingProblem, x: Tensor, D: Tensor) -> Tensor:
    """Return f of all designs: equal designs are computed once, in groups whose fields fit into the cache."""
    designs, which = torch.unique(torch.cat([x, D.flatten(1)], 1), dim=0, return_inverse=True)
    parts = designs.split(max(1, _NUMBERS // problem.geometry.field_size))

    def of_designs() -> Tensor:
        return torch.cat([f(problem, y[:, : x.shape[1]], y[:, x.shape[1] :].unflatten(1, D.shape[1:])) for y in parts])

    return problem.result(f.__name__, designs, of_designs)[which]


def _energy(problem: WarpingProblem, x: Tensor, D: Tensor) -> Float[Tensor, "lane 6 6"]:
    g = problem.geometry.with_dimensions(x)
    fields = unit_fields(problem, g, D)
    return g.energy(fields.strain, fields.stress)


def _by_dimensions(problem: WarpingProblem, x: Tensor, D: Tensor) -> Float[Tensor, "lane 6 6 e"]:
    """dS_ij / dx_e, by the chain of the solutions."""
    units = torch.eye(x.shape[1], dtype=x.dtype)[:, None].expand(-1, len(x), -1)
    energy = partial(_energy, problem, D=D)
    many = max(1, _NUMBERS_OF_DIRECTIONS // (len(x) * problem.geometry.field_size))
    return torch.vmap(lambda e: jvp(energy, (x,), (e,))[1], out_dims=-1, chunk_size=many)(units)


def _by_stiffness(problem: WarpingProblem, x: Tensor, D: Tensor) -> Float[Tensor, "lane 6 6 layers 6 6"]:
    """dS_ij / dD_kab, for symmetric changes of D."""
    g = problem.geometry.with_dimensions(x)
    U, strain, stress = unit_fields(problem, g, D)
    E = g.element_stiffness(D)
    eps_c, eps_v, sig_c, sig_v = strain[..., CLASSICAL], strain[..., SHEAR], stress[..., CLASSICAL], stress[..., SHEAR]
    eps_T, sig_T = eps_c @ _GROWTH, sig_c @ _GROWTH
    K4, s = balanced_inverse(g.energy(eps_c, sig_c)), g.energy(eps_c, sig_v)
    rate_strain = g.warping_rate_strain(U)  # P H U
    adjoint = solve(problem, E, torch.cat([g.face_force(sig_T), g.warp_force(g.stress(D, rate_strain))], dim=-1))
    y, z = adjoint[..., :2], adjoint[..., 2:]
    zeta = rate_strain - g.warp_strain(z) - eps_c @ _columns(K4 @ g.energy(rate_strain, sig_c).mT)
    alpha = g.warp_strain(y) + eps_c @ _columns(K4 @ s)
    swept = g.warping_rate_strain(y + U @ (K4 @ s))  # P H h
    rest = sig_v - g.stress(D, alpha)
    n = solve(problem, E, g.warp_force(g.stress(D, swept)) + g.face_force(rest))
    Y = g.energy(swept, sig_c) + g.energy(rest, rate_strain)
    eta = swept - g.warp_strain(n) - eps_c @ _columns(K4 @ Y.mT)
    layers = D.shape[-3]
    cc = -_pairs(g, eps_c, eps_c, layers)
    cv = _pairs(g, zeta, eps_T, layers) - _pairs(g, eps_c, alpha, layers)
    vv = _pairs(g, eta, eps_T, layers) - _pairs(g, alpha, eps_v, layers) + _pairs(g, eps_v, eps_v, layers) / 2
    result = cc.new_zeros(len(D), 6, 6, layers, 6, 6)
    c, v = torch.tensor(CLASSICAL), torch.tensor(SHEAR)
    result[:, c[:, None], c] = cc
    result[:, c[:, None], v] = cv
    result[:, v[:, None], c] = cv.transpose(1, 2)
    result[:, v[:, None], v] = vv + vv.transpose(1, 2)
    return result


def _pairs(g: SectionGeometry, first: Tensor, second: Tensor, layers: int) -> Float[Tensor, "lane p q layers 6 6"]:
    """first_a second_b integrated over each layer, for all pairs of columns."""
    p, q = first.shape[-1], second.shape[-1]
    weighted = g.weight[..., None, None] * first
    result = first.new_zeros(len(first), p, q, layers, 6, 6)
    for k in range(layers):
        elements = (g.layer == k).nonzero()[:, 0]
        a, b = (x[:, elements].flatten(1, 2).flatten(2) for x in (weighted, second))  # [lane, points, 6 columns]
        result[:, :, :, k] = (a.mT @ b).unflatten(-1, (6, q)).unflatten(-3, (6, p)).permute(0, 2, 4, 1, 3)
    return result


def _columns(matrix: Tensor) -> Tensor:
    """A matrix [..., p, q] that acts on the columns of a field [..., m, g, 6, p]."""
    return matrix[..., None, None, :, :]


def _ordered(classical: Tensor, shear: Tensor) -> Tensor:
    """Columns c and v in the order N, V_y, V_z, T, M_y, M_z."""
    return torch.cat([classical[..., :1], shear, classical[..., 1:]], dim=-1)
