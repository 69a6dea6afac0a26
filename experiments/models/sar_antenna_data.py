"""Data of the SAR antenna: what is printed, what was fitted, what is free (`LABELS`), and the law of actuator A, eq. (39).

theta    angle of the crank from panel 2 about Y [rad]: 3.12 stowed, 0 in line
M        torque of actuator A on panel 2, -M on the crank [N m]

Checked in tests/experiments/test_sar_antenna.py.
"""

from __future__ import annotations

import math
from typing import Any

from torchmbd.multibody.forces import Pieces, Table

IM6: dict[str, Any] = {
    "E1": 177e9,
    "E2": 10.8e9,
    "G12": 7.6e9,
    "G13": 7.6e9,
    "G23": 8.504e9,
    "nu12": 0.27,
    "density": 1600.0,
    "alpha1": -0.3e-6,
    "alpha2": 28e-6,
}
LENGTH, WIDTH, PLY = 1.994, 1.300, 0.5e-3
STOWED, DAMPING, DURATION = 3.12, 0.5, 3.0
MIDDLE = math.pi / 2  # of the range in which angles are printed
HALF = LENGTH / 2
SHARP = 1e-6  # [rad]
ROD_POINT = (0.74775, 0.4875)
CRANK = HALF + ROD_POINT[0]  # parallel to panel 3
KNOTS = ((-0.2, -2.00), (0.2, 2.00), (2.63, 2.00), (3.02, 4.03), (3.08, 0.45), (3.12, 0.10))
ANGLES = "panel2.laminate.angles"  # the design: of both panels
# The hub of a crank that bends has next to no inertia of its own.
_BENDING = {"spectral_radius": 0.6, "iterations": (5, 1)}
INTEGRATOR: dict[str, dict[str, Any]] = {"rigid": {}, "beam": _BENDING, "tube": _BENDING}
LABELS = {
    "material": "given",
    "coefficients of expansion": "chosen",
    "panels": "given",
    "lay-ups": "given",
    "counts of bodies and joints": "given",
    "eq. (39), damping": "given",
    "duration": "given",
    "knots of the continuous law": "inferred",
    "arrangement of the joints": "inferred",
    "hub, rod point": "chosen, after seeing the paper's two integrals",
    "trusses": "chosen",
    "attachments": "chosen",
    "cells, modes": "chosen",
}


def continuous_law(strength: float = 1.0) -> Table:
    """Eq. (39) through its knots, without the jumps of the printed pieces: torque on the crank about Y [N m]."""
    return Table(tuple((s, -strength * M) for s, M in KNOTS), damping=DAMPING, center=MIDDLE)


def printed_law(strength: float = 1.0, width: float = 2e-3) -> Pieces:
    """Eq. (39) as printed; its jumps at the borders are spread over +-width [rad]."""
    M = [(-2.0, 0.0), (0.0, 10.0), (2.0, 0.0), (4.03 - 5.19 * 3.02, 5.19), (0.45 + 60.41 * 3.08, -60.41)]
    M.append((0.10 + 9.00 * 3.12, -9.00))
    borders = (-0.2, 0.2, 2.63, 3.02, 3.08)
    return Pieces(
        borders, tuple(-strength * a for a, _ in M), tuple(-strength * k for _, k in M), width, DAMPING, MIDDLE
    )


def sharp_law(strength: float = 1.0) -> Pieces:
    """Eq. (39) as printed, its jumps within +-SHARP: for phases that end at them (experiments.models.sar_antenna.jumps)."""
    return printed_law(strength, SHARP)


LAWS = {"continuous": continuous_law, "printed": printed_law, "sharp": sharp_law}
