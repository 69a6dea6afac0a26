"""How far flexible bodies are displaced against their size: where small elastic displacements cease to hold.

    ratio = max |w| / sqrt(tr P0)       root mean squares over the mass: of displacements, of distances from the body frame

Modes are normalized to the mass matrix, so |w|^2 = sum m u^2, and tr P0 = sum m x^2. The tip of a cantilever that moves by a
length has 0.84. A stiffened body that buckles goes on to any displacement: what holds a buckled beam is of higher order.
Checked in tests/results/test_displacement.py.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchmbd.errors import warn
from torchmbd.math.pair import value

if TYPE_CHECKING:
    from torchmbd.results.trajectory import Trajectory

LARGE = 0.5


def displacement_ratios(motion: Trajectory) -> dict[str, Tensor]:
    """Largest displacement by the size [lanes] of every flexible body."""
    T, ratios = motion.dynamics.topology, {}
    second = (
        value(motion.dynamics.data["P0"])[:, :, :, 0].diagonal().sum(-1)
        if T.flexible
        else torch.zeros(0, dtype=torch.float64)
    )
    for k, name in enumerate(T.names[: T.flexible]):
        ratios[name] = motion.body(name).w.norm(dim=-1).amax(-1) / second[k].sqrt()
    return ratios


def warn_of_displacements(motion: Trajectory) -> None:
    """Warn of bodies whose displacements are of their size."""
    for name, ratios in displacement_ratios(motion).items():
        known = ratios[ratios.isfinite()]  # not of a motion that failed, nor of a body without size
        ratio = float(known.max()) if len(known) else 0.0
        if ratio > LARGE:
            near = f"{ratio:.1g}"  # few different texts: Python shows each once in an optimization
            warn(
                f"body {name!r} is displaced by {near} of its size, but elastic displacements are taken as small; allowed: "
                "smaller loads, pieces of a beam (mbd.split), exact beams (mbd.FlexibleBeam)"
            )
