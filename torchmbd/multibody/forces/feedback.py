"""Feedback inside the equations of motion: a torch module reads coordinates of actions and sets the strength of others.

    u = module(x)      x [lanes, inputs]: s and s' of coordinates, and the time;  u [lanes, outputs]: generalized forces

The signals that a controller reads, and the forces that it sets, are actions of the usual kinds (action.py) whose law is a
`Port`, which has no force itself. `Links` adds the u of all controllers to the strengths of all actions. So design tangents,
the adjoint and the iteration matrix follow from the directions of the kinds and the derivatives of the module.
The module is called with one lane, under torch.func.vmap if there are several, so that it cannot mix lanes.
`data["law NAME"]` holds the parameters of the controller NAME, flat [k, pair, lanes].
Checked in tests/multibody/forces/test_controller.py, tests/multibody/forces/test_controller_refusals.py.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from torchmbd.errors import InputError
from torchmbd.math.forward_mode import jacfwd, jvp
from torchmbd.math.module_call import call_module, run_with_parameters
from torchmbd.math.pair import Pair, cat, constant_map, value
from torchmbd.math.variable import ParameterVector, law_key

R = TypeVar("R")


class Control:
    """The module of the controller `name` as a function of tensors and pairs, with its numbers of inputs and outputs."""

    def __init__(self, name: str, module: nn.Module, inputs: int, outputs: int):
        self.name, self.module, self.inputs, self.outputs = name, module, inputs, outputs
        self.variables = ParameterVector.of(module)

    @property
    def label(self) -> str:
        return f"module {type(self.module).__name__} of the controller {self.name!r}"

    def __call__(self, x: Any, t: Any, data: Mapping[str, Any]) -> Any:
        """u [outputs, pair, lanes] of x [inputs, pair, lanes] at time t."""
        arguments = [self._parameters(x, data), x]
        values = [value(y)[:, 0] for y in arguments]
        u_of = self._over_lanes(t)
        u = u_of(*values)
        self.check_attached(u, values[0], t)
        varying = [i for i, y in enumerate(arguments) if isinstance(y, Pair) and len(values[i])]
        if not varying:
            return u[:, None]

        def u_of_varying(*varied: Tensor) -> Tensor:
            by_index = dict(zip(varying, varied, strict=True))
            return u_of(*(by_index.get(i, y) for i, y in enumerate(values)))

        def push(*directions: Tensor) -> Any:
            return jvp(u_of_varying, tuple(values[i] for i in varying), directions)[1]

        tangents: Any = torch.func.vmap(push, 1, 1)(*(arguments[i].tangent for i in varying))
        return Pair.of(u[:, None], tangents)

    def holding(self, p: Tensor, run: Callable[[], R]) -> R:
        """run(), while the module has the parameters p [k, 1]; run calls it without parameters."""
        return run_with_parameters(self.module, self.variables.named(p[:, 0]), run) if self.variables else run()

    def at(self, p: Tensor, x: Tensor, t: Any) -> Tensor:
        """u [outputs, lanes] of parameters p [k, lanes or 1] (k = 0: those that the module has) and x [inputs, lanes]."""
        return self._over_lanes(t)(p, x)

    @torch.enable_grad()
    def with_jacobian(self, p: Tensor, x: Tensor, t: Any) -> tuple[Tensor, Tensor]:
        """u as in `at`, with its autograd graph, and du/dx [outputs, inputs, lanes]."""
        x = x.detach().clone().requires_grad_()
        u = self.at(p, x, t)
        return u, torch.stack([derivative(y, x) for y in u])

    def check_attached(self, u: Tensor, p: Tensor, t: Any) -> None:
        """InputError if parameters require a gradient and the output u has none."""
        if torch.is_grad_enabled() and p.requires_grad and not u.requires_grad:
            raise InputError(
                self.label,
                allowed="must give a tensor that depends on its parameters",
                state=f"gives a detached tensor{_at(t)}",
            )

    def jacobian(self, x: Tensor, t: Any, data: Mapping[str, Any]) -> Tensor:
        """du/dx [lanes or 1, outputs, inputs] of values x [inputs, 1, lanes] and data without tangents."""
        du_dx = self._over_lanes(t, jacfwd(self._one_lane(t), argnums=1))
        return du_dx(self._parameters(x, data)[:, 0], x[:, 0]).movedim(-1, 0)

    def _parameters(self, x: Any, data: Mapping[str, Any]) -> Any:
        """Parameters [k, pair, lanes]; k = 0 for a module without any."""
        return x[:0] if self.variables is None else data[law_key(self.name)]

    def _one_lane(self, t: Any) -> Callable[[Tensor, Tensor], Tensor]:
        """The function of one lane: parameters p [k] and x [inputs] -> u [outputs]."""

        def u_of(p: Tensor, x: Tensor) -> Tensor:
            parameters = {} if self.variables is None or not len(p) else self.variables.named(p)
            u = call_module(self.module, parameters, x[None]) if parameters else self.module(x[None])
            self.check(u, 1, t)
            return u[0]

        return u_of

    def _over_lanes(self, t: Any, f: Any = None) -> Callable[[Tensor, Tensor], Tensor]:
        """A function of one lane (None: that of `_one_lane`) as one of all: p [k, lanes or 1], x [inputs, lanes or 1]."""
        of_lane = f or self._one_lane(t)

        def of_lanes(p: Tensor, x: Tensor) -> Tensor:
            if p.shape[1] == x.shape[1] == 1:
                return of_lane(p[:, 0], x[:, 0])[..., None]
            dims = tuple(None if y.shape[1] == 1 else 1 for y in (p, x))
            arguments = (y[:, 0] if y.shape[1] == 1 else y for y in (p, x))
            return torch.func.vmap(of_lane, dims, -1)(*arguments)

        return of_lanes

    def check(self, u: Any, lanes: int, t: Any) -> None:
        """InputError if the module returns anything but float64 [lanes, outputs]."""
        if not isinstance(u, Tensor) or u.shape != (lanes, self.outputs) or u.dtype != torch.float64:
            shown = f"{u.dtype} {list(u.shape)}" if isinstance(u, Tensor) else repr(u)
            raise InputError(
                self.label,
                allowed=f"must give torch.float64 [{lanes}, {self.outputs}] ([lanes, outputs])",
                state=f"gives {shown}{_at(t)}",
            )


def derivative(y: Tensor, by: Tensor) -> Tensor:
    """Derivative of sum(y) by `by`, of the same shape; zero where y does not depend on it."""
    options: dict[str, Any] = {"retain_graph": True, "allow_unused": True, "materialize_grads": True}
    return torch.autograd.grad(y.sum(), by, **options)[0] if y.requires_grad else torch.zeros_like(by)


def _at(t: Any) -> str:
    return f" at t = {float(value(torch.as_tensor(t, dtype=torch.float64)).detach().flatten()[0]):.6g} s"


@dataclass(frozen=True, eq=False)
class Port:
    """The law of an action that a controller reads or sets; it has no force itself.

    reads    for each input that reads the action: its number, and whether it is s' and not s
    writes   number of the output that, times `sign`, is the strength of the action; None: the action is only read
    center   middle of the range of an angle
    """

    control: Control
    reads: tuple[tuple[int, bool], ...] = ()
    writes: int | None = None
    sign: float = 1.0
    center: float = 0.0

    def __call__(self, s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
        return torch.zeros_like(s)

    def slopes(self, s: Tensor, rate: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Derivatives with respect to s and s': zero."""
        return torch.zeros_like(s), torch.zeros_like(s)


class _Link(NamedTuple):
    """One controller, with its inputs and outputs among n actions.

    read          index of each input in s | s' | t of all actions [inputs]
    rates         1 for inputs that are rates, else 0 [inputs]
    coordinates   1 where an input is s or s' of an action [inputs, n]
    writes        factors of the outputs in the strengths of the actions [n, outputs]
    """

    control: Control
    read: Tensor
    rates: Tensor
    coordinates: Tensor
    writes: Tensor


class Links:
    """The controllers of a system; its actions are counted kind by kind."""

    def __init__(self, laws: Sequence[Any]):
        self.total = total = len(laws)
        ports: dict[Control, list[tuple[int, Port]]] = {}
        for i, law in enumerate(laws):
            if isinstance(law, Port):
                ports.setdefault(law.control, []).append((i, law))
        self.each = [_link(control, total, own_ports) for control, own_ports in ports.items()]

    def strengths(
        self, states: Sequence[tuple], law_strengths: Sequence[Any], t: Any, data: Mapping[str, Any]
    ) -> list[Any]:
        """Strengths of the actions [n, ...], kind by kind: `law_strengths` plus those of the controllers."""
        if not self.each:
            return list(law_strengths)
        x, total = self.signals(states, t), cat(law_strengths)
        for link in self.each:
            u = link.control(x.index_select(0, link.read), t, data)
            total = total + constant_map(link.writes, u)
        ends = [0]
        for f in law_strengths:
            ends.append(ends[-1] + f.shape[0])
        return [total[a:b] for a, b in pairwise(ends)]

    def slopes(
        self, states: Sequence[tuple], t: Any, data: Mapping[str, Any], stiffness: Any, damping: Any
    ) -> Tensor | None:
        """stiffness df/ds + damping df/ds' of the controllers [lanes or 1, actions, actions]; None without controllers.

        stiffness, damping   one number, or [1, lanes]
        """
        if not self.each:
            return None
        x = self.signals(states, t)
        stiffness, damping = (
            y.reshape(-1, 1, 1) if isinstance(y, Tensor) and y.dim() else y for y in (stiffness, damping)
        )
        parts = []
        for link in self.each:
            factor = stiffness * (1.0 - link.rates) + damping * link.rates
            J = link.control.jacobian(x.index_select(0, link.read), t, data)
            parts.append(link.writes @ (J * factor) @ link.coordinates)
        return sum(parts[1:], parts[0])

    @staticmethod
    def signals(states: Sequence[tuple], t: Any) -> Any:
        """s | s' | t of all actions [2 n + 1, pair, lanes]."""
        s, rate = cat([x[0] for x in states]), cat([x[1] for x in states])
        if isinstance(t, Pair):
            time: Any = t.unsqueeze(0) if t.full.dim() == 2 else t
        else:
            time = value(s).new_zeros(1, 1, value(s).shape[-1]) + t
        return cat([s, rate, time])


def _link(control: Control, total: int, ports: list[tuple[int, Port]]) -> _Link:
    read, rates = [2 * total] * control.inputs, torch.zeros(control.inputs, dtype=torch.float64)
    coordinates = torch.zeros(control.inputs, total, dtype=torch.float64)
    writes = torch.zeros(total, control.outputs, dtype=torch.float64)
    for i, port in ports:
        for row, rate in port.reads:
            read[row], rates[row], coordinates[row, i] = i + total * rate, float(rate), 1.0
        if port.writes is not None:
            writes[i, port.writes] = port.sign
    return _Link(control, torch.tensor(read), rates, coordinates, writes)
