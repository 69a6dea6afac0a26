"""The state of a motion at one time: coordinates, rates, accelerations and multipliers.

Checked in tests/integrate/test_simulate.py.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from torchmbd.math.pair import value


class State(NamedTuple):
    """q [n_q, ...], v, vd (true), a (algorithmic) [n_v, ...], lam [rows, ...]; tensors or pairs."""

    q: Any
    v: Any
    vd: Any
    a: Any
    lam: Any

    def map(self, f) -> State:
        return State(*(f(x) for x in self))

    def values(self) -> State:
        return self.map(value)
