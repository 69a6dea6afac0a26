"""First ply failure as a history: the failure index of the ply point that is nearest to failure, at every time.

    Max(PlyFailure("rod")) <= 1         nothing fails during the motion

Of a body of plates and laminated beams it is the larger of both. The criteria are those of fem/materials/strength.py; plies
must have a Strength.
Checked in tests/results/test_ply_history.py, tests/results/test_section_history.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchmbd.design.response import History
from torchmbd.errors import InputError, unknown
from torchmbd.fem.materials import CRITERIA
from torchmbd.integrate import Trajectory
from torchmbd.multibody.system import System
from torchmbd.results.ply_history import PlyHistory
from torchmbd.results.section_history import SectionHistory, laminated, plies_of


@dataclass(frozen=True)
class PlyFailure(History):
    """Failure index of a laminated body [lanes, times] [-]: nothing fails where it is below one.

    body       its name; its plies have a Strength
    criterion  "tsai_wu", "tsai_wu_irf" (grows in proportion to the load), "max_stress", "hashin" or "puck"
               (fem/materials/strength.py)

    >>> motion = mbd.simulate(mbd.examples.arm(), 0.1, steps=40)
    >>> index = mbd.PlyFailure("arm")
    >>> index(motion).shape
    torch.Size([1, 41])
    >>> mbd.Max(index) <= 1.0  # as a constraint
    Constraint(...)
    """

    body: str
    criterion: str = "tsai_wu"

    def check(self, system: System) -> None:
        if self.criterion not in CRITERIA:
            raise unknown("criterion", self.criterion, CRITERIA)
        if any(ply.strength is None for ply in plies_of(system.body(self.body))):
            raise InputError(f"a ply of body {self.body!r} has no strength; allowed: Ply(..., strength=Strength(...))")

    def values(self, motion: Trajectory) -> Tensor:
        body = motion.system.body(self.body)
        sections = laminated(body)
        found = [SectionHistory(motion, self.body).failure(self.criterion)] if sections else []
        if not sections or getattr(body, "plates", None):
            found.append(PlyHistory(motion, self.body).failure(self.criterion))
        return torch.stack(found).amax(0)
