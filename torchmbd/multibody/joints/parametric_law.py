"""The law of a drive with design variables: a torch module of time whose parameters are data of a design.

    x(t, b)     values [n, pair, lanes] at times [n], with x_b db where the data are pairs
    jets        x, x', x'' [1 + n_b, lanes] at one time

Parameters of any shape; `data["law NAME"]` holds those of the law of joint NAME, flat [k, pair, lanes]. Without data the
Parameters have their present values. Derivatives by time and by parameters are those of forward mode.
Checked in tests/sensitivity/test_law_variables.py: against central differences, on both routes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from torchmbd.math.jet import Jet
from torchmbd.math.pair import Pair, value
from torchmbd.math.variable import ParameterVector, law_key
from torchmbd.multibody.joints.laws import FiniteLaw
from torchmbd.multibody.joints.primitive import slopes


class ParametricDrive(FiniteLaw):
    """The law of the joint `name`: a module with parameters, which are design variables."""

    def __init__(self, name: str, variables: ParameterVector):
        super().__init__(name, variables.module)
        self.variables = variables

    def numbers(self, times: Tensor, data: Mapping[str, Any] | None) -> Any:
        """Values [n, pair, lanes] at times [n]."""
        values = self._over_lanes(lambda p: torch.func.vmap(lambda t: self._law(p, t))(times), data)
        return self._checked(values, times)

    def jets(self, t: Tensor, data: Mapping[str, Any] | None) -> Jet:
        """Value, velocity and acceleration [1 + n_b, lanes] at the time t."""
        parts = self._over_lanes(lambda p: torch.stack(slopes(lambda s: self._law(p, s), t)), data)
        return Jet(*(self._checked(parts[i], t) for i in range(3)))

    def _law(self, flat: Tensor, t: Tensor) -> Tensor:
        """The law with parameters flat [k] at one time t []."""
        return torch.func.functional_call(self.variables.module, self.variables.named(flat), (t,))

    def _over_lanes(self, f: Callable[[Tensor], Tensor], data: Mapping[str, Any] | None) -> Any:
        """f(parameters [k]) [m] for all lanes: a tensor or pair [m, pair, lanes]."""
        parameters = self.variables.flat().detach() if data is None else data[law_key(self.name)]
        of_lanes: Any = torch.func.vmap(f, 1, 1)
        p = value(parameters)[:, 0]
        if not isinstance(parameters, Pair):
            return of_lanes(p)[:, None]
        dp_db = parameters.tangent.expand(*parameters.tangent.shape[:-1], p.shape[-1])
        tangents: Any = torch.func.vmap(lambda dp: torch.func.jvp(of_lanes, (p,), (dp,))[1], 1, 1)(dp_db)
        return Pair.of(of_lanes(p)[:, None], tangents)

    def _checked(self, x: Any, t: Tensor) -> Any:
        self._finite(value(x).detach().sum((-2, -1)), t)
        return x
