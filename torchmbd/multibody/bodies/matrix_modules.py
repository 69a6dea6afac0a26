"""Mass and stiffness matrices as functions of the design: linear in parameters, by a torch module, or by a function.

`start` gives M and K of the first design, `further` other matrices whose entries the common pattern must contain, `on_pattern`
the module that returns the values of M and K on this pattern (given_matrices.py); `registered` has the design variables.
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
    """M and K that are linear in parameters."""

    def __init__(self, name: str, M: Any, K: Any, derivatives: Mapping[str, tuple[Any, Any, Any]]) -> None:
        super().__init__()
        self._start_matrices, self.base = (M, K), {}
        self._derivatives: list[Any] = []
        for key, item in derivatives.items():
            if not isinstance(key, str) or not key.isidentifier() or hasattr(self, key):
                raise InputError(
                    (name, "derivatives"),
                    derivatives,
                    "must have Python identifiers as names",
                    state=f"has the name {key!r}",
                )
            if not isinstance(item, (tuple, list)) or len(item) != 3:
                raise InputError(
                    (name, "derivatives", key), item, "(value, dM, dK)", noun=f"derivatives of {name!r}: {key!r}"
                )
            value, dM, dK = item
            parameter = value if isinstance(value, nn.Parameter) else variable(value)
            self.base[key] = parameter.detach().clone()
            self.register_parameter(key, parameter)
            self._derivatives += [dM, dK]

    @property
    def registered(self) -> nn.Module:
        return self

    def start(self) -> tuple[Any, Any]:
        return self._start_matrices

    def further(self) -> list[Any]:
        return [x for x in self._derivatives if x is not None]

    def on_pattern(self, pattern: Pattern, values: list[Tensor], freedoms: Tensor, further: Any) -> nn.Module:
        del pattern, freedoms
        self.values = values
        self.slopes = [None if x is None else next(further) for x in self._derivatives]
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


class _DenseMatrices(nn.Module):
    """M and K out of the dense matrices that a module returns."""

    def __init__(self, name: str, module: nn.Module) -> None:
        super().__init__()
        self.name, self.module = name, module

    @property
    def registered(self) -> nn.Module:
        return self.module

    def start(self) -> tuple[Any, Any]:
        with torch.no_grad():
            matrices = self.module()
        pair = isinstance(matrices, (tuple, list)) and len(matrices) == 2
        if not pair or not all(isinstance(x, Tensor) and x.dtype == torch.float64 and x.dim() == 2 for x in matrices):
            raise InputError(
                (self.name, "M"),
                allowed="must return M and K [N, N] in float64",
                state=f"returns {matrices!r}",
                noun=f"the module of {self.name!r}",
            )
        return tuple(matrices)

    def further(self) -> list[Any]:
        # Entries that are zero in this design may not be zero in another: the pattern is full.
        M, _ = self.start()
        return [np.ones(M.shape)]

    def on_pattern(self, pattern: Pattern, values: list[Tensor], freedoms: Tensor, further: Any) -> nn.Module:
        del values, further
        row = torch.full((pattern.size,), -1, dtype=torch.long)
        row[freedoms] = torch.arange(len(freedoms))
        self.rows, self.cols = row[pattern.rows], row[pattern.cols]
        return self

    def forward(self) -> tuple[Tensor, Tensor]:
        M, K = self.module()
        return tuple(0.5 * (x[self.rows, self.cols] + x[self.cols, self.rows]) for x in (M, K))  # pyright: ignore


def matrix_source(name: str, M: Any, K: Any, derivatives: Any, parameters: Any) -> _Linear | _DenseMatrices | None:
    """The matrices as a function of the design, for arguments of `FlexibleBody.from_matrices`; None: they are constant."""
    if not isinstance(M, nn.Module) and not (callable(M) and not isinstance(M, Tensor)):
        if K is None or parameters is not None:
            raise InputError((name, "K"), K, "matrices M and K", state=f"is {K!r}, parameters {parameters!r}")
        return _Linear(name, M, K, derivatives) if derivatives else None
    if K is not None or derivatives:
        raise InputError(
            (name, "K"),
            allowed="left out with a module, which makes both",
            state=f"are given beside {M!r}",
            noun=f"K and derivatives of {name!r}",
        )
    if isinstance(M, nn.Module) == (parameters is not None):
        raise InputError((name, "parameters"), parameters, "parameters of a function, and none for a module")
    function: Any = M
    return _DenseMatrices(name, M if isinstance(M, nn.Module) else _Function(function, parameters))
