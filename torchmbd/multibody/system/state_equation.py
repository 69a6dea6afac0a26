"""The index-1 equations of motion as a torch module: what `system()` returns.

    dy/dt = f(t, y)          y = (q, v)

Its parameters are those of the system, by the same names, so every tool that takes a module takes it:

    f = system()
    y = torchdiffeq.odeint(f, f.initial_state(), t)            or odeint_adjoint
    torch.func.functional_call(f, {"rod.laminate.angles": x}, (t, y0))

The structure stage runs once for each set of values of the parameters, not at each call. Its autograd graph is kept for any
number of backward passes: `odeint_adjoint` makes one at each of its evaluations.
Computed in float64 on the CPU; anything else is refused.
Checked in tests/multibody/system/test_state_equation.py.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from torchmbd.errors import InputError
from torchmbd.math.gradients import in_transform
from torchmbd.math.module_call import outside_transforms
from torchmbd.multibody.system.dynamics import Dynamics


class StateEquation(nn.Module):
    """f(t, y) of one design, whose parameters have their values at each call.

    modules      children of the system, by name
    parameters   those of the system itself, by name
    reduce       runs the structure stage of the system with such numbers
    """

    def __init__(
        self,
        modules: Mapping[str, nn.Module],
        parameters: Mapping[str, nn.Parameter | None],
        reduce: Callable[[Mapping[str, Tensor]], Dynamics],
    ):
        super().__init__()
        for name, module in modules.items():
            self.add_module(name, module)
        for name, x in parameters.items():
            self.register_parameter(name, x)
        self._reduce = reduce
        # For each grad mode: tensors and copies of their values, and the dynamics of these values.
        self._cache: dict[bool, tuple[list[tuple[Tensor, Tensor]], Dynamics]] = {}

    def forward(self, t: Tensor | float, y: Tensor) -> Tensor:
        """dy/dt of states y [lanes, n_q + n_v] or [n_q + n_v] at time t [s]; the same shape."""
        return self.dynamics(t, y)

    def initial_state(self) -> Tensor:
        """Consistent initial state y [1, n_q + n_v]: joints closed, velocities compatible; a function of the parameters."""
        return self.dynamics.initial_state()

    @property
    def dynamics(self) -> Dynamics:
        """The equations of motion with the present values of the parameters."""
        grad, tensors = torch.is_grad_enabled(), [*self.parameters(), *self.buffers()]
        for x in tensors:
            if x.is_floating_point() and (x.dtype != torch.float64 or x.device.type != "cpu"):
                raise InputError(
                    "system",
                    allowed="torch.float64 on cpu",
                    noun="the system",
                    state=f"was moved to {x.dtype} on {x.device}",
                )
        if grad not in self._cache or not unchanged(self._cache[grad][0], tensors):
            plain = not any(map(in_transform, tensors))
            dynamics = outside_transforms(lambda: self._with_kept_graph(grad)) if plain else self._reduced()
            self._cache[grad] = with_copies(tensors), dynamics
        return self._cache[grad][1]

    def _reduced(self) -> Dynamics:
        return self._reduce({name: x for name, x in self._parameters.items() if x is not None})

    def _with_kept_graph(self, grad: bool) -> Dynamics:
        """Dynamics of plain parameters, whose graph permits any number of backward passes."""
        with torch.set_grad_enabled(grad):
            dynamics = self._reduced()
            if grad:
                dynamics.data = _with_kept_graph(dynamics.data, [x for x in self.parameters() if x.requires_grad])
            return dynamics

    def __getstate__(self) -> dict[str, Any]:
        """The attributes without the cache."""
        return vars(self) | {"_cache": {}}


def with_copies(tensors: list[Tensor]) -> list[tuple[Tensor, Tensor]]:
    """Each tensor with a copy of its numbers, for `unchanged`."""
    return [(x, x.detach().clone()) for x in tensors]


def unchanged(before: list[tuple[Tensor, Tensor]], now: list[Tensor]) -> bool:
    """True if tensors are those of before, with the same numbers."""
    if len(before) != len(now) or any(x is not y for (x, _), y in zip(before, now, strict=True)):
        return False
    return all(in_transform(x) or torch.equal(x, then) for x, then in before)


def _with_kept_graph(data: dict[str, Any], parameters: list[Tensor]) -> dict[str, Any]:
    """The same data with a graph that permits any number of backward passes."""
    varying = {name: x for name, x in data.items() if x.requires_grad}
    if not varying:
        return data
    outputs: Any = _KeptGraph.apply(list(varying.values()), *parameters)
    return data | dict(zip(varying, outputs, strict=True))


class _KeptGraph(torch.autograd.Function):
    """Tensors as a function of parameters; backward passes retain the graph between them."""

    @staticmethod
    def forward(ctx: Any, outputs: list[Tensor], *parameters: Tensor) -> tuple[Tensor, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx.outputs, ctx.parameters = outputs, parameters
        ctx.set_materialize_grads(False)
        return tuple(x.detach() for x in outputs)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *cotangents: Tensor | None) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        used = [(y, x) for y, x in zip(ctx.outputs, cotangents, strict=True) if x is not None]
        if not used:
            return (None,) * (1 + len(ctx.parameters))
        outputs, weights = zip(*used, strict=True)
        return None, *torch.autograd.grad(outputs, ctx.parameters, weights, retain_graph=True, allow_unused=True)
