"""The initial state of a motion by steps, of the whole system and of the condensed one.

Checked in tests/multibody/saddle/test_condensation.py.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmbd.integrate.backend import backend_of
from torchmbd.integrate.integrator import Integrator
from torchmbd.integrate.lanes import expanded
from torchmbd.integrate.pullback import leaf
from torchmbd.math.pair import Pair, linear, value
from torchmbd.multibody.system.dynamics import Dynamics, SaddleSolver
from torchmbd.results.state import State


class Prepared(NamedTuple):
    """A system, the condensed system, and the initial states of this and of the whole; one where nothing is condensed.

    leaves   names of the data that are leaves of torch, of which all this is a function
    closed   the state is the start of a motion; it does not follow a switch
    solver   of the initial accelerations, where there is one
    begin    the condensed state from which steps of a size go on; None: not known yet
    """

    whole: Dynamics
    condensed: Dynamics
    start: State
    state: State
    leaves: tuple[str, ...] = ()
    closed: bool = False
    solver: SaddleSolver | None = None
    begin: State | None = None

    def detached(self) -> Prepared:
        """The same without a graph of torch, and without the solver."""
        whole = detached(self.whole)
        condensed = whole if self.condensed is self.whole else detached(self.condensed)
        start, state, begin = (
            x.map(lambda y: linear(Tensor.detach, y)) for x in (self.start, self.state, self.begin or self.start)
        )
        return Prepared(whole, condensed, start, state, begin=begin)

    def with_begin(self, integrator: Integrator, t: Any, h: Any) -> Prepared:
        """The same with the state from which steps of sizes h go on, at the start times t, both [1 + n, lanes]."""
        smooth = integrator.smooth_start(self.whole, self.state, t, h, self.closed, self.solver)
        if self.condensed is not self.whole:
            rows = self.condensed.initial.condensation.independent
            smooth = smooth.map(lambda y: y.index_select(0, rows))
        return self._replace(begin=smooth.resized(self.start, h))


def prepare(dynamics: Dynamics) -> Prepared:
    """Initial state and condensed system, made once for a `Dynamics`; with a graph of torch from data that are leaves."""
    if dynamics.prepared is None:
        with of_leaves(dynamics) as leaves:
            (state, solver), condensed = initial(dynamics), dynamics.condensed()
            x = state
            if condensed is not dynamics:
                x = condensed.initial.condensation.retained_state(state)
                x = x._replace(lam=condensed.zero_left_out(x.lam))
        dynamics.prepared = Prepared(dynamics, condensed, x, state, leaves, True, solver)
    return dynamics.prepared


def prepare_whole(dynamics: Dynamics) -> Prepared:
    """The same for steps of the whole system."""
    with of_leaves(dynamics) as leaves:
        state, solver = initial(dynamics)
    return Prepared(dynamics, dynamics, state, state, leaves, True, solver)


@contextmanager
def of_leaves(dynamics: Dynamics) -> Iterator[tuple[str, ...]]:
    """Names of the data that are leaves of torch; inside, grad mode is on where there are any."""
    plain = {name: value(x) for name, x in dynamics.data.items()}
    leaves = tuple(name for name, x in plain.items() if x.requires_grad and x.is_leaf)
    with torch.set_grad_enabled(bool(leaves)):
        yield leaves


def with_leaves(dynamics: Dynamics, names: Sequence[str]) -> Dynamics:
    """The dynamics with leaves [component..., 1, lanes] for the data of these names."""
    leaves = {name: leaf(expanded(dynamics.data[name], dynamics.lanes)) for name in names}
    return replace(dynamics, data={**dynamics.data, **leaves}) if leaves else dynamics


def detached(dynamics: Dynamics) -> Dynamics:
    """The dynamics without a graph of torch."""
    plain = replace(dynamics, data={name: linear(Tensor.detach, x) for name, x in dynamics.data.items()})
    plain.known_rank = dynamics.known_rank
    return plain


def initial(dynamics: Dynamics) -> tuple[State, SaddleSolver | None]:
    """Consistent initial positions, velocities and accelerations, pairs if the data are; and the solver of these."""
    t = torch.zeros((), dtype=torch.float64)
    q, v = (_paired(x, dynamics.tangents) for x in dynamics.start)
    solver, known = None, backend_of(dynamics).accelerations(dynamics, q, v)
    if known is not None and not isinstance(q, Pair):
        n_v = dynamics.topology.n_v
        a, lam = known[:n_v], known[n_v:]
    else:
        solver = SaddleSolver(dynamics, t, q)
        a, lam = dynamics.accelerations(t, q, v, solver, known)
    return State(q, v, a, a, lam), solver


def _paired(x: Any, tangents: int) -> Any:
    if isinstance(x, Pair) or not tangents:
        return x
    return Pair.of(x, x.new_zeros(1, 1, 1).expand(x.shape[0], tangents, x.shape[2]))
