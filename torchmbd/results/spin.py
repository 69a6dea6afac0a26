"""Spin of flexible bodies by their lowest frequency: the limit of linear elastic displacements.

    ratio = max |om| / om_1           om_1: lowest frequency of the body with its reference nodes fixed, from Kr

Without stiffening elastic displacements are linear, and only one of two effects of spin is included: inertia softens a bending
mode, om_1^2 - om^2, but the tension that outweighs it (a blade: om_1^2 + 0.19 om^2 in the plane of the spin) is of second
order. The error is of the size ratio^2 of deflections and energies; beyond a ratio of one a body bends without bound.
Several bodies instead of one, joined by `Fixed`, have their own frames and the tension between them along the bent line,
but need enough modes each. Axial loads of any source: load_share.py.
Source: Kane, Ryan, Banerjee, Dynamics of a cantilever beam attached to a moving base, J. Guid. Control Dyn. 10 (1987)
139-151.
Checked in tests/validation/test_flexible_benchmarks.py.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchmbd.errors import warn
from torchmbd.math.pair import value

if TYPE_CHECKING:
    from torchmbd.results.trajectory import Trajectory

FAST = 0.1  # errors of one percent


def spin_ratios(motion: Trajectory) -> dict[str, Tensor]:
    """Largest ratio of spin to first frequency [lanes] of every flexible body."""
    T, ratios = motion.dynamics.topology, {}
    for name in T.names[: T.flexible]:
        view = motion.body(name)
        first = torch.linalg.eigvalsh(view.stiffness[0].detach())[:, 0].clamp_min(0.0).sqrt()
        ratios[name] = view.omega.norm(dim=-1).amax(-1) / first
    return ratios


def stiffened(motion: Trajectory, name: str) -> bool:
    """Whether a body has displacements of second order (multibody/bodies/stiffening.py)."""
    dynamics = motion.dynamics
    V1 = dynamics.data.get("V1")
    return V1 is not None and bool(value(V1)[:, :, :, dynamics.topology.names.index(name)].any())


def warn_of_spin(motion: Trajectory) -> None:
    """Keep the ratios in stats["spin_ratio"], and warn of bodies without stiffening that turn too fast."""
    motion.stats["spin_ratio"] = spin_ratios(motion)
    for name, ratios in motion.stats["spin_ratio"].items():
        known = ratios[ratios.isfinite()]  # not of a motion that failed, nor of a body that nothing holds
        ratio = float(known.max()) if len(known) else 0.0
        if ratio > FAST and not stiffened(motion, name):
            rounded = f"{ratio:.1g}"  # few different texts: Python shows each once in an optimization
            warn(
                f"body {name!r} turns at {rounded} of its first frequency: centrifugal stiffening, which linear elastic "
                f"displacements leave out, is of the size {min(float(rounded) ** 2, 1.0):.0%} of its deflections; allowed: "
                "stiffening=True of a body of plates and beams",
            )
