"""All integrators by name: what `method=` of `simulate` and of configuration files finds.

How to add an integrator: write one file with a frozen dataclass that keeps the contract (integrator.py), and add one line
here. Its fields are its options: `simulate(..., method="hht_alpha", alpha=-0.1)` and the key `alpha` of the section `simulate`
of a configuration file need no other word, and options of other names are refused with those that it has. A one-step method
on the index-3 equations is a `OneStep` (one_step.py) with its weights for a step of size h, and gets phases, events, retries,
tangents, the adjoint and native code with them. All of hht_alpha.py, but for the check of its option, is

    @dataclass(frozen=True)
    class HHTAlpha(OneStep):
        name: str = "hht_alpha"
        alpha: float = -0.05

        def weights(self, h):
            return Weights.newmark(h, 0.0, -self.alpha)

Then tests/contracts/test_integrators.py asks which error it may have, and checks the whole contract.
Checked in tests/contracts/test_integrators.py.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

from torchmbd.errors import InputError, unknown
from torchmbd.integrate.generalized_alpha import GeneralizedAlpha
from torchmbd.integrate.hht_alpha import HHTAlpha
from torchmbd.integrate.integrator import Integrator
from torchmbd.integrate.ode import METHODS as OF_TORCHDIFFEQ
from torchmbd.integrate.torchdiffeq_method import Torchdiffeq

INTEGRATORS: dict[str, Integrator] = {
    integrator.name: integrator
    for integrator in (
        GeneralizedAlpha(),
        HHTAlpha(),
        *(Torchdiffeq(name) for name in OF_TORCHDIFFEQ),
    )
}
METHODS = tuple(INTEGRATORS)
DEFAULT = METHODS[0]
REFUSED = {"scipy_solver": "returns gradients of zero in reverse mode, silently"}


def integrator_of(method: Any, options: Mapping[str, Any], argument_names: Collection[str] = ()) -> Integrator:
    """The integrator of a name with options; InputError says which names and options there are.

    argument_names  the other arguments of the function that takes the options, of which one may be meant
    """
    if isinstance(method, str) and method in REFUSED:
        state, allowed = REFUSED[method], "another method"
        raise InputError("method", method, allowed, noun=f"method {method!r}", state=state)
    if not isinstance(method, str) or method not in INTEGRATORS:
        raise unknown("method", method, METHODS)
    allowed = INTEGRATORS[method].option_types()
    for name in options:
        if name not in allowed:
            value, state = options[name], f"is not an option of method {method!r}"
            raise InputError(name, value, [*allowed, *argument_names], shown=repr(value), state=state)
    return replace(INTEGRATORS[method], **options)
