"""The law of a drive with design variables: a torch module of time, its parameters taken from the data of a design.

    x(t, b)     values [n, pair, lanes] at times [n], with x_b db where the data are pairs
    jets        x, x', x'' [1 + n_b, lanes] at one time

Parameters of any shape; `data["law NAME"]` holds those of the law of joint NAME, flat [k, pair, lanes]. Without data
they have their own values. Derivatives by time and by parameters from forward mode.
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
from torchmbd.multibody.joints.laws import Finite
from torchmbd.multibody.joints.primitive import slopes


class ParametricDrive(Finite):
    """The law of the joint `name`, a module with parameters."""

    def __init__(self, name: str, variables: ParameterVector):
        super().__init__(name, variables.module)
        self.variables = variables

    def numbers(self, times: Tensor, data: Mapping[str, Any] | None) -> Any:
        """Values [n, pair, lanes] at times [n]."""
        found = self._of(lambda p: torch.func.vmap(lambda t: self._law(p, t))(times), data)
        return self._checked(found, times)

    def jets(self, t: Tensor, data: Mapping[str, Any] | None) -> Jet:
        """Value, velocity and acceleration [1 + n_b, lanes] at the time t."""
        found = self._of(lambda p: torch.stack(slopes(lambda s: self._law(p, s), t)), data)
        return Jet(*(self._checked(found[i], t) for i in range(3)))

    def _law(self, flat: Tensor, t: Tensor) -> Tensor:
        """The law at one time t [], of parameters [k]."""
        return torch.func.functional_call(self.variables.module, self.variables.named(flat), (t,))

    def _of(self, f: Callable[[Tensor], Tensor], data: Mapping[str, Any] | None) -> Any:
        """f [m] of the parameters of every lane: a number [m, pair, lanes]."""
        own = self.variables.flat().detach() if data is None else data[law_key(self.name)]
        every: Any = torch.func.vmap(f, 1, 1)
        p = value(own)[:, 0]
        if not isinstance(own, Pair):
            return every(p)[:, None]
        wide = own.tangent.expand(*own.tangent.shape[:-1], p.shape[-1])
        tangents: Any = torch.func.vmap(lambda dp: torch.func.jvp(every, (p,), (dp,))[1], 1, 1)(wide)
        return Pair.of(every(p)[:, None], tangents)

    def _checked(self, x: Any, t: Tensor) -> Any:
        self._finite(value(x).detach().sum((-2, -1)), t)
        return x
