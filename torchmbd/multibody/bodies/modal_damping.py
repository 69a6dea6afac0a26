"""Damping of the modes of a body: Rayleigh's two parts, a damping ratio for each mode, and loss factors of plies.

    D = a 1 + c Kr + V diag(2 z_k om_k) V' + Kr^-1/4 L Kr^-1/4            Kr = V diag(om_k^2) V', modes of unit mass

a   rate of the mass-proportional part                            [1/s]
c   time of the stiffness-proportional part                       [s]
z   damping ratios of the modes, by growing frequency om [rad/s]  [-]
L   derivative of Kr where the moduli of each ply grow by its loss factor: they are E (1 + i eta)  [1/s2]

A mode alone has by the last part z_k = L_kk / (2 om_k^2) = sum eta_i U_i / (2 U), U_i = dU / d ln E_i the strain energy of ply
i: structural damping of the same loss at its frequency (Ungar and Kerwin, J. Acoust. Soc. Am. 34 (1962) 954-957). With the root
of Kr it does not depend on which modes of equal frequency are taken.

Kr is full, so the ratios are those of its eigenvectors V. With F_ij the divided differences of 2 z om by om^2,

    dD = V (F o V' dKr V) V' + V diag(2 dz om) V'

also at repeated frequencies, if their ratios are equal; where frequencies of modes with different ratios cross, D jumps.
Differentiable, forward and reverse, in Kr, a, c and z; first derivatives only.
Checked in tests/multibody/bodies/test_modal_damping.py, tests/contracts/test_parameters.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Self

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchmbd.errors import InputError, Path
from torchmbd.fem.reduction.padding import with_stiff_padding
from torchmbd.math.checked_numbers import parameter, scalar
from torchmbd.math.variable import is_variable, number, stacked

_FREE = 1e-12  # of the largest eigenvalue of Kr: freedoms without stiffness


class ModalDamping(nn.Module):
    """Damping of the body of a name, see the module header; numbers that are mbd.variable(...) are its parameters.

    time, rate   zero or positive [s], [1/s]
    ratios       [modes], or [] for all modes alike; None: no ratios
    """

    nonnegative: ClassVar[tuple[str, ...]] = ("time", "rate", "ratios")  # parameters that are, in every design
    time: float | Tensor
    rate: float | Tensor
    ratios: Tensor | None

    def __init__(self, body: str, time: float | Tensor = 0.0):
        super().__init__()
        self.body = body
        self.time = self._number((body, "damping"), time, "s")
        self.rate, self.ratios, self._shared = 0.0, None, True

    def _number(self, path: Path, x: Any, unit: str) -> float | Tensor:
        allowed = "zero or positive, or mbd.variable(...) of such a number"
        value = scalar(path, number(x), allowed, f" {unit}")
        if value < 0.0:
            raise InputError(
                path,
                value,
                allowed,
                shown=f"{value!r} {unit}".rstrip(),
            )
        return x if is_variable(x) else value

    def with_ratios(self, ratio: float | Sequence[float] | Tensor, modes: range, rate: float | Tensor = 0.0) -> Self:
        """Set damping ratios, one for all modes or one for each, and the rate; modes: numbers of modes that designs may have.
        Returns itself."""
        allowed = (
            f"a number of at least 0 and below 1, or {modes[0]} of them, one for each mode; mbd.variable(...) for all, or a "
            "torch.nn.Parameter with one for each"
        )
        name, plain = (self.body, "damping", "ratio"), ratio.detach() if isinstance(ratio, nn.Parameter) else ratio
        several = (isinstance(plain, Sequence) and not isinstance(plain, str)) or (
            isinstance(plain, Tensor) and plain.dim()
        )
        values: Any = plain if several else [plain]
        numbers = [scalar(name, z, allowed) for z in values]
        if (several and len(numbers) not in modes) or not all(0.0 <= z < 1.0 for z in numbers):
            raise InputError(name, plain, allowed)
        self.rate, self._shared = self._number((self.body, "damping", "rate"), rate, "1/s"), not several
        if "ratios" in self.__dict__:
            del self.ratios
        if isinstance(ratio, nn.Parameter):
            self.ratios = parameter(name, ratio)
        else:
            z = torch.tensor(numbers if several else numbers[0], dtype=torch.float64)
            self.ratios = z if any(numbers) else None
        return self

    def of_modes(self, modes: int) -> Tensor | None:
        """Ratios of so many modes [*lanes, modes], further modes with that of the last one; None: there are none."""
        if self.ratios is None:
            return None
        z = self.ratios[..., None] if self._shared else self.ratios
        last = z[..., -1:].expand(*z.shape[:-1], max(modes - z.shape[-1], 0))
        return torch.cat([z[..., :modes], last], -1)

    def matrix(
        self, Kr: Float[Tensor, "*lanes m m"], loss: Float[Tensor, "*lanes m m"] | None = None
    ) -> Float[Tensor, "*lanes m m"] | None:
        """D [1/s] of modes of unit mass; loss: L, None without loss factors. None without damping."""
        D = self._without_loss(Kr)
        if loss is None:
            return D
        lost = _quarter_root(Kr) @ loss @ _quarter_root(Kr)
        return lost if D is None else D + lost

    def _without_loss(self, Kr: Float[Tensor, "*lanes m m"]) -> Float[Tensor, "*lanes m m"] | None:
        plain = not any(isinstance(x, Tensor) or x for x in (self.time, self.rate))
        z = self.of_modes(Kr.shape[-1])
        if plain and z is None:
            return None
        rate, time = stacked((self.rate, self.time))[..., None, None].unbind(-3)
        D = rate * torch.eye(Kr.shape[-1], dtype=Kr.dtype) + time * Kr
        if z is None:
            return D
        fixed = Kr.detach()
        values, V = torch.linalg.eigh(with_stiff_padding(fixed))
        om = values.clamp_min(0.0).sqrt()
        sums, gaps = om[..., :, None] + om[..., None, :], om[..., :, None] - om[..., None, :]
        differences = z[..., :, None] - z[..., None, :]
        F = (z[..., :, None] + z[..., None, :]) / sums + torch.where(
            (differences == 0.0) | (gaps == 0.0), 0.0, differences / gaps
        )
        change = V.mT @ (Kr - fixed) @ V  # has the value zero and the derivative of Kr
        return D + V @ (torch.diag_embed(2.0 * z * om) + F.detach() * change) @ V.mT


def _quarter_root(Kr: Float[Tensor, "*lanes m m"]) -> Float[Tensor, "*lanes m m"]:
    """Kr^-1/4; zero for degrees of freedom without stiffness, which lose no energy."""
    fixed = Kr.detach()
    values, V = torch.linalg.eigh(fixed)
    elastic = values > _FREE * values[..., -1:]
    r = torch.where(elastic, values, 1.0) ** -0.25
    # Divided differences of x^-1/4 in its root r: (r_i - r_j) / (r_i^-4 - r_j^-4), also where both are equal.
    a, b = r[..., :, None], r[..., None, :]
    F = -((a * b) ** 4) / ((a + b) * (a * a + b * b))
    both = elastic[..., :, None] & elastic[..., None, :]
    change = V.mT @ (Kr - fixed) @ V  # has the value zero and the derivative of Kr
    return V @ (torch.diag_embed(torch.where(elastic, r, 0.0)) + torch.where(both, F, 0.0).detach() * change) @ V.mT
