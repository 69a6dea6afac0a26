"""First ply failure as a history: the failure index of the ply point that is nearest to failure, at every time.

    Max(PlyFailure("rod")) <= 1         nothing fails during the motion

The criteria are those of materials/strength.py; plies must have a Strength.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from torchmbd.design.response import History
from torchmbd.errors import InputError, unknown
from torchmbd.integrators import Trajectory
from torchmbd.integrators.ply_history import PlyHistory, require_plies
from torchmbd.materials import CRITERIA
from torchmbd.system import System


@dataclass(frozen=True)
class PlyFailure(History):
    """Failure index of a laminated body: "tsai_wu", "tsai_wu_irf" (grows in proportion to the load) or "max_stress"."""

    body: str
    criterion: str = "tsai_wu"

    def check(self, system: System) -> None:
        if self.criterion not in CRITERIA:
            raise unknown("criterion", self.criterion, CRITERIA)
        body = system.body(self.body)
        require_plies(body)
        if any(ply.strength is None for part in body.plates.values() for ply in part.laminate.layer_plies):
            raise InputError(f"a ply of body {self.body!r} has no strength; allowed: Ply(..., strength=Strength(...))")

    def values(self, motion: Trajectory) -> Tensor:
        return PlyHistory(motion, self.body).failure(self.criterion)
