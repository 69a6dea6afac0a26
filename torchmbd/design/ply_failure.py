"""Plies as histories: the largest failure index of all ply points of a body, or one stress component, at every time.

    Max(PlyFailure("rod")) <= 1                           no ply fails during the motion
    Max(PlyStress("rod", "22")) <= 40e6                   largest tension across the fibers
    Min(PlyStress("rod", "11", extreme="lowest")) >= -1e9

The points are in all cells of plates at the two faces of every layer, and, of failure, in laminated beams. The criteria are
those of fem/materials/strength.py; plies must have a Strength. Components of stress are in the axes of the ply: 11 along the
fibers, 22 across, 12, 13, 23 shear. The derivative is that of the index or the stress at the extreme point.
Checked in tests/contracts/test_responses.py, tests/results/test_ply_history.py, tests/results/test_section_history.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchmbd.design.response import History
from torchmbd.errors import InputError, unknown, warn
from torchmbd.fem.materials import CRITERIA, PLY_COMPONENTS
from torchmbd.fem.materials.strength import required_strength
from torchmbd.integrate import Trajectory
from torchmbd.math.checked_numbers import is_whole
from torchmbd.multibody.system import System
from torchmbd.results.ply_history import PlyHistory, of_plies, require_plies
from torchmbd.results.section_history import SectionHistory, laminated, plies_of

# Largest ratio of sides of triangles to the thickness. Errors of the shear between layers of a carbon cantilever: 4 % for a
# ratio of 1, 17 % for 3, 31 % for 12.
LONGEST = 2.0


@dataclass(frozen=True)
class PlyFailure(History):
    """Failure index of a laminated body [lanes, times] [-]: below one nothing fails.

    body       its name; its plies have a Strength
    criterion  "tsai_wu", "tsai_wu_irf" (grows in proportion to the load), "max_stress", "hashin", "puck" or "interlaminar",
               shear between the layers, of plies with finite S13 or S23 (fem/materials/failure_modes.py)

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
        body = system.body(self.body)
        required_strength(self.body, of_plies(plies_of(body)), self.criterion)
        if self.criterion == "interlaminar":
            _warn_of_triangles(self.body, body)

    def values(self, motion: Trajectory) -> Tensor:
        body = motion.system.body(self.body)
        sections = laminated(body)
        indices = [SectionHistory(motion, self.body).failure(self.criterion)] if sections else []
        if not sections or getattr(body, "plates", None):
            indices.append(PlyHistory(motion, self.body).failure(self.criterion))
        return torch.stack(indices).amax(0)


def _warn_of_triangles(name: str, body: Any) -> None:
    """Warn if triangles are too long for accurate shear forces of plates."""
    for part in getattr(body, "plates", {}).values():
        triangles = part.matrices.kinds.get("triangle")
        if triangles is None:
            continue
        ratio = float(triangles.facets.area.mean().sqrt() / part.laminate.total_thickness.detach().min())
        if ratio > LONGEST:
            warn(
                f"body {name!r} has triangles with sides of {ratio:.0f} times its thickness, so the shear stress between its "
                "layers may have an error of tens of percent. Try: quadrilaterals, or triangles with sides of at most "
                f"{LONGEST:g} times the thickness"
            )


EXTREMES = ("highest", "lowest")


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
            raise InputError("layer", self.layer, f"0 to {layers - 1}, or None for all")

    def values(self, motion: Trajectory) -> Tensor:
        plies, component = PlyHistory(motion, self.body), PLY_COMPONENTS.index(self.component)
        if self.extreme == "lowest":
            return -plies.extreme(component, self.layer, -1.0)
        return plies.extreme(component, self.layer)
