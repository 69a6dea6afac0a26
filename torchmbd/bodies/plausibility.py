"""A warning where the units of a body look wrong by a factor of a thousand.

Size 2 mm to 200 m, mean density 10 to 25,000 kg/m3 of what is there, speed of sound 100 to 30,000 m/s: a body outside
of these was most likely given in other units than meters, kilograms and seconds. The message names its size, its mass and
its first frequency, by which an analyst sees at once what happened.
Checked in tests/bodies/test_plausibility.py.
"""

from __future__ import annotations

import math
import warnings
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from torchmbd.bodies.flexible import FlexibleBody

SIZE = (2e-3, 200.0)  # m
DENSITY = (10.0, 25e3)  # kg/m3
SOUND = (100.0, 30e3)  # m/s


def warn_units(body: FlexibleBody) -> None:
    """Warn if size, density or speed of sound of a body is implausible."""
    size = float((body.mesh.nodes.amax(0) - body.mesh.nodes.amin(0)).norm())
    doubts = [] if SIZE[0] <= size <= SIZE[1] else [f"its size is {size:.3g} m"]
    for part in body.plates.values():
        for ply in part.laminate.layer_plies:
            sound = math.sqrt(ply.E1 / ply.density)
            if not DENSITY[0] <= ply.density <= DENSITY[1]:
                doubts.append(f"a ply has the density {ply.density:.3g} kg/m3")
            elif not SOUND[0] <= sound <= SOUND[1]:
                doubts.append(f"a ply has the speed of sound {sound:.3g} m/s (E1 = {ply.E1:.3g} Pa)")
    if doubts:
        with torch.no_grad():
            made = body.structure()
        first = math.sqrt(max(float(torch.linalg.eigvalsh(made["Kr"])[0]), 0.0)) / (2.0 * math.pi)
        warnings.warn(
            f"units of body {body.name!r}? {doubts[0]}; it is {size:.3g} m long, weighs {float(made['mass']):.3g} kg, and "
            f"its first frequency is {first:.3g} Hz. Allowed: m, kg, s, N, Pa (readers: units='mm' for mm, t, s, N, MPa)",
            stacklevel=3,
        )
