"""The start of a motion by steps: consistent initial values, of the whole system and of what a condensation leaves of it.

Checked in tests/multibody/system/test_condensation.py.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch

from torchmbd.math.pair import Pair
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.results.state import State


class Prepared(NamedTuple):
    """A system, what a condensation leaves of it, and the initial state of that."""

    whole: Dynamics
    left: Dynamics
    start: State

    def values(self) -> Prepared:
        """The same without design tangents."""
        return Prepared(self.whole.values(), self.left.values(), self.start.values())


def prepare(dynamics: Dynamics) -> Prepared:
    """The start of a motion."""
    x, left = initial(dynamics), dynamics.condensed()
    if left is dynamics:
        return Prepared(dynamics, dynamics, x)
    x = left.initial.condensation.state(x)
    return Prepared(dynamics, left, x._replace(lam=left.carried(x.lam)))


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
