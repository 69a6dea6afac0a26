"""The rounding of an event's function: a change of its sign that is nothing else is not an event.

    rounding = max |g(x (1 + e), D (1 + e)) - g(x, D)|        each e is 1e-12 or -1e-12, by a fixed pattern

x    positions and rates: a component of a vector changes by a share of the longest vector of its kind, a modal coordinate by
     a share of the one that would have the body's strain energy, a modal rate by a share of its body's; rates also by what
     rounding of positions makes of them in a step of the size h
D    data of the model

The change of each argument is thousands of times its rounding. A function that stays below the change that they make, such as a
position or a reaction across the plane of a planar mechanism, is zero but for rounding, in any units and at any distance from
the origin.
Checked in tests/integrate/phases/test_event_rounding.py.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchmbd.integrate.lanes import join_lanes, join_states, lanes_of
from torchmbd.integrate.phases.events import Event, Views
from torchmbd.multibody.equations import equations
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.results.state import State

_SHARE = 1e-12
_OF_A_STEP = 0.01  # of the size of a position, by which its rate changes in a step
_PATTERNS = 4
_TINY = torch.finfo(torch.float64).tiny


class EventRounding:
    """The rounding of an event's function in the lanes of one phase.

    h         size of a regular step [s]
    largest   so far [lanes]: where a motion comes to rest, earlier rounding stays in its coordinates
    """

    def __init__(self, event: Event, views: Views, dynamics: Dynamics, h: float):
        self.h, self.event, self.views, self.dynamics = h, event, views, dynamics.values()
        self.largest = torch.zeros(dynamics.lanes, dtype=torch.float64)

    def exceeded(self, lanes: Sequence[int], t: tuple[Tensor, Tensor], x: tuple[State, State], g: Tensor) -> Tensor:
        """True if the function is more than rounding at one end of steps of lanes at least [m].

        t, x   times [1, m] and states of the system at both ends;  g: values [2, m] of the function there

        A lane may make several of the steps.
        """
        twice, index = [*lanes, *lanes], torch.tensor(lanes, dtype=torch.long)
        of_ends = self._of_states(twice, join_lanes(t), join_states(x)).reshape(2, -1).amax(0)
        size = of_ends.maximum(self.largest[index])
        self.largest = self.largest.scatter_reduce(0, index, of_ends, "amax")
        return g.abs().amax(0) > size

    def _of_states(self, lanes: Sequence[int], t: Tensor, x: State) -> Tensor:
        """The rounding [m] of the function of lanes in states x at times t [1, m]."""
        dynamics = lanes_of(self.dynamics, lanes)
        g, largest = self.views.value(self.event, lanes, dynamics, t, x), torch.zeros(len(lanes), dtype=torch.float64)
        q, v = _sizes(dynamics, x, self.h)
        random = torch.Generator().manual_seed(0)

        def changes(like: Tensor) -> Tensor:
            return _SHARE * (2.0 * torch.randint(2, like.shape, generator=random) - 1.0)

        for _ in range(_PATTERNS):
            data = {name: d * (1.0 + changes(d[..., :1])) for name, d in dynamics.data.items()}
            other = x._replace(q=x.q + q * changes(q[..., :1]), v=x.v + v * changes(v[..., :1]))
            changed = self.views.value(self.event, lanes, dynamics.with_data(data), t, other)
            largest = largest.maximum((changed - g).abs())
        return largest


def _sizes(dynamics: Dynamics, x: State, h: float) -> tuple[Tensor, Tensor]:
    """Sizes of coordinates [n_q, 1, lanes] and rates [n_v, 1, lanes], by which their rounding is measured."""
    T, lanes = dynamics.topology, x.q.shape[-1]
    (r, p, w), (rd, omega, wd) = equations.split_q(T, x.q), equations.split_v(T, x.v)

    def longest(vectors: Tensor) -> Tensor:
        return vectors.norm(dim=0, keepdim=True).amax(1, keepdim=True).expand_as(vectors) if T.bodies else vectors

    r, p, rd, omega = longest(r), torch.ones_like(p), longest(rd), longest(omega)
    tau = torch.ones_like(equations.counted_angles(T, x.q))[:, None]
    if T.flexible:
        stiffness = torch.diagonal(dynamics.data["Kr"], dim1=0, dim2=1).movedim(-1, 0)
        energy = (stiffness * w * w).sum(0, keepdim=True)
        w, wd = (energy / stiffness.clamp_min(_TINY)).sqrt(), wd.norm(dim=0, keepdim=True).expand_as(wd)
    of_step = _OF_A_STEP / h
    rates = [rd.maximum(of_step * r), omega.clamp_min(of_step), wd.maximum(of_step * w)]
    q, v = (torch.cat([y.expand(*y.shape[:-1], lanes).flatten(0, 1) for y in part]) for part in ([r, p, w, tau], rates))
    return q, v
