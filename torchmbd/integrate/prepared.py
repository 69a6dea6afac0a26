"""The initial state of a motion by steps, of the whole system and of the condensed one.

Checked in tests/multibody/saddle/test_condensation.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmbd.integrate.lanes import expanded
from torchmbd.integrate.pullback import leaf
from torchmbd.math.pair import Pair, linear
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.results.state import State


class Prepared(NamedTuple):
    """A system, the condensed system, and the initial states of that and of the whole; one where nothing is condensed.

    leaves   names of the data that are leaves of torch, of which all this is a function
    """

    whole: Dynamics
    condensed: Dynamics
    start: State
    state: State
    leaves: tuple[str, ...] = ()

    def detached(self) -> Prepared:
        """The same without a graph of torch."""
        whole = _detached(self.whole)
        condensed = whole if self.condensed is self.whole else _detached(self.condensed)
        start, state = (x.map(lambda y: linear(Tensor.detach, y)) for x in (self.start, self.state))
        return Prepared(whole, condensed, start, state)


def prepare(dynamics: Dynamics) -> Prepared:
    """Initial state and condensed system, made once for a `Dynamics`; grad mode of the first call decides on a graph."""
    if dynamics.prepared is None:
        state, condensed = initial(dynamics), dynamics.condensed()
        x = state
        if condensed is not dynamics:
            x = condensed.initial.condensation.retained_state(state)
            x = x._replace(lam=condensed.zero_left_out(x.lam))
        dynamics.prepared = Prepared(dynamics, condensed, x, state)
    return dynamics.prepared


def prepare_whole(dynamics: Dynamics) -> Prepared:
    """The same for steps of the whole system."""
    state = initial(dynamics)
    return Prepared(dynamics, dynamics, state, state)


def differentiable(dynamics: Dynamics, names: Sequence[str]) -> Dynamics:
    """The dynamics as a function of leaves [component..., 1, lanes] of these names, the initial state included."""
    leaves = {name: leaf(expanded(dynamics.data[name], dynamics.lanes)) for name in names}
    of_leaves = replace(dynamics, data={**dynamics.data, **leaves})
    with torch.enable_grad():
        of_leaves.prepared = prepare(of_leaves)._replace(leaves=tuple(names))
    return of_leaves


def _detached(dynamics: Dynamics) -> Dynamics:
    plain = replace(dynamics, data={name: linear(Tensor.detach, x) for name, x in dynamics.data.items()})
    plain.known_rank = dynamics.known_rank
    return plain


def initial(dynamics: Dynamics) -> State:
    """Consistent initial positions, velocities and accelerations; pairs if the data are."""
    t = torch.zeros((), dtype=torch.float64)
    q, v = (_paired(x, dynamics.tangents) for x in dynamics.start)
    a, lam = dynamics.accelerations(t, q, v)
    return State(q, v, a, a, lam)


def _paired(x: Any, tangents: int) -> Any:
    if isinstance(x, Pair) or not tangents:
        return x
    return Pair.of(x, x.new_zeros(1, 1, 1).expand(x.shape[0], tangents, x.shape[2]))
