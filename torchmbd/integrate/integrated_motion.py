"""What an integration of `Motion` has once it has run, in forward and in reverse mode.

Checked in tests/integrate/test_motion.py.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

from torch import Tensor

from torchmbd.integrate.retries import LaneResults
from torchmbd.multibody.system import Dynamics
from torchmbd.multibody.system.expansion import Expansion
from torchmbd.results.history import History
from torchmbd.results.motion_data import Switch


class IntegratedMotion:
    """Results of the lanes, and what leads from them to the whole system.

    dynamics   of the whole system;  results: of all lanes;  duration [s]
    """

    dynamics: Dynamics
    results: LaneResults
    duration: float

    @property
    def history(self) -> History:
        """States of all lanes."""
        return self.results.history

    @property
    def status(self) -> list[str]:
        """Of all lanes."""
        return self.results.status

    @property
    def switches(self) -> list[Switch]:
        """Between segments, without a graph of torch."""
        return self.results.switches

    @cached_property
    def stats(self) -> dict[str, Any]:
        """Statistics of the steps by name; the motion adds its own."""
        return self.results.statistics.numbers()

    def expansion(self, data: dict[str, Any]) -> Expansion | None:
        """Leads from the condensed to the whole system, as a function of the data; None: it is the whole."""
        return self.history.expansion_by(data)

    def multipliers(self, history: History, data: dict[str, Any]) -> Tensor:
        """All multipliers [times, rows, pair, lanes]; of redundant rows those of least norm."""
        if self.history.run is not None:
            return self.history.run.multipliers(history, data)
        return history.least_norm_multipliers(self.dynamics.least_norm, self.duration, data)
