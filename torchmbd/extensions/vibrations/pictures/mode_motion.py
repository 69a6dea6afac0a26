"""Mode shapes of a whole system as motions, which `animate`, `film` and `save_motion` draw as they draw any other.

    x(t) = size Re(r exp(i w t)),  w = Im s      vibration of a pole s, without growth or decay
    q(t) = q0 moved by x(t)                      r: right eigenvector of the pole, increments of the coordinates

Of a steady rotation this is what an observer sees who turns with the whole, or one in the ground, as the equilibrium says.
The size is chosen for the eye. Joints that it opens, in second order, are closed again by rigid motions of the bodies.
Checked in tests/extensions/vibrations/pictures/test_mode_motion.py.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.extensions.vibrations.spectrum import SWINGS, Spectrum
from torchmbd.math.checked_numbers import is_whole, positive
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equilibrium.equilibrium import SPIN
from torchmbd.multibody.equilibrium.linearized import Linearization
from torchmbd.multibody.equilibrium.steady_rotation import ObserverAtRest
from torchmbd.multibody.saddle.rank import RELATIVE
from torchmbd.multibody.system import Dynamics
from torchmbd.results.mode_shapes import SomeLanes
from torchmbd.results.time_rows import TensorSignals
from torchmbd.results.trajectory import Trajectory
from torchmbd.simulation.equilibrium import Equilibrium
from torchmbd.viz.animation import page_path, require_lane, scene_of, write_scene

_UNDAMPED = 1e-7  # damping [%] that is rounding
_PERIODS = 3  # in a page: the player takes about six seconds for all
_CLOSING = 4  # Newton steps
_UNIT = 1e-6  # of a motion from which displacements are measured: small enough to be of first order
_TURN = 0.15  # largest rotation of a body [rad]


def mode_motion(
    rest: Equilibrium, number: int = 1, lane: int = 0, size: float = 0.08, periods: int = 1, frames: int = 48
) -> Trajectory:
    """Periods of a vibration about an equilibrium as a motion of one lane.

    rest     of mbd.equilibrium(...): at rest or in steady rotation; the state at its last time
    number   of the pole with a positive imaginary part, in rising order of it; 1 is the slowest
    size     largest displacement over the size of the picture
    periods  how many
    frames   times in each

    Reactions are not known (nan). Raises InputError if there is no such vibration.

    >>> rest = mbd.equilibrium(mbd.examples.pendulum(length=2.0))
    >>> swing = mbd.viz.mode_motion(rest)
    >>> round(1.0 / float(swing.t[-1]), 4)  # [Hz]
    0.3525
    """
    if not isinstance(rest, Equilibrium):
        raise InputError("rest", rest, "mbd.equilibrium(...)")
    require_lane(rest, lane)
    positive("size", size, "a share of the picture")
    for name, x, least in (("periods", periods, 1), ("frames", frames, 4)):
        if not is_whole(x) or x < least:
            raise InputError(name, x, f"{least}, {least + 1}, ...")
    with torch.no_grad():
        pole, shape = _vibration(rest, number, lane)
        phases = torch.linspace(0.0, 2.0 * torch.pi * periods, periods * frames + 1, dtype=torch.float64)
        unit = _moved(rest, lane, pole, shape, phases, _UNIT)
        return _moved(rest, lane, pole, shape, phases, _UNIT * _factor(rest, unit, lane, shape, size))


def animate_mode(
    rest: Equilibrium,
    path: str | Path,
    number: int = 1,
    lane: int = 0,
    title: str | None = None,
    size: float = 0.08,
) -> Path:
    """Write a vibration about an equilibrium as an HTML file, the player of `animate`. Returns the path of the file.

    rest, number, lane, size   as in `mode_motion`
    path                       the HTML file
    title                      the text before frequency and damping

    >>> rest = mbd.equilibrium(mbd.examples.pendulum(length=2.0))
    >>> mbd.viz.animate_mode(rest, "swing.html").name
    'swing.html'
    """
    path = page_path(path)
    motion = mode_motion(rest, number, lane, size, _PERIODS)
    scene = scene_of(motion, 0, np.arange(len(motion.t)))
    scene |= {"title": ": ".join(x for x in (title, motion.stats["mode"]) if x), "strips": [], "scale": 1.0}
    return write_scene(scene, path)


def _vibration(rest: Equilibrium, number: Any, lane: int) -> tuple[Tensor, Tensor]:
    """A pole [] and the increments of the coordinates [n_v], complex, in the phase of their largest real part."""
    dynamics = rest.dynamics.values().select_lanes([lane])
    rotation = rest.rotation and rest.rotation.of_spin(dynamics.data[SPIN].detach())
    linear = Linearization.of(dynamics, rest.q[lane, -1].detach(), rest.t[-1].detach(), None, rotation)
    spectrum = Spectrum.poles(linear)
    s = spectrum.values
    swinging = (s.imag > SWINGS * s.abs()).nonzero()[:, 0]
    if not is_whole(number) or not 1 <= number <= len(swinging):
        raise InputError("number", number, f"1 to {len(swinging)}, the vibrations of the system")
    k = int(swinging[number - 1])
    if spectrum.fault[k]:
        raise InputError(
            "number",
            number,
            "a vibration with a shape of its own",
            noun=f"vibration {number}",
            state=f"has no shape, because its eigenvalue is {spectrum.fault[k]}",
            hint="another number",
        )
    r = spectrum.right[:, k]
    return s[k], r * torch.exp(-0.5j * (r**2).sum().angle()) / r.abs().max()


def _moved(rest: Equilibrium, lane: int, pole: Tensor, shape: Tensor, phases: Tensor, factor: float) -> Trajectory:
    """The motion of one lane along a shape [n_v] times a factor, at phases [k] [rad]."""
    dynamics = rest.dynamics.values().select_lanes([lane])
    observer = ObserverAtRest() if rest.rotation is None else rest.rotation.of_spin(dynamics.data[SPIN].detach())
    T, turns = dynamics.topology, torch.exp(1j * phases)
    x, v, a = (factor * (z * shape[:, None] * turns).real for z in (1.0, 1j * pole.imag, -(pole.imag**2)))
    wide = rest.q[lane, -1].detach()[:, None, None].expand(-1, 1, len(phases))
    none = torch.zeros_like(x)[:, None]
    q = _closed(dynamics, observer.perturbed(T, wide, x[:, None], none, none)[0], rest.t[-1].detach())[:, 0]
    unknown = q.new_full((T.rows, len(phases)), torch.nan)
    damping = -100.0 * float(pole.real / pole.abs())
    words = "no damping" if abs(damping) < _UNDAMPED else f"damping {damping:.3g} %"
    return Trajectory(
        t=phases / float(pole.imag),
        signals=TensorSignals({"q": q.T[None], "v": v.T[None], "a": a.T[None], "lam": unknown.T[None]}),
        status=["ok"],
        stats={"mode": f"{float(pole.imag) / (2.0 * torch.pi):.4g} Hz, {words}"},
        system=rest.system,
        dynamics=dynamics,
        shapes=SomeLanes(rest.shapes, [lane]),
        designs={name: y[lane : lane + 1].detach() for name, y in rest.designs.items()},
    )


def _closed(dynamics: Dynamics, q: Tensor, t: Tensor) -> Tensor:
    """Coordinates [n_q, 1, k] with closed joints, nearest to these by rigid motions of the bodies."""
    T, data = dynamics.topology, dynamics.data
    for _ in range(_CLOSING if T.rows else 0):
        at = equations.placement(T, data, q, T.prescribed(t, data))
        J = dynamics.saddle.jacobian(data, at)[:, :, : 6 * T.bodies]
        step = torch.linalg.pinv(J, rtol=RELATIVE) @ equations.constraints(T, at).permute(2, 0, 1)
        rigid = step.permute(1, 2, 0)
        q = equations.advance(T, q, -torch.cat([rigid, rigid.new_zeros(T.n_v - len(rigid), 1, q.shape[-1])]))
    return q


def _factor(rest: Equilibrium, unit: Trajectory, lane: int, shape: Tensor, size: float) -> float:
    """Factor that makes a motion large enough to see: by displacements of origins and nodes, and by rotations of bodies."""
    T = unit.dynamics.topology
    extent = scene_of(rest, lane, np.array([len(rest.t) - 1]))["extent"]
    origins, turns = (_UNIT * y.abs().square().sum(0).sqrt().max() for y in equations.split_v(T, shape)[:2])
    nodes = [unit.body(name).nodes[0] for name in T.names[: T.flexible]]
    moved = max([float(origins), *(float((x - x.mean(0)).norm(dim=-1).max()) for x in nodes)])
    return 1.0 / max(moved / (size * extent), float(turns) / _TURN)
