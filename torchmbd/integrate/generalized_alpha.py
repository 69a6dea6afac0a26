"""Generalized-alpha: one-step integrator of second order whose numerical damping of high frequencies is chosen.

    (1 - am) a1 + am a0 = (1 - af) v1' + af v0'

am = (2 rho - 1)/(rho + 1), af = rho/(rho + 1), gamma = 1/2 + af - am, beta = (gamma + 1/2)^2 / 4: unconditionally stable for
linear systems, rho the spectral radius at infinite frequency. The rest of the step is in one_step.py.
Source: Chung and Hulbert, J. Appl. Mech. 60 (1993) 371-375; Arnold and Bruels, Multibody Syst. Dyn. 18 (2007) 185-202.
Checked in tests/contracts/test_integrators.py, tests/convergence/test_time_order.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torchmbd.errors import InputError
from torchmbd.integrate.one_step import OneStep
from torchmbd.integrate.step import Weights


@dataclass(frozen=True)
class GeneralizedAlpha(OneStep):
    """Generalized-alpha.

    spectral_radius   at infinite frequency: 0 (strong damping) to 1 (none)
    """

    name: str = "generalized_alpha"
    spectral_radius: float = 0.9

    def __post_init__(self) -> None:
        super().__post_init__()
        rho = self.spectral_radius
        if not isinstance(rho, (int, float)) or isinstance(rho, bool) or not 0.0 <= rho <= 1.0:
            raise InputError(f"spectral_radius is {rho!r}; allowed: 0 (strong damping) to 1 (none)")

    def weights(self, h: Any) -> Weights:
        """As of OneStep."""
        rho = self.spectral_radius
        return Weights.newmark(h, (2.0 * rho - 1.0) / (rho + 1.0), rho / (rho + 1.0))
