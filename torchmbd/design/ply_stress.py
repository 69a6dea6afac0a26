"""Ply stress as a history: the highest or lowest value of one stress component among the ply points, at every time [Pa].

    Max(PlyStress("rod", "22")) <= 40e6                   largest tension across the fibers
    Min(PlyStress("rod", "11", extreme="lowest")) >= -1e9

Components are in the axes of the ply: 11 along the fibers, 22 across, 12, 13, 23 shear. The points are in all cells at the
two faces of every layer, or of one `layer` (0 at the bottom). The derivative is that of the stress at the extreme point.
Checked in tests/contracts/test_responses.py, tests/results/test_ply_history.py.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from torchmbd.design.response import History
from torchmbd.errors import InputError, checked_signature, unknown
from torchmbd.fem.materials import PLY_COMPONENTS
from torchmbd.integrate import Trajectory
from torchmbd.math.checked_numbers import is_whole
from torchmbd.multibody.system import System
from torchmbd.results.ply_history import PlyHistory, require_plies

EXTREMES = ("highest", "lowest")


@checked_signature
@dataclass(frozen=True)
class PlyStress(History):
    """Highest or lowest stress among the ply points of a laminated body [lanes, times] [Pa].

    body       its name
    component  "11" along the fibers, "22" across, "12", "13", "23" shear, in the axes of the ply
    layer      0 at the bottom; None: all
    extreme    "highest" or "lowest"

    >>> motion = mbd.simulate(mbd.examples.arm(), 0.1, steps=40)
    >>> along = mbd.PlyStress("arm", "11")
    >>> 1e6 < mbd.Max(along)(motion).item() < 1e9
    True
    """

    body: str
    component: str
    layer: int | None = None
    extreme: str = "highest"

    def check(self, system: System) -> None:
        if self.component not in PLY_COMPONENTS:
            raise unknown("stress component", self.component, PLY_COMPONENTS)
        if self.extreme not in EXTREMES:
            raise unknown("extreme", self.extreme, EXTREMES)
        body = system.body(self.body)
        require_plies(body)
        layers = min(len(part.laminate.layer_plies) for part in body.plates.values())
        if self.layer is not None and not (is_whole(self.layer) and 0 <= self.layer < layers):
            raise InputError(f"layer is {self.layer!r}; allowed: 0 to {layers - 1}, or None for all")

    def values(self, motion: Trajectory) -> Tensor:
        plies, component = PlyHistory(motion, self.body), PLY_COMPONENTS.index(self.component)
        if self.extreme == "lowest":
            return -plies.extreme(component, self.layer, -1.0)
        return plies.extreme(component, self.layer)
