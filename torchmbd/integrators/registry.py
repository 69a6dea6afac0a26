"""All integrators by name: what `method=` of `simulate` and of configuration files finds.

How to add an integrator: write one file with a frozen dataclass that keeps the contract (integrator.py), and add one line
here. Its fields are its options: `simulate(..., method="hht_alpha", alpha=-0.1)` and the key `alpha` of a file's section
`simulate` need no other word, and options of other names are refused with those that it has. A one-step method on the
index-3 equations is an `OneStep` (one_step.py) with its weights for a step of size h, and gets phases, events, retries,
tangents, adjoint and native code with them. All of generalized_alpha.py is

    @dataclass(frozen=True)
    class GeneralizedAlpha(OneStep):
        name: str = "generalized_alpha"
        spectral_radius: float = 0.9

        def weights(self, h):
            rho = self.spectral_radius
            return Weights.newmark(h, (2.0 * rho - 1.0) / (rho + 1.0), rho / (rho + 1.0))

and a check of its option. Then tests/contracts/test_integrators.py asks what error it may have.
Checked in tests/contracts/test_integrators.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from torchmbd.errors import InputError, unknown
from torchmbd.integrators.generalized_alpha import GeneralizedAlpha
from torchmbd.integrators.integrator import Integrator
from torchmbd.integrators.ode import METHODS as OF_TORCHDIFFEQ
from torchmbd.integrators.torchdiffeq_method import Torchdiffeq

INTEGRATORS: dict[str, Integrator] = {
    integrator.name: integrator
    for integrator in (
        GeneralizedAlpha(),
        *(Torchdiffeq(name) for name in OF_TORCHDIFFEQ),
    )
}
METHODS = tuple(INTEGRATORS)
DEFAULT = METHODS[0]
REFUSED = {"scipy_solver": "returns gradients of zero in reverse mode, silently"}


def integrator_of(method: Any, options: Mapping[str, Any], phases: bool = False) -> Integrator:
    """The integrator of a name with options; InputError says which names and options there are."""
    if isinstance(method, str) and method in REFUSED:
        raise InputError(f"method {method!r} {REFUSED[method]}; allowed: any other")
    if not isinstance(method, str) or method not in INTEGRATORS:
        raise unknown("method", method, METHODS)
    allowed = INTEGRATORS[method].option_types(phases)
    for name in options:
        if name not in allowed:
            raise unknown(f"for method {method!r} the option", name, allowed)
    return replace(INTEGRATORS[method], **options)
