"""Where small linear elastic displacements of flexible bodies cease to hold: their size and their spin.

Displacements against the size of the body,

    ratio = max |w| / sqrt(tr P0)       root mean squares over the mass: of displacements, of distances from the body frame

Modes are normalized to the mass matrix, so |w|^2 = sum m u^2, and tr P0 = sum m x^2. The tip of a cantilever that moves by a
length has 0.84. A stiffened body that buckles goes on to any displacement: what holds a buckled beam is of higher order.

Spin by the lowest frequency,

    ratio = max |om| / om_1           om_1: lowest frequency of the body with its reference nodes fixed, from Kr

Without stiffening elastic displacements are linear, and only one of two effects of spin is included: inertia softens a bending
mode, om_1^2 - om^2, but the tension that outweighs it (a blade: om_1^2 + 0.19 om^2 in the plane of the spin) is of second
order. The error is of the size ratio^2 of deflections and energies; beyond a ratio of one a body bends without bound.
Several bodies instead of one, joined by `Fixed`, have their own frames and the tension between them along the bent line,
but need enough modes each.

Loads of any source are in load_shares.py.
Source of the spin: Kane, Ryan, Banerjee, Dynamics of a cantilever beam attached to a moving base, J. Guid. Control Dyn. 10
(1987) 139-151.
Checked in tests/diagnosis/test_elastic_limits.py, tests/validation/test_flexible_benchmarks.py.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchmbd.errors import warn
from torchmbd.math.pair import value
from torchmbd.results.motion_data import has_failed
from torchmbd.results.trajectory import Trajectory

LARGE = 0.5  # displacement by the size
FAST = 0.1  # spin by the frequency: errors of one percent
_OVERDAMPED = 2.0  # damping ratio of a first mode, above which the damping time is probably a ratio


def displacement_ratios(motion: Trajectory) -> dict[str, Tensor]:
    """Largest displacement by the size [lanes] of every flexible body."""
    T, ratios = motion.dynamics.topology, {}
    for k, name in enumerate(T.names[: T.flexible]):
        second = value(motion.dynamics.data["P0"])[:, :, k, 0].diagonal().sum(-1)
        ratios[name] = _lasting(motion, motion.body(name).w.norm(dim=-1)) / second.sqrt()
    return ratios


def _lasting(motion: Trajectory, x: Tensor) -> Tensor:
    """Largest value [lanes] of x [lanes, times]; of a lane that failed, the median of the times before.

    At its end a motion that grows without bound has any speed and size, whatever made it grow.
    """
    failed = torch.tensor([has_failed(status) for status in motion.status])
    return torch.where(failed, x.nanmedian(-1).values, x.amax(-1))


def _largest(ratios: Tensor) -> float:
    """Of the lanes that have a number: not of a motion without any, nor of a body without size or support."""
    known = ratios.detach()[ratios.isfinite()]
    return float(known.max()) if len(known) else 0.0


def warn_of_displacements(motion: Trajectory) -> None:
    """Warn of bodies whose displacements are of their size."""
    for name, ratios in displacement_ratios(motion).items():
        ratio = _largest(ratios)
        if ratio > LARGE:
            near = f"{ratio:.1g}"  # few different texts: Python shows each once in an optimization
            warn(
                f"body {name!r} has elastic displacements of {near} of its size, but a body with modes assumes small "
                "displacements. Try: smaller loads, a beam in pieces (mbd.split), or an exact beam (mbd.FlexibleBeam)"
            )


def spin_ratios(motion: Trajectory) -> dict[str, Tensor]:
    """Largest ratio of spin to first frequency [lanes] of every flexible body."""
    T, ratios = motion.dynamics.topology, {}
    for name in T.names[: T.flexible]:
        view = motion.body(name)
        first = torch.linalg.eigvalsh(view.stiffness[0].detach())[:, 0].clamp_min(0.0).sqrt()
        ratios[name] = _lasting(motion, view.omega.norm(dim=-1)) / first
    return ratios


def warn_of_spin(motion: Trajectory) -> None:
    """Keep the ratios in stats["spin_ratio"], and warn of bodies without stiffening that turn too fast."""
    motion.stats["spin_ratio"] = spin_ratios(motion)
    for name, ratios in motion.stats["spin_ratio"].items():
        ratio = _largest(ratios)
        if ratio > FAST and not is_stiffened(motion, name):
            rounded = f"{ratio:.1g}"  # few different texts: Python shows each once in an optimization
            warn(
                f"body {name!r} turns at {rounded} of its first frequency, but it has no centrifugal stiffening. So its "
                f"deflections have an error of about {min(float(rounded) ** 2, 1.0):.0%}. Try: stiffening=True, for bodies of "
                "plates and beams",
            )


def warn_of_damping(motion: Trajectory) -> None:
    """Warn of bodies whose first mode is far above critical damping: their damping time may be a damping ratio by mistake."""
    T, data = motion.dynamics.topology, motion.dynamics.data
    for k, name in enumerate(T.names[: T.flexible]):
        time = getattr(getattr(motion.system.body(name), "damping", None), "time", 0.0)
        if not isinstance(time, Tensor) and not time:
            continue
        m = T.mode_counts[k]
        K, D = (value(data[key])[:m, :m, k, 0].detach().movedim(-1, 0) for key in ("Kr", "D"))
        squares, shapes = torch.linalg.eigh(K)
        first, shape = squares[:, 0].clamp_min(0.0).sqrt(), shapes[..., :1]
        ratios = 0.5 * (shape.mT @ D @ shape)[:, 0, 0] / first
        worst = int(ratios.nan_to_num(0.0, 0.0).argmax())
        ratio, frequency = float(ratios[worst]), float(first[min(worst, len(first) - 1)])
        if _OVERDAMPED < ratio < torch.inf:
            warn(
                f"damping of body {name!r} = {2.0 * ratio / frequency:g} s gives its first mode the damping ratio {ratio:.3g}, "
                f"above critical damping. Try: damping = 2 x ratio / ({frequency:.3g} rad/s) for a damping ratio of this mode"
            )


def is_stiffened(motion: Trajectory, name: str) -> bool:
    V1 = motion.dynamics.data.get("V1")  # displacements of second order (multibody/bodies/stiffening.py)
    return V1 is not None and bool(value(V1)[:, :, :, motion.dynamics.topology.names.index(name)].any())
