"""Damping of the modes of a body: in proportion to its stiffness, and a damping ratio for each mode.

    D = c Kr + V diag(2 z_k om_k) V'            Kr = V diag(om_k^2) V'

c   time of the stiffness-proportional part                       [s]
z   damping ratios of the modes, by growing frequency om [rad/s]  [-]

Kr is full, so the ratios are those of its eigenvectors V. With F_ij the divided differences of 2 z om by om^2,

    dD = V (F o V' dKr V) V'

also at repeated frequencies, if their ratios are equal; where frequencies of modes with different ratios cross, D jumps.
Differentiable, forward and reverse, in Kr; first derivatives only.
Checked in tests/multibody/bodies/test_modal_damping.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.math.checked_numbers import scalar


@dataclass(frozen=True)
class ModalDamping:
    """Damping of the body of a name: time c, and ratios z for each mode, or none; see the module header."""

    body: str
    time: float = 0.0
    ratios: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not scalar(f"damping of {self.body!r}", self.time, "zero or positive, in s") >= 0:
            raise InputError(f"damping of {self.body!r} is {self.time!r} s; allowed: zero or positive")

    def with_ratios(self, ratio: float | Sequence[float], modes: int) -> Self:
        """The same with damping ratios: one for all modes, or one for each."""
        allowed = f"a number from 0 to 1, or {modes} of them, one for each mode"
        several = list(ratio) if isinstance(ratio, Sequence) and not isinstance(ratio, str) else [ratio] * modes
        ratios = [scalar(f"damping ratio of {self.body!r}", z, allowed) for z in several]
        if len(ratios) != modes or not all(0.0 <= z < 1.0 for z in ratios):
            raise InputError(f"damping ratio of {self.body!r} is {ratio!r}; allowed: {allowed}")
        return replace(self, ratios=tuple(float(z) for z in ratios))

    def matrix(self, Kr: Float[Tensor, "*lanes m m"]) -> Float[Tensor, "*lanes m m"] | None:
        """D [1/s] of modes of unit mass; None without damping."""
        if not self.time and not any(self.ratios):
            return None
        D = self.time * Kr
        if not any(self.ratios):
            return D
        fixed = Kr.detach()
        values, V = torch.linalg.eigh(fixed)
        om, z = values.clamp_min(0.0).sqrt(), Kr.new_tensor(self.ratios)
        sums, gaps = om[..., :, None] + om[..., None, :], om[..., :, None] - om[..., None, :]
        differences = z[:, None] - z
        F = (z[:, None] + z) / sums + torch.where((differences == 0.0) | (gaps == 0.0), 0.0, differences / gaps)
        change = V.mT @ (Kr - fixed) @ V  # has the value zero and the derivative of Kr
        return D + V @ (torch.diag_embed(2.0 * z * om) + F * change) @ V.mT
