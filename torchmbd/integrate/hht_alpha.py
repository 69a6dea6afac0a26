"""HHT-alpha: Newmark's integrator of second order, damped by weighting the accelerations of both ends of a step.

    a1 = (1 + alpha) v1' - alpha v0',    -1/3 <= alpha <= 0,    gamma = 1/2 - alpha,    beta = (1 - alpha)^2 / 4

which is M a1 + (1 + alpha) f1 - alpha f0 = 0 for a constant mass matrix, M v' + f = 0 being the equations of motion: the
forces of both ends weighted, as Hilber, Hughes and Taylor have it. Unconditionally stable for linear systems; the spectral
radius at infinite frequency is (1 + alpha)/(1 - alpha), so 1 for alpha = 0 (the trapezoidal rule, which index-3 constraints do
not bear for long) and 1/2 for alpha = -1/3. Generalized-alpha damps low frequencies less for the same radius, and reaches 0.
The rest of the step is in one_step.py.
Source: Hilber, Hughes, Taylor, Earthq. Eng. Struct. Dyn. 5 (1977) 283-292; on index-3 equations Negrut, Rampalli, Ottarsson,
Sajdak, J. Comput. Nonlinear Dyn. 2 (2007) 73-85; as am = 0, af = -alpha of generalized-alpha Arnold and Bruels, Multibody
Syst. Dyn. 18 (2007) 185-202.
Checked in tests/contracts/test_integrators.py, tests/convergence/test_time_order.py, tests/physics/test_numerical_damping.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torchmbd.errors import InputError
from torchmbd.integrate.one_step import OneStep
from torchmbd.integrate.step import Weights


@dataclass(frozen=True)
class HHTAlpha(OneStep):
    """HHT-alpha.

    alpha   -1/3 (strong damping) to 0 (none)
    """

    name: str = "hht_alpha"
    alpha: float = -0.05

    def __post_init__(self) -> None:
        super().__post_init__()
        x = self.alpha
        if not isinstance(x, (int, float)) or isinstance(x, bool) or not -1.0 / 3.0 <= x <= 0.0:
            raise InputError("alpha", x, "-1/3 (strong damping) to 0 (none)")

    def weights(self, h: Any) -> Weights:
        return Weights.newmark(h, 0.0, -self.alpha)
