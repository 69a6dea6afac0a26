"""What makes the mass and stiffness matrices of a design: changes that are linear in parameters, a torch module, a function.

`start` gives the matrices of the first design, `changes` further ones that share their pattern, `on` the module that returns
values on this pattern (given_matrices.py).
Checked in tests/multibody/bodies/test_from_matrices.py.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from torchmbd.errors import InputError
from torchmbd.math.checked_numbers import reals
from torchmbd.math.sparse import Pattern
from torchmbd.math.variable import variable


class _Linear(nn.Module):
    """Values that are linear in parameters."""

    def __init__(self, name: str, M: Any, K: Any, derivatives: Mapping[str, tuple[Any, Any, Any]]) -> None:
        super().__init__()
        self.given, self.base = (M, K), {}
        self._changes: list[Any] = []
        for key, item in derivatives.items():
            if not isinstance(key, str) or not key.isidentifier() or hasattr(self, key):
                raise InputError(f"derivatives of {name!r} has the name {key!r}; allowed: a Python identifier")
            if not isinstance(item, (tuple, list)) or len(item) != 3:
                raise InputError(f"derivatives of {name!r}: {key!r} is {item!r}; allowed: (value, dM, dK)")
            value, dM, dK = item
            own = value if isinstance(value, nn.Parameter) else variable(value)
            self.base[key] = own.detach().clone()
            self.register_parameter(key, own)
            self._changes += [dM, dK]

    @property
    def registered(self) -> nn.Module:
        return self

    def start(self) -> tuple[Any, Any]:
        return self.given

    def changes(self) -> list[Any]:
        return self._changes

    def on(self, pattern: Pattern, values: list[Tensor], freedoms: Tensor, filled: Any) -> nn.Module:
        del pattern, freedoms
        self.values = values
        self.slopes = [None if given is None else next(filled) for given in self._changes]
        return self

    def forward(self) -> tuple[Tensor, Tensor]:
        M, K = self.values
        for k, (key, base) in enumerate(self.base.items()):
            step = getattr(self, key) - base
            dM, dK = self.slopes[2 * k : 2 * k + 2]
            M = M + step * (torch.zeros_like(M) if dM is None else dM)
            K = K + step * (torch.zeros_like(K) if dK is None else dK)
        return M, K


class _Function(nn.Module):
    """A function of parameters that returns M and K."""

    def __init__(self, f: Callable[..., Any], parameters: Mapping[str, float | Tensor]) -> None:
        super().__init__()
        self.f, self.names = f, list(parameters)
        for key, x in parameters.items():
            self.register_parameter(
                key, x if isinstance(x, nn.Parameter) else nn.Parameter(reals(f"parameter {key!r}", x))
            )

    def forward(self) -> Any:
        return self.f(**{key: getattr(self, key) for key in self.names})


class _Made(nn.Module):
    """Values of dense matrices that a module makes."""

    def __init__(self, name: str, module: nn.Module) -> None:
        super().__init__()
        self.name, self.registered_module = name, [module]
        self.module = module

    @property
    def registered(self) -> nn.Module:
        return self.registered_module[0]

    def start(self) -> tuple[Any, Any]:
        with torch.no_grad():
            found = self.module()
        right = isinstance(found, (tuple, list)) and len(found) == 2
        if not right or not all(isinstance(x, Tensor) and x.dtype == torch.float64 and x.dim() == 2 for x in found):
            raise InputError(f"the module of {self.name!r} returns {found!r}; allowed: M and K [N, N] in float64")
        return tuple(found)

    def changes(self) -> list[Any]:
        # Entries that are zero in this design may not be in another one: all are kept.
        M, _ = self.start()
        return [np.ones(M.shape)]

    def on(self, pattern: Pattern, values: list[Tensor], freedoms: Tensor, filled: Any) -> nn.Module:
        del values, filled
        place = torch.full((pattern.size,), -1, dtype=torch.long)
        place[freedoms] = torch.arange(len(freedoms))
        self.rows, self.cols = place[pattern.rows], place[pattern.cols]
        return self

    def forward(self) -> tuple[Tensor, Tensor]:
        M, K = self.module()
        return tuple(0.5 * (x[self.rows, self.cols] + x[self.cols, self.rows]) for x in (M, K))  # pyright: ignore


def maker(name: str, M: Any, K: Any, derivatives: Any, parameters: Any) -> _Linear | _Made | None:
    """What makes the matrices of a design; None for constants."""
    makes = isinstance(M, nn.Module) or (callable(M) and not isinstance(M, Tensor))
    if not makes:
        if K is None or parameters is not None:
            raise InputError(f"K of {name!r} is {K!r}, parameters {parameters!r}; allowed: matrices M and K")
        return _Linear(name, M, K, derivatives) if derivatives else None
    if K is not None or derivatives:
        raise InputError(f"K and derivatives of {name!r} are given beside {M!r}; allowed: a module alone makes both")
    if isinstance(M, nn.Module) == (parameters is not None):
        raise InputError(f"parameters of {name!r} is {parameters!r}; allowed: those of a function, none for a module")
    made: Any = M
    return _Made(name, M if isinstance(M, nn.Module) else _Function(made, parameters))
