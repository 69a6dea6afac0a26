"""Small mechanisms in general positions, which the tests of the motion share.

Bodies are turned out of every plane, inertia has products, centers lie off the origins, lay-ups are unbalanced.
The plies of `soft` are a thousandth as stiff: explicit methods need few steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any
from unittest.mock import patch

import torch
from scipy.linalg import expm
from torch import Tensor

import torchmbd as mbd
from torchmbd.examples import slider_crank
from torchmbd.math.pair import linear, value

CARBON = {"E1": 128e9, "E2": 10.1e9, "G12": 5.36e9, "G13": 5.36e9, "G23": 5.36e9, "nu12": 0.23, "density": 1586.0}
SOFT = {name: x * (1.0 if name in ("nu12", "density") else 1e-3) for name, x in CARBON.items()}
GRAVITY = (1.5, -9.0, 3.5)
INERTIA = torch.tensor([[3.0e-3, 4e-4, -3e-4], [4e-4, 2.2e-3, 5e-4], [-3e-4, 5e-4, 1.9e-3]], dtype=torch.float64)


def finished(motion: mbd.Trajectory) -> mbd.Trajectory:
    """The motion, none of whose lanes failed; its steps may be too large for the vibrations."""
    assert not [status for status in motion.status if status.startswith("failed")]
    return motion


def tensor(*x: float) -> Tensor:
    return torch.tensor(x, dtype=torch.float64)


def cross_matrix(x: Tensor) -> Tensor:
    """~x, with ~x y = x cross y."""
    zero = torch.zeros((), dtype=torch.float64)
    return torch.stack([zero, -x[2], x[1], x[2], zero, -x[0], -x[1], x[0], zero]).reshape(3, 3)


def turned(*vector: float) -> Tensor:
    """Rotation matrix [3, 3] of a rotation vector [rad], by SciPy's matrix exponential (torch's is off by 1e-11)."""
    return torch.from_numpy(expm(cross_matrix(tensor(*vector)).numpy()))


def laminate(
    angles: Sequence[float] = (20.0, -50.0, 75.0), thickness: float = 7.5e-3, ply: dict = CARBON
) -> mbd.Laminate:
    """An unbalanced, unsymmetric stack [deg] of equal layers; `thickness` in all [m]."""
    return mbd.Laminate(mbd.Ply(**ply), angles=mbd.deg(list(angles)), thickness=thickness / len(angles))


def box(name: str, **given: Any) -> mbd.RigidBody:
    """A rigid body with products of inertia and an eccentric center."""
    return mbd.RigidBody(name, **({"mass": 0.7, "inertia": INERTIA, "center": (0.03, -0.02, 0.04)} | given))


def plate(
    name: str,
    modes: int = 3,
    cells: tuple[int, int] = (4, 2),
    made_of: mbd.Laminate | None = None,
    velocity: Sequence[float] | None = None,
    angular_velocity: Sequence[float] | None = None,
    kind: str = "quad",
    **given: Any,
) -> mbd.FlexibleBody:
    """A laminated plate of 0.3 m x 0.1 m with an initial velocity."""
    mesh = mbd.mesh.rectangle(length=0.3, width=0.1, cells=cells, kind=kind)
    body = mbd.FlexibleBody.plate(name, mesh, made_of or laminate(), modes=modes, **given)
    return body.moving(velocity, angular_velocity)


def pendulum(angles: Sequence[float] = (20.0, -50.0), modes: int = 2, damping: float = 0.0) -> mbd.System:
    """A spatial double pendulum under gravity: a rigid box carries a soft plate; hinges turned out of plane."""
    ground = mbd.Ground()
    arm = box("arm", position=(0.1, 0.05, -0.02), axes=turned(0.4, -0.7, 0.3), angular_velocity=(2.0, -1.0, 3.0))
    # Starts hanging from the arm: the ends of both bodies coincide.
    tip, swing = tensor(0.2, 0.1, -0.05), turned(-0.5, 0.2, 0.9)
    origin = arm.position + arm.axes @ tip - swing @ tensor(-0.15, 0.0, 0.0)
    rod = plate(
        "rod",
        modes,
        made_of=laminate(angles, 3e-3, SOFT),
        position=origin,
        axes=swing,
        angular_velocity=(1.0, 2.0, -2.0),
        damping=damping,
    )
    return mbd.System(
        bodies=[arm, rod],
        joints=[
            mbd.Revolute(ground.at(0.1, 0.05, -0.02, axes=turned(0.2, 0.5, -0.4)), arm.at(), axis="x"),
            mbd.Universal(arm.at(*tip.tolist()), rod.at("left"), axes="zx"),
        ],
        gravity=GRAVITY,
    )


def rigid_pendulum() -> mbd.System:
    """The same without a flexible body."""
    ground = mbd.Ground()
    first = box("first", position=(0.1, 0.05, -0.02), axes=turned(0.4, -0.7, 0.3), angular_velocity=(2.0, -1.0, 3.0))
    swing = turned(-0.5, 0.2, 0.9)
    origin = first.position + first.axes @ tensor(0.2, 0.1, -0.05) - swing @ tensor(-0.15, 0.02, 0.0)
    second = box("second", position=origin, axes=swing, angular_velocity=(1.0, 2.0, -2.0))
    return mbd.System(
        bodies=[first, second],
        joints=[
            mbd.Revolute(ground.at(0.1, 0.05, -0.02, axes=turned(0.2, 0.5, -0.4)), first.at(), axis="x"),
            mbd.Spherical(first.at(0.2, 0.1, -0.05), second.at(-0.15, 0.02, 0.0)),
        ],
        gravity=GRAVITY,
    )


def random_state(system: mbd.System, seed: int, bend: float = 2e-3) -> tuple[Tensor, Tensor, Tensor]:
    """Coordinates, rates and accelerations [n, 1, 1] off every special position; |p| = 1."""
    T = system.topology
    make = torch.Generator().manual_seed(seed)
    q = torch.randn(T.n_q, 1, 1, generator=make, dtype=torch.float64)
    p = q[3 * T.bodies : 7 * T.bodies].unflatten(0, (4, T.bodies))
    p /= p.norm(dim=0, keepdim=True)
    q[7 * T.bodies :] *= bend
    v, a = torch.randn(2, T.n_v, 1, 1, generator=make, dtype=torch.float64).unbind()
    for x in (v, a):
        x[6 * T.bodies :] *= bend
    return q, v, a


def soft_slider_crank(angles: Sequence[float] = (30.0, -20.0), modes: int = 2, **given: Any) -> mbd.System:
    """The slider-crank of the paper with a tenth of the stiffness and some damping: cheap for explicit methods."""
    tenth = {name: x * (1.0 if name in ("nu12", "density") else 0.1) for name, x in CARBON.items()}
    with patch.dict(slider_crank.CARBON, tenth):
        return slider_crank.build(len(angles), angles, **({"cells": (6, 2), "modes": modes, "damping": 1e-4} | given))


def spoilt(system: mbd.System, monkeypatch: Any, lane: int = 1) -> None:
    """From now on the reduced stiffness of one lane of a batch is nan."""

    own = system._dynamics

    def made(data: dict[str, Any], mode_counts: tuple[int, ...]) -> Any:
        first = torch.zeros(value(data["Kr"]).shape, dtype=torch.bool)
        first[0, 0, ..., lane : lane + 1] = True  # smaller batches, as of the estimate of truncation, do not have it
        return own(data | {"Kr": linear(lambda x: torch.where(first, torch.nan, x), data["Kr"])}, mode_counts)

    monkeypatch.setattr(system, "_dynamics", made)


def sprung(law: Any = None, kind: str = "quad") -> mbd.System:
    """A rigid arm and a flexible plate with springs, an actuator and a load between them."""
    ground, arm, rod = mbd.Ground(), box("arm"), plate("rod", modes=2, position=(0.3, 0.0, 0.0), kind=kind)
    table = mbd.forces.Table(((-2.0, 1.0), (0.0, 0.2), (1.0, -1.0)), damping=0.02)
    forces = [
        mbd.SpringDamper(arm.at(0.1, 0.0, 0.0), rod.at("right"), stiffness=300.0, damping=1.0, rest=0.1),
        mbd.RotationalSpringDamper(arm.at(), rod.at("left"), law=law or table),
        mbd.Force(rod.at("right"), (0.0, 1.0, 0.0)),
    ]
    joints = [mbd.Revolute(ground.at(), arm.at()), mbd.Spherical(arm.at(0.15, 0.0, 0.0), rod.at("left"))]
    return mbd.System([arm, rod], joints, forces, gravity=(0.0, -9.81, 0.0))


def linked(links: int, joint: Any = mbd.Spherical, modes: int = 2) -> mbd.System:
    """A chain of links of two lengths on joints, every third of them rigid, level at the start, released under gravity."""
    bodies, ends, x = [], [mbd.Ground().at(0.0, 0.0, 0.0)], 0.0
    for i in range(links):
        size = 0.3 if i % 2 else 0.2
        at = (x + 0.5 * size, 0.0, 0.0)
        x += size
        if i % 3 == 2:
            bodies.append(box(f"link{i}", position=at))
            ends += [bodies[-1].at(-0.5 * size, 0.0, 0.0), bodies[-1].at(0.5 * size, 0.0, 0.0)]
        else:
            mesh = mbd.mesh.rectangle(length=size, width=0.03, cells=(4, 2))
            body = mbd.FlexibleBody.plate(f"link{i}", mesh, laminate(), modes=modes, position=at)
            bodies.append(body)
            ends += [body.at("left"), body.at("right")]
    joints = [joint(ends[2 * i], ends[2 * i + 1]) for i in range(links)]
    return mbd.System(bodies, joints, gravity=(0.0, -9.81, 0.0))
