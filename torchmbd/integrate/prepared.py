"""The start of a motion by steps: consistent initial values, of the whole system and of what a condensation leaves of it.

Checked in tests/multibody/system/test_condensation.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmbd.integrate.native.simd_layout import in_all_lanes
from torchmbd.integrate.pullback import leaf
from torchmbd.math.pair import Pair, linear
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.results.state import State


class Prepared(NamedTuple):
    """A system, what a condensation leaves of it, and the initial state of that."""

    whole: Dynamics
    left: Dynamics
    start: State

    def detached(self) -> Prepared:
        """The same without a graph of torch."""
        whole = _detached(self.whole)
        left = whole if self.left is self.whole else _detached(self.left)
        return Prepared(whole, left, self.start.map(lambda x: linear(Tensor.detach, x)))


def prepare(dynamics: Dynamics) -> Prepared:
    """The start of a motion, made once for a `Dynamics`; the first caller says whether it has a graph of torch."""
    if dynamics.prepared is None:
        dynamics.prepared = _prepared(dynamics)
    return dynamics.prepared


def differentiable(dynamics: Dynamics, names: Sequence[str]) -> Dynamics:
    """The dynamics of leaves [component..., 1, lanes] under these names, and the start as a function of them."""
    leaves = {name: leaf(in_all_lanes(dynamics.data[name], dynamics.lanes)) for name in names}
    found = replace(dynamics, data={**dynamics.data, **leaves})
    with torch.enable_grad():
        prepare(found)
    return found


def _prepared(dynamics: Dynamics) -> Prepared:
    x, left = initial(dynamics), dynamics.condensed()
    if left is dynamics:
        return Prepared(dynamics, dynamics, x)
    x = left.initial.condensation.retained_state(x)
    return Prepared(dynamics, left, x._replace(lam=left.zero_left_out(x.lam)))


def _detached(dynamics: Dynamics) -> Dynamics:
    found = replace(dynamics, data={name: linear(Tensor.detach, x) for name, x in dynamics.data.items()})
    if "rank" in vars(dynamics):
        vars(found)["rank"] = dynamics.rank
    return found


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
