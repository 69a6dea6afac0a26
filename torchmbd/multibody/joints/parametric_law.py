"""The law of a drive with design variables: a torch module of time whose parameters are data of a design.

    x(t, b)     values [n, pair, lanes] at times [n], with x_b db where the data are pairs
    jets        x, x', x'' [1 + n_b, lanes] at one time

Parameters of any shape; `data["law NAME"]` holds those of the law of joint NAME, flat [k, pair, lanes]. Without data the
Parameters have their present values. Derivatives with respect to time and parameters are those of forward mode.
Checked in tests/sensitivity/test_law_variables.py: against central differences, on both routes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchmbd.math.forward_mode import jvp
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
        self._require_finite(times, value(values).detach().sum((-2, -1)))
        return values

    def jets(self, t: Tensor, data: Mapping[str, Any] | None) -> Jet:
        """Value, velocity and acceleration [1 + n_b, lanes] at the time t [], or of each lane at its own t [lanes]."""
        parts = self._over_lanes(lambda p, *s: torch.stack(slopes(lambda x: self._law(p, x), *(s or (t,)))), data, t)
        self._require_finite(t, *(x[0] if t.dim() else x.sum() for x in value(parts).detach()))
        return Jet(parts[0], parts[1], parts[2])

    def _law(self, flat: Tensor, t: Tensor) -> Tensor:
        """The law with parameters flat [k] at one time t []."""
        return torch.func.functional_call(self.variables.module, self.variables.named(flat), (t,))

    def _over_lanes(self, f: Callable[..., Tensor], data: Mapping[str, Any] | None, times: Tensor | None = None) -> Any:
        """f(parameters [k]) [m] for all lanes: a tensor or pair [m, pair, lanes]; with times [lanes], f(parameters, time)."""
        parameters = self.variables.flat().detach() if data is None else data[law_key(self.name)]
        p = value(parameters)[:, 0]
        of_lanes: Any = torch.func.vmap(f, 1, 1)
        if times is not None and times.dim():
            p = p.expand(-1, len(times))
            of_lanes = partial(torch.func.vmap(lambda s, q: f(q, s), (0, 1), 1), times)
        if not isinstance(parameters, Pair):
            return of_lanes(p)[:, None]
        dp_db = parameters.tangent.expand(*parameters.tangent.shape[:-1], p.shape[-1])
        tangents: Any = torch.func.vmap(lambda dp: jvp(of_lanes, (p,), (dp,))[1], 1, 1)(dp_db)
        return Pair.of(of_lanes(p)[:, None], tangents)
