"""Inputs and outputs of a system with ports as functions of the state and the data: what responses to harmonic inputs need.

    F   generalized forces of a unit input        y = c x + c1 x'   an output by increments of the coordinates and their rates

Written in the functions of the equations, so that their derivatives with respect to the state and the data are exact.
In a steady rotation F, c and c1 must be the same at every turn, as their observer sees them: a direction of the ground across
the axis turns for an observer who turns with the machine, and one of a body for an observer in the ground. Inputs and outputs
in such directions are refused, because a harmonic input has no harmonic output then.
Checked in tests/extensions/vibrations/test_frequency_response.py,
tests/extensions/vibrations/measures/test_frequency_response.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from torchmbd.errors import InputError
from torchmbd.math.pair import Pair, cat
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equations.topology import Topology
from torchmbd.multibody.equilibrium.steady_rotation import GroundObserver, Observer, SteadyRotation

PORTS = "inputs and outputs"  # name of their controller
_SAME = 1e-6  # of the largest entry: a change by a turn that counts as none


class Ports(nn.Module):
    """Inputs that do not depend on the outputs."""

    def __init__(self, inputs: int):
        super().__init__()
        self.u = torch.zeros(inputs, dtype=torch.float64)

    def forward(self, x: Tensor) -> Tensor:
        return self.u + 0.0 * x.sum(1, keepdim=True)


@dataclass(frozen=True)
class PortFunctions:
    """See the module header.

    topology, t   of a system with `ports` and its state;  read: numbers of the outputs among the signals of its links
    """

    topology: Topology
    t: Tensor
    ports: Ports
    read: Tensor

    def forces(self, q: Tensor, data: Any, observer: Observer, number: int = 0) -> Tensor:
        """F of the input of this number [n_v, 1, lanes] at q [n_q, 1, lanes]."""
        T, lanes = self.topology, q.shape[-1]
        zero = q.new_zeros(T.n_v, 1, lanes)
        near, v, _ = observer.perturbed(T, q, zero, zero, zero)
        at = equations.placement(T, data, near, T.prescribed(self.t, data))
        [writes] = (link.writes for link in T.links.each if link.control.name == PORTS)
        # The actuators alone: beside other forces on the mechanism, a unit that is small would be lost to rounding.
        states, strengths, first = equations.action_states(T, data, at, v), [], 0
        for s, _, direction in states:
            unit = writes[first : first + len(s), number, None, None].expand(-1, 1, lanes)
            strengths += [unit * d for d in direction]
            first += len(s)
        on_vectors = T.action_sum(*strengths)  # pyright: ignore[reportOptionalCall]
        force = cat([x.flatten(0, 1) for x in equations.generalized_forces(T, data, at, on_vectors)])
        return observer.rows(T, q, force if T.gather is None else T.gather(force))

    def outputs(self, q: Tensor, data: Any, observer: Observer, x: Tensor, xd: Tensor) -> Tensor:
        """Outputs [outputs, k, lanes] along increments and rates [n_v, k, lanes]."""
        T = self.topology
        zero = q.new_zeros(T.n_v, 1, q.shape[-1])
        near, v, _ = observer.perturbed(T, q, *(Pair.of(zero, y) for y in (x, xd, torch.zeros_like(x))))
        at = equations.placement(T, data, near, T.prescribed(self.t, data))
        y = T.links.signals(equations.action_states(T, data, at, v), self.t)
        return y.index_select(0, self.read).tangent

    def output_rows(self, q: Tensor, data: Any, observer: Observer) -> tuple[Tensor, Tensor]:
        """c and c1 [outputs, n_v, lanes]."""
        unit = torch.eye(self.topology.n_v, dtype=q.dtype)[..., None].expand(-1, -1, q.shape[-1])
        still = torch.zeros_like(unit)
        return self.outputs(q, data, observer, unit, still), self.outputs(q, data, observer, still, unit)

    def require_steady(self, q: Tensor, data: Any, observer: Observer) -> None:
        """InputError if an input or an output is another after a turn of a steady rotation; q [n_q, 1, 1]."""
        if not isinstance(observer, SteadyRotation) or not bool(observer.spin.any()):
            return
        T = self.topology
        turned, inputs = observer.turned(T, q), range(len(self.ports.u))
        rows, rows_after = ([y[:, :, 0] for y in self.output_rows(x, data, observer)] for x in (q, turned))
        forces, forces_after = (
            torch.stack([self.forces(x, data, observer, k)[:, 0, 0] for k in inputs]) for x in (q, turned)
        )
        pairs = [("output", *pair) for pair in zip(rows, rows_after, strict=True)]
        for name, before, after in (*pairs, ("input", forces, forces_after)):
            for k, (x, y) in enumerate(zip(before, after, strict=True), 1):
                change = observer.turned_increments(T, x) - y
                if not float(change.abs().max()) <= _SAME * float(x.abs().max()):
                    here, there = (
                        ("ground", "turning") if isinstance(observer, GroundObserver) else ("turning", "ground")
                    )
                    turns = "turns with the machine" if here == "ground" else "is fixed in the ground across the axis"
                    raise InputError(
                        "observer",
                        here,
                        repr(there),
                        state=f"is {here!r}, but {name} {k} {turns}",
                        hint="a direction along the axis of the rotation",
                    )
