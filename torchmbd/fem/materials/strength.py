"""Strength of a unidirectional ply, and criteria of its failure.

    tsai_wu       F1 s1 + F2 s2 + F11 s1^2 + F22 s2^2 + 2 F12 s1 s2 + t12^2 / S12^2 + t13^2 / S13^2 + t23^2 / S23^2
                  F1 = 1 / Xt - 1 / Xc,  F11 = 1 / (Xt Xc),  F2, F22 likewise,  F12 = interaction sqrt(F11 F22)
    tsai_wu_irf   inverse reserve factor 1 / R: the Tsai-Wu index of R times the stress is one; grows in proportion to
                  the load, so it is the better scaled one for a constraint
    max_stress    largest of s1 / Xt, -s1 / Xc, s2 / Yt, -s2 / Yc, |t12| / S12, |t13| / S13, |t23| / S23
    hashin, puck  with modes of failure (failure_modes.py)

Each is below one where the ply holds, and all are one together under a single stress component that fails.
stress   s11, s22, t12, t13, t23 in ply axes     [..., 5]  Pa
Differentiable in the stress (a sub-gradient where two terms of max_stress are equal, or the stress is zero).

`FailureForms`, of many points under many loads, has the criteria as forms of few coordinates w:

    stress = basis w,      linear = f' basis w,      quadratic = w' (basis' F basis) w

So the indices of all points are one product of (w_i, w_i w_j) with coefficients of the points, without the stresses. For
max_stress they are the largest of ten linear forms; other criteria of several modes take the stresses. No autograd inside: this
finds the point that is nearest to failure.

Source: S. W. Tsai and E. M. Wu, A general theory of strength for anisotropic materials, J. Compos. Mater. 5 (1971);
R. M. Jones, Mechanics of Composite Materials, 2nd ed., section 2.9.
Checked in tests/fem/materials/test_strength.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.materials.failure_modes import MODES
from torchmbd.math.checked_numbers import is_real
from torchmbd.math.gradients import untransformed
from torchmbd.math.plausible_units import STRENGTH, warn_unusual
from torchmbd.math.variable import check_positive, number, stacked

#: The stresses and strains of a ply, in this order; 1 = fiber, 3 = thickness. Shear strains are engineering strains.
PLY_COMPONENTS = ("11", "22", "12", "13", "23")


@dataclass(frozen=True)
class Strength:
    """Strengths of one ply [Pa], all positive.

    Xt, Xc        tension and compression along the fiber
    Yt, Yc        across it
    S12           shear in the plane
    S13, S23      infinite by default: transverse shear stresses do not count
    interaction   F12 / sqrt(F11 F22) of Tsai-Wu, in (-1, 1)

    A finite strength may be mbd.variable(...): a design variable, "ply.strength.Xt" of a laminate.

    >>> strength = mbd.Strength(Xt=1.5e9, Xc=1.2e9, Yt=50e6, Yc=250e6, S12=70e6)
    >>> carbon = mbd.Ply(128e9, 10.1e9, 5.36e9, 5.36e9, 3.6e9, 0.23, 1586.0, strength=strength)
    """

    positive: ClassVar[tuple[str, ...]] = ("Xt", "Xc", "Yt", "Yc", "S12", "S13", "S23")
    Xt: float | Tensor
    Xc: float | Tensor
    Yt: float | Tensor
    Yc: float | Tensor
    S12: float | Tensor
    S13: float | Tensor = math.inf
    S23: float | Tensor = math.inf
    interaction: float | Tensor = -0.5

    def __post_init__(self) -> None:
        check_positive(self, " Pa", infinite=True)
        for name in self.positive:
            warn_unusual(f"Strength: {name}", number(getattr(self, name)), "Pa", STRENGTH)
        ratio = number(self.interaction)
        if not (is_real(ratio) and -1.0 < ratio < 1.0):
            raise InputError(
                "interaction",
                ratio,
                "above -1 and below 1, or mbd.variable(...) of such a number",
                noun="Strength: interaction",
            )

    def numbers(self) -> Float[Tensor, "*lanes 8"]:
        """Collect Xt, Xc, Yt, Yc, S12, S13, S23, interaction in one tensor for the criteria."""
        return stacked([*(getattr(self, name) for name in self.positive), self.interaction])


def tsai_wu(stress: Float[Tensor, "*n 5"], strength: Float[Tensor, "*n 8"]) -> Float[Tensor, "*n"]:
    """Tsai-Wu index; `strength` are `Strength.numbers()`, one row for all points or one for each."""
    linear, quadratic = _tsai_wu_parts(stress, strength)
    return linear + quadratic


def tsai_wu_irf(stress: Float[Tensor, "*n 5"], strength: Float[Tensor, "*n 8"]) -> Float[Tensor, "*n"]:
    """Inverse reserve factor of Tsai-Wu, the positive root of x^2 - linear x - quadratic = 0."""
    return inverse_reserve_factor(*_tsai_wu_parts(stress, strength))


def inverse_reserve_factor(linear: Float[Tensor, "*n"], quadratic: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """The positive root x of x^2 - linear x - quadratic = 0."""
    square = linear**2 + 4.0 * quadratic
    loaded = square > 0.0
    return torch.where(loaded, 0.5 * (linear + torch.where(loaded, square, 1.0).sqrt()), 0.0 * square)


def tsai_wu_forms(strength: Float[Tensor, "*n 8"]) -> tuple[Float[Tensor, "*n 5"], Float[Tensor, "*n 5 5"]]:
    """The linear form of Tsai-Wu in the stress, and the matrix of the quadratic one."""
    Xt, Xc, Yt, Yc, S12, S13, S23, interaction = strength.unbind(-1)
    F11, F22 = 1.0 / (Xt * Xc), 1.0 / (Yt * Yc)
    none = torch.zeros_like(Xt)
    linear = torch.stack([1.0 / Xt - 1.0 / Xc, 1.0 / Yt - 1.0 / Yc, none, none, none], dim=-1)
    quadratic = torch.diag_embed(torch.stack([F11, F22, S12**-2, S13**-2, S23**-2], dim=-1))
    quadratic[..., 0, 1] = quadratic[..., 1, 0] = interaction * (F11 * F22).sqrt()
    return linear, quadratic


def _tsai_wu_parts(stress: Tensor, strength: Tensor) -> tuple[Tensor, Tensor]:
    """The parts that are linear and quadratic in the stress."""
    f, F = tsai_wu_forms(strength)
    return (f * stress).sum(-1), (stress * (F @ stress[..., None])[..., 0]).sum(-1)


CRITERIA: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "tsai_wu": tsai_wu,
    "tsai_wu_irf": tsai_wu_irf,
    **MODES,
}


class FailureForms:
    """Failure indices of points.

    criterion   a name of CRITERIA
    basis       stresses of the points for unit coordinates [Pa]
    strength    numbers of the strengths of the points
    """

    def __init__(self, criterion: str, basis: Float[Tensor, "points 5 k"], strength: Float[Tensor, "points 8"]) -> None:
        assert criterion in CRITERIA
        self.criterion, k = criterion, basis.shape[-1]
        if criterion == "max_stress":
            Xt, Xc, Yt, Yc, *shear, _ = strength.unbind(-1)
            limits = torch.stack([Xt, -Xc, Yt, -Yc, *shear, *(-S for S in shear)])
            rows = basis.transpose(0, 1)[[0, 0, 1, 1, 2, 3, 4, 2, 3, 4]]
            self.forms = [rows / limits[..., None]]
            return
        if criterion in MODES:
            self.forms = [basis.flatten(0, 1), strength]
            return
        f, F = tsai_wu_forms(strength)
        quadratic = basis.mT @ F @ basis
        self._pairs = torch.triu_indices(k, k)
        twice = 2.0 - (self._pairs[0] == self._pairs[1]).to(basis)
        self.forms = [(f[:, None] @ basis)[:, 0], quadratic[:, self._pairs[0], self._pairs[1]] * twice]

    def __call__(self, w: Float[Tensor, "n k"]) -> Float[Tensor, "n points"]:
        """Return the indices of all points under each of n loads."""
        if self.criterion == "max_stress":
            return (w @ self.forms[0].mT).amax(0)
        if self.criterion in MODES:
            stress = (w @ self.forms[0].mT).unflatten(1, (-1, 5))
            return CRITERIA[self.criterion](stress, self.forms[1])
        pairs = w[:, self._pairs[0]] * w[:, self._pairs[1]]
        if self.criterion == "tsai_wu":
            return torch.cat([w, pairs], 1) @ torch.cat(self.forms, 1).mT
        return inverse_reserve_factor(w @ self.forms[0].mT, pairs @ self.forms[1].mT)


def missing_strength(body: str) -> InputError:
    """Build the error for a body of which a ply has no strength."""
    allowed, hint = "must have a strength", "Ply(..., strength=Strength(...))"
    return InputError("body", body, allowed, hint, state="has no strength", noun=f"a ply of body {body!r}")


def required_strength(body: str, numbers: Float[Tensor, "... 8"] | None, criterion: str) -> Float[Tensor, "... 8"]:
    """Return strengths of plies; InputError if one lacks them, or those that the criterion compares with."""
    if numbers is None:
        raise missing_strength(body)
    if criterion == "interlaminar" and bool(untransformed(numbers)[..., 5:7].isinf().all(-1).any()):
        allowed, state = "must have finite strengths", "has infinite strengths S13 and S23"
        hint, noun = "Strength(..., S13=..., S23=...), or another criterion", f"{criterion!r}: a ply of body {body!r}"
        raise InputError("criterion", criterion, allowed, hint, state=state, noun=noun)
    return numbers
