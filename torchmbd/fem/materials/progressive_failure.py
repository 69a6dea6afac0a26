"""Failure of a laminate ply by ply under section forces that grow in proportion: from the first ply to the last.

    (eps, kappa) = load [A B; B D]^-1 (N, M),     stress of a ply = Q T (eps + z kappa)

The first mode of a ply that is reached at its bottom or its top takes the ply's stiffness away: a mode of the fibers all of
it, any other E2, G12 and the coupling between 1 and 2; of a fiber and a matrix mode at the same load (Hashin's in pure shear)
that of the matrix comes first. A small share stays, so that the laminate's stiffness can be inverted.
Forces are then shared anew; plies that cannot hold them under the present load fail at the same load. The end is where
the forces meet no stiffness but these shares. Damage does not grow within a ply, and transverse shear forces are left out.
Source: R. M. Jones, Mechanics of Composite Materials, 2nd ed., section 4.5 (ply discount).
Checked in tests/fem/materials/test_progressive_failure.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError, unknown
from torchmbd.fem.materials.failure_modes import FIBER, MODES, FailureModes
from torchmbd.fem.materials.laminate import Laminate, strain_rotations
from torchmbd.math.checked_numbers import is_real, reals
from torchmbd.math.gradients import carries_gradient

HALVINGS, WIDEST = 64, 30.0  # of the search for a load, in decades to both sides of one
COLLAPSED = 1e-2  # of 1 / kept: the compliance by that of the whole laminate where nothing else is left
TOGETHER = 1e-9  # plies whose loads differ by less fail at once
ROUNDING = 1e-13  # stresses below this share of the largest one are none
PLANE_CRITERIA = tuple(name for name in MODES if name != "interlaminar")


class PlyLoss(NamedTuple):
    """A step of progressive failure.

    load    factor of the given forces at which it happens; not less than the load of the previous step
    layers  which layers fail, 0 at the bottom
    mode    of the first of them, such as "matrix tension"
    """

    load: Tensor
    layers: list[int]
    mode: str


def progressive_failure(
    laminate: Laminate,
    force: Sequence[float] | Tensor = (0.0, 0.0, 0.0),
    moment: Sequence[float] | Tensor = (0.0, 0.0, 0.0),
    criterion: str = "puck",
    kept: float = 1e-6,
) -> list[PlyLoss]:
    """Compute the loads of a laminate from first-ply failure until it cannot carry more load.

    force      N_xx, N_yy, N_xy [N/m];   moment: M_xx, M_yy, M_xy [N]
    criterion  "puck", "hashin" or "max_stress"; plies have a Strength, for the first two with finite Xt, Xc, Yt, Yc, S12
    kept       share of the stiffness that a failed ply keeps, at most 1e-3

    The first load causes first-ply failure, the last one is the largest that the laminate carries. Loads have gradients with
    respect to the laminate's parameters and the forces, if the order of the steps does not change.

    >>> strength = mbd.Strength(Xt=1.5e9, Xc=1.5e9, Yt=40e6, Yc=246e6, S12=68e6)
    >>> ply = mbd.Ply(181e9, 10.3e9, 7.17e9, 7.17e9, 7.17e9, 0.28, 1600.0, strength=strength)
    >>> cross = mbd.Laminate(ply, mbd.deg([0, 90, 0]), 5e-3)
    >>> steps = mbd.progressive_failure(cross, force=(1e6, 0, 0))
    >>> [(round(step.load.item(), 2), step.layers, step.mode) for step in steps]
    [(7.31, [1], 'matrix A'), (15.0, [0, 2], 'fiber tension')]
    """
    loads = _checked(laminate, force, moment, criterion, kept)
    strengths = [ply.strength for ply in laminate.layer_plies]
    missing = [k for k, strength in enumerate(strengths) if strength is None]
    if missing:
        raise InputError(
            "laminate",
            allowed="must have a strength",
            state="has no strength",
            noun=f"the ply of layer {missing[0]}",
            hint="Ply(..., strength=Strength(...))",
        )
    numbers = torch.stack([strength.numbers() for strength in strengths if strength is not None])[:, None]
    if criterion != "max_stress" and not numbers[..., :5].isfinite().all():
        raise InputError(
            "criterion",
            criterion,
            allowed=f"must have finite strengths in the plane for criterion {criterion!r}",
            state="has an infinite strength in its plane",
            noun="a ply",
        )
    rule = MODES[criterion]
    of_fiber = torch.tensor([name in FIBER for name in rule.names])
    fiber, matrix = torch.ones(len(numbers), dtype=torch.bool), torch.ones(len(numbers), dtype=torch.bool)
    steps: list[PlyLoss] = []
    softest = math.inf
    while fiber.any():
        strain, stress = _state(laminate, loads, torch.where(fiber, 1.0, kept), torch.where(matrix, 1.0, kept))
        compliance = float((loads @ strain).detach())
        if compliance > softest:
            break
        softest = min(softest, COLLAPSED / kept * compliance)
        alive = torch.where(of_fiber, fiber[:, None], matrix[:, None])[:, None]
        reached = torch.where(alive, _reached(rule, stress.detach(), numbers.detach()), torch.inf).amin(1)
        least = reached.min()
        if not least.isfinite():
            break
        # Of modes at the same load that of the matrix: which sign rounding gives a stress of zero must not decide.
        of_matrix = (reached <= least * (1.0 + TOGETHER))[:, ~of_fiber].any(1, keepdim=True)
        reached = torch.where(of_matrix & of_fiber, torch.inf, reached)
        failing = (reached <= least * (1.0 + TOGETHER)).any(1)
        layer = int(failing.nonzero()[0])
        mode = int(reached[layer].argmin())
        load = _exact(rule, stress[layer], numbers[layer], mode, reached[layer, mode])
        if steps:
            load = torch.maximum(load, steps[-1].load)
        steps.append(PlyLoss(load, failing.nonzero().flatten().tolist(), rule.names[mode]))
        broken = failing & (reached[:, of_fiber] <= least * (1.0 + TOGETHER)).any(1)
        fiber, matrix = fiber & ~broken, matrix & ~failing
    return steps


def _state(
    laminate: Laminate, loads: Tensor, fiber: Float[Tensor, " layers"], matrix: Float[Tensor, " layers"]
) -> tuple[Float[Tensor, " 6"], Float[Tensor, "layers 2 5"]]:
    """Strains of the unit load, and stresses at the bottom and the top of every layer, with these shares of its stiffness."""
    compliance = torch.linalg.inv(laminate.layer_stiffness[0])
    share = torch.stack([fiber, matrix, matrix], -1)
    Q = torch.linalg.inv(compliance + torch.diag_embed(compliance.diagonal(dim1=-2, dim2=-1) * (1.0 / share - 1.0)))
    T, _ = strain_rotations(laminate.layer_angles)
    Qbar, faces = T.mT @ Q @ T, laminate.faces
    A, B, D = (((faces[:, 1] ** n - faces[:, 0] ** n)[:, None, None] / n * Qbar).sum(0) for n in (1, 2, 3))
    strain = torch.linalg.solve(torch.cat([torch.cat([A, B], 1), torch.cat([B, D], 1)]), loads)
    at = strain[:3] + faces[..., None] * strain[3:]
    plane = ((Q @ T)[:, None] @ at[..., None])[..., 0]
    plane = torch.where(plane.abs() > ROUNDING * plane.detach().abs().max(), plane, 0.0)
    return strain, torch.cat([plane, torch.zeros_like(plane[..., :2])], -1)


def _reached(rule: FailureModes, stress: Tensor, strength: Tensor) -> Float[Tensor, "layers 2 modes"]:
    """Return the load at which the index of each mode becomes one; infinite where it never does."""

    def failed(load: Tensor) -> Tensor:
        # Every mode at every load.
        indices = rule.indices(load[..., None] * stress.unsqueeze(-2), strength.unsqueeze(-2))
        return indices.diagonal(dim1=-2, dim2=-1) >= 1.0

    low = stress.new_full((*stress.shape[:2], len(rule.names)), -WIDEST)
    high = -low
    never = ~failed(10.0**high)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        fails = failed(10.0**middle)
        low, high = torch.where(fails, low, middle), torch.where(fails, middle, high)
    return torch.where(never, torch.inf, 10.0**high)


def _exact(rule: FailureModes, stress: Tensor, strength: Tensor, mode: int, load: Tensor) -> Tensor:
    """Return the failure load of one layer with its derivatives, by one step of Newton's method from the load of `_reached`."""
    face = int(_reached(rule, stress[None].detach(), strength[None].detach())[0, :, mode].argmin())

    def index(x: Tensor) -> Tensor:
        return rule.indices(x * stress[face], strength[0])[mode]

    slope = torch.func.grad(lambda x: rule.indices(x * stress[face].detach(), strength[0].detach())[mode])(load)
    return load - (index(load) - 1.0) / slope


def _checked(
    laminate: object, force: Sequence[float] | Tensor, moment: Sequence[float] | Tensor, criterion: str, kept: float
) -> Tensor:
    if type(laminate) is not Laminate or laminate.angles.ndim != 1:  # those of other classes have no stack of plies
        raise InputError("laminate", laminate, "one Laminate, whose angles are one row")
    if criterion not in PLANE_CRITERIA:
        raise unknown("criterion", criterion, PLANE_CRITERIA)
    if not is_real(kept) or not 0.0 < kept <= 1e-3:
        raise InputError("kept", kept, "a number in (0, 1e-3]")
    both = [
        x.double() if isinstance(x, Tensor) and carries_gradient(x) else reals(name, x)
        for name, x in (("force", force), ("moment", moment))
    ]
    for name, x in zip(("force", "moment"), both, strict=True):
        if x.shape != (3,) or not x.isfinite().all():
            raise InputError(name, x.tolist(), "three finite numbers xx, yy, xy", shown=f"{x.tolist()}")
    loads = torch.cat(both)
    if not loads.any():
        raise InputError("force", allowed="a load that is not zero", state="are zero", noun="force and moment")
    return loads
