"""Inputs and outputs of a system with ports as functions of the state and the data: what responses to harmonic inputs need.

    F   generalized forces of a unit input        y = c x + c1 x'   an output by increments of the coordinates and their rates

Written in the functions of the equations, so that their derivatives by the state and the data are exact.
Checked in tests/extensions/vibrations/test_frequency_response.py,
tests/extensions/vibrations/measures/test_frequency_response.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchmbd.extensions.vibrations.linear_system import Ports
from torchmbd.math.pair import Pair
from torchmbd.multibody.system import equations
from torchmbd.multibody.system.steady_rotation import Observer
from torchmbd.multibody.system.topology import Topology


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
        T = self.topology
        zero, none = q.new_zeros(T.n_v, 1, q.shape[-1]), q.new_zeros(T.rows, 1, q.shape[-1])
        near, v, a = observer.perturbed(T, q, zero, zero, zero)
        at = equations.placement(T, data, near, T.prescribed(self.t, data))
        off, residuals = torch.zeros_like(self.ports.u), []
        on = off.clone()
        on[number] = 1.0
        try:
            for self.ports.u in (off, on):
                residuals.append(observer.rows(T, q, equations.dynamic_residual(T, data, at, v, a, none)))
        finally:
            self.ports.u = off
        return residuals[0] - residuals[1]

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
