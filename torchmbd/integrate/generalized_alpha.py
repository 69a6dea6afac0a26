"""Generalized-alpha: one-step integrator of second order whose numerical damping of high frequencies is chosen.

    (1 - am) a1 + am a0 = (1 - af) v1' + af v0'

am = (2 rho - 1)/(rho + 1), af = rho/(rho + 1), gamma = 1/2 + af - am, beta = (gamma + 1/2)^2 / 4: unconditionally stable for
linear systems, rho the spectral radius at infinite frequency. The rest of the step is in one_step.py.
Source: Chung and Hulbert, J. Appl. Mech. 60 (1993) 371-375; Arnold and Bruels, Multibody Syst. Dyn. 18 (2007) 185-202.
Checked in tests/contracts/test_integrators.py, tests/convergence/test_time_order.py.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from torchmbd.errors import InputError
from torchmbd.integrate.one_step import OneStep
from torchmbd.integrate.step import Weights
from torchmbd.multibody.equations.topology import Topology

_RADIUS, _OF_BEAMS = 0.9, 0.6


@dataclass(frozen=True)
class GeneralizedAlpha(OneStep):
    """Generalized-alpha.

    spectral_radius   at infinite frequency: 0 (strong damping) to 1 (none); None: 0.9, or 0.6 with elements of beams. Their
                      axial vibrations, which steps do not resolve, would otherwise grow where beams turn by 0.1 rad in a step
    """

    name: str = "generalized_alpha"
    spectral_radius: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        rho = self.spectral_radius
        if rho is not None and (not isinstance(rho, (int, float)) or isinstance(rho, bool) or not 0.0 <= rho <= 1.0):
            raise InputError("spectral_radius", rho, "0 (strong damping) to 1 (none)")

    def with_defaults(self, topology: Topology) -> GeneralizedAlpha:
        if self.spectral_radius is None and topology.has_fast_elements:
            return replace(self, spectral_radius=_OF_BEAMS)
        return self

    def weights(self, h: Any) -> Weights:
        rho = _RADIUS if self.spectral_radius is None else self.spectral_radius
        return Weights.newmark(h, (2.0 * rho - 1.0) / (rho + 1.0), rho / (rho + 1.0))
