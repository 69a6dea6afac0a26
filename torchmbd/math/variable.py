"""Numbers of laws that vary with the design: parameters of torch modules.

    mbd.Sine(mbd.variable(0.4), frequency=1.5)                an amplitude that is a design variable
    mbd.SpringDamper(a, b, stiffness=mbd.variable(2e3))       a stiffness

The same variable in several places is one design variable. Among the data of a design they are flat [k, slots, lanes].
Checked in tests/sensitivity/test_law_variables.py.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from torchmbd.math.owned import scalar
from torchmbd.math.pair import linear


def variable(x: float | Tensor) -> nn.Parameter:
    """A number as a design variable: a parameter [] of the law, load or drive in which it stands.

    x  where it starts, finite [unit of its place]
    """
    given = x.detach() if isinstance(x, Tensor) else x
    return nn.Parameter(torch.tensor(scalar("variable", given, "one finite number"), dtype=torch.float64))


def is_variable(x: Any) -> bool:
    """Whether x is one number that may vary."""
    return isinstance(x, nn.Parameter) and x.dim() == 0 and x.dtype == torch.float64 and bool(torch.isfinite(x))


def key(name: str) -> str:
    """Where the design variables of the law of a joint or force are among the data of a design."""
    return f"law {name}"


class Variables:
    """The parameters of a module: one vector of numbers."""

    def __init__(self, module: nn.Module):
        self.module = module
        self.shapes = {name: x.shape for name, x in module.named_parameters()}

    @classmethod
    def of(cls, x: Any) -> Variables | None:
        """Those of a module; None if there are none."""
        return cls(x) if isinstance(x, nn.Module) and any(True for _ in x.parameters()) else None

    def flat(self) -> Tensor:
        """As they are now [k, 1, lanes]; each of them may lead with lanes."""
        parts = []
        for name, x in self.module.named_parameters():
            lanes = x.shape[0] if x.dim() > len(self.shapes[name]) else 1
            parts.append(x.reshape(lanes, -1))
        lanes = max(x.shape[0] for x in parts)
        return torch.cat([x.expand(lanes, -1) for x in parts], 1).T[:, None]

    def named(self, flat: Any) -> dict[str, Any]:
        """Parameters by name out of the vector [k, ...], of shape [*shape, ...]."""
        found, start = {}, 0
        for name, shape in self.shapes.items():
            part = flat[start : start + shape.numel()]
            found[name] = linear(lambda x, shape=shape: x.reshape((*shape, *x.shape[1:])), part)
            start += shape.numel()
        return found
