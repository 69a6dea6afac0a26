"""The design space: the entries of named parameters of a system as one vector b with bounds.

b [n] = (rod.laminate.angles[0], rod.laminate.angles[1], ...)      in SI units and radians
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchmbd.errors import InputError, unknown
from torchmbd.system import System


class DesignSpace:
    """Maps design vectors to parameters of a system.

    system     the model
    variables  names of parameters; default: every parameter that requires a gradient
    bounds     (lower, upper): numbers for all entries, or one for each
    start      initial design [n]; default: the system's own values
    """

    def __init__(
        self,
        system: System,
        variables: Sequence[str] | None = None,
        bounds: Any = (-np.inf, np.inf),
        start: Any = None,
    ):
        own = dict(system.named_parameters())
        for name in variables or ():
            if name not in own:
                raise unknown("parameter", name, own)
        self.variables = list(variables) if variables else [name for name, x in own.items() if x.requires_grad]
        if not self.variables:
            raise InputError(
                "the system has no parameter that requires a gradient; allowed: at least one design variable"
            )
        self.shapes = {name: own[name].shape for name in self.variables}
        self.names = [f"{name}[{i}]" for name in self.variables for i in range(own[name].numel())]
        given = torch.cat([own[name].detach().flatten() for name in self.variables]).numpy()
        self.start = self._vector("start", given if start is None else start)
        if not hasattr(bounds, "__len__") or len(bounds) != 2:
            raise InputError(f"bounds is {bounds!r}; allowed: two entries, (lower, upper)")
        self.lower, self.upper = self._vector("lower", bounds[0]), self._vector("upper", bounds[1])
        for name, low, x, high in zip(self.names, self.lower, self.start, self.upper, strict=True):
            if not low < high:
                raise InputError(f"bounds of {name} are {low!r} and {high!r}; allowed: lower below upper")
            if not low <= x <= high:
                raise InputError(f"start of {name} is {x!r}; allowed: within its bounds, {low!r} to {high!r}")

    def _vector(self, what: str, x: Any) -> np.ndarray:
        if isinstance(x, (tuple, list)):
            x = [float(y) for y in x]
        values = np.asarray(x.detach().numpy() if isinstance(x, Tensor) else x, dtype=float)
        if values.ndim > 1 or (values.ndim == 1 and len(values) != len(self.names)):
            raise InputError(f"{what} has shape {values.shape}; allowed: a number or {len(self.names)} numbers")
        if np.isnan(values).any():
            raise InputError(f"{what} is {x!r}; allowed: numbers")
        return np.broadcast_to(values, (len(self.names),)).copy()

    def designs(self, X: np.ndarray | Tensor) -> dict[str, Tensor]:
        """Parameters [lanes, ...] by name of design vectors [lanes, n]."""
        rows = torch.as_tensor(np.asarray(X), dtype=torch.float64)
        if rows.dim() != 2 or rows.shape[1] != len(self.names):
            raise InputError(f"designs have shape {tuple(rows.shape)}; allowed: [lanes, {len(self.names)}]")
        result, start = {}, 0
        for name, shape in self.shapes.items():
            size = shape.numel()
            result[name] = rows[:, start : start + size].reshape(-1, *shape)
            start += size
        return result
