"""A warning where the units of a body look wrong by a factor of a thousand.

A file: size 2 mm to 200 m, density 10 to 25,000 kg/m3, speed of sound 20 to 30,000 m/s. A body outside of these limits is most
likely in other units than meters, kilograms and seconds; the message names its size, mass and first frequency.
A plate: thickness 2e-5 to 0.5 of its size (math/plausible_units.py).
Checked in tests/multibody/bodies/test_unit_checks.py, tests/math/test_plausible_units.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import torch

from torchmbd.errors import warn
from torchmbd.fem.elements import Plates
from torchmbd.fem.mesh import Mesh
from torchmbd.math.plausible_units import DENSITY, SLENDER, SOUND, warn_unusual
from torchmbd.math.variable import without_variables

SIZE = (2e-3, 200.0)  # m


def warn_units(name: str, mesh: Mesh, plates: Iterable[Plates], structure: Callable[[], dict[str, Any]]) -> None:
    """Warn if size, density or speed of sound of a body is implausible; structure() gives its mass and frequencies."""
    size = _size(mesh)
    faults = [] if SIZE[0] <= size <= SIZE[1] else [f"sizes below {SIZE[0]:g} m and above {SIZE[1]:g} m are unusual"]
    for part in plates:
        for ply in map(without_variables, part.laminate.layer_plies):
            sound = math.sqrt(ply.E1 / ply.density)
            if not DENSITY[0] <= ply.density <= DENSITY[1]:
                faults.append(f"a ply has the density {ply.density:.3g} kg/m3")
            elif not SOUND[0] <= sound <= SOUND[1]:
                faults.append(f"a ply has the speed of sound {sound:.3g} m/s (E1 = {ply.E1:.3g} Pa)")
    if faults:
        with torch.no_grad():
            reduced = structure()
        first = math.sqrt(max(float(torch.linalg.eigvalsh(reduced["Kr"])[0]), 0.0)) / (2.0 * math.pi)
        warn(
            f"units of body {name!r}: {faults[0]}. Its size is {size:.3g} m, its mass {float(reduced['mass']):.3g} kg, its "
            f"first frequency {first:.3g} Hz. Try: m, kg, s, N, Pa (readers: units='mm' for mm, t, s, N, MPa)",
        )


def warn_slender(name: str, mesh: Mesh, plates: Iterable[Plates]) -> None:
    """Warn if the thickness of a plate does not fit its size."""
    size = _size(mesh)
    for part in plates:
        thickness = float(part.laminate.total_thickness.detach().max())
        warn_unusual(f"mesh and laminate: thickness of {name!r} by its size", thickness / size, "", SLENDER)


def _size(mesh: Mesh) -> float:
    return float((mesh.nodes.amax(0) - mesh.nodes.amin(0)).norm())
