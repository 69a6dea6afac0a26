"""Equilibria, vibrations and truncation are the same in other units, for other sizes, and for other frames of a body.

A mechanism of the same materials whose lengths and times are x times as large, and whose masses are x^3 times as large, has
the same numbers of pressure and density.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import INERTIA, SOFT, tensor, turned
from tests.units import Units

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")  # of unusual units


UNITS = {"mm, t, s": Units(1e3, 1e-3), "km, g, ms": Units(1e-3, 1e3, 1e3)}
UNITS |= {f"{x:g} times as large": Units(x, x**3, x) for x in (1e-3, 1e-2, 0.1, 100.0)}
PLACE, TIP = turned(0.4, -0.7, 0.3), tensor(0.2, 0.1, -0.05)


def mechanism(u: Units, springs: bool, turn: Any = None, origin: Any = (0.0, 0.0, 0.0)) -> mbd.System:
    """A box on a turned hinge carries a stiffened, soft plate; on springs, or else by a universal joint and free to fall.

    turn, origin   another frame of the box, seen from the first one
    """
    turn, origin = torch.eye(3, dtype=torch.float64) if turn is None else turn, tensor(*origin)
    J = turn.T @ INERTIA @ turn
    box = mbd.RigidBody(
        "box",
        u(0.7, 0, 1),
        u(0.5 * (J + J.T), 2, 1),
        center=u(turn.T @ (tensor(0.03, -0.02, 0.04) - origin), 1),
        position=u(PLACE @ origin, 1),
        axes=PLACE @ turn,
    )

    def on_box(point: Any) -> mbd.Frame:
        return box.at(*u(turn.T @ (tensor(*point) - origin), 1), axes=turn.T)

    ply = {name: u(x, -1, 1, -2) for name, x in SOFT.items()} | {"nu12": SOFT["nu12"], "density": u(1586.0, -3, 1)}
    laminate = mbd.Laminate(mbd.Ply(**ply), mbd.deg([20.0, -50.0, 75.0]), thickness=u(1e-3, 1))
    mesh, swing = mbd.mesh.rectangle(u(0.3, 1), u(0.1, 1), (4, 2)), turned(-0.5, 0.2, 0.9)
    place = u(PLACE @ TIP - swing @ tensor(-0.15, 0.0, 0.0), 1)
    plate = mbd.FlexibleBody.plate("plate", mesh, laminate, 3, position=place, axes=swing, stiffening=True)
    ground, tip = mbd.Ground(), on_box(TIP.tolist())
    hinge = mbd.Revolute(ground.at(axes=turned(0.2, 0.5, -0.4)), box.at(*on_box((0.0, 0.0, 0.0)).point), axis="x")
    forces = [
        mbd.Bushing(
            ground.at(*u((0.1, 0.2, 0.3), 1)),
            on_box((0.05, 0.02, 0.01)),
            stiffness=u((300.0, 200.0, 500.0), 0, 1, -2),
            turning_stiffness=u((4.0, 2.0, 3.0), 2, 1, -2),
            name="mount",
        ),
        mbd.SpringDamper(
            ground.at(*u((0.5, 0.4, 0.1), 1)),
            plate.at("right"),
            stiffness=mbd.variable(u(20.0, 0, 1, -2)),
            rest=u(0.2, 1),
            name="spring",
        ),
    ]
    joint = mbd.Fixed(tip, plate.at("left")) if springs else mbd.Universal(tip, plate.at("left"), axes="zx")
    gravity = u((1.5, -9.0, 3.5), 1, 0, -2)
    return mbd.System([box, plate], [hinge, joint], forces if springs else (), gravity=gravity)


def rest(u: Units) -> dict[str, torch.Tensor]:
    """Place and frequencies at rest in m and Hz, and the derivative of the place by a stiffness [m2/N]."""
    system = mechanism(u, springs=True)
    k = system.get_parameter("spring.stiffness").detach().clone().requires_grad_()
    state = mbd.equilibrium(system, designs={"spring.stiffness": k})
    place = state.body("plate").at("right").position[0, 0] / u.length
    slopes = torch.stack([torch.autograd.grad(x, k, retain_graph=True)[0] for x in place])
    frequencies = state.vibrations[0].frequencies * u.time
    return {"place": place.detach(), "frequencies": frequencies, "slopes": slopes * (u.mass / u.time**2)}


@pytest.mark.parametrize("units", UNITS)
def test_equilibrium_and_vibrations_do_not_depend_on_units_and_size(units: str) -> None:
    expected, result = rest(Units()), rest(UNITS[units])
    for name, x in expected.items():
        assert_close(result[name], x, rtol=1e-7, atol=1e-9 * float(x.abs().max()), msg=lambda m, n=name: f"{n}: {m}")


def fallen(u: Units, **frame: Any) -> torch.Tensor:
    """Truncation and frequencies at the given position, which is no equilibrium."""
    system = mechanism(u, springs=False, **frame)
    truncation = mbd.static_truncation(system)
    assert truncation is not None
    assert truncation.frequencies is not None
    frequencies = tensor(*truncation.frequencies, *system.describe().frequencies) * u.time
    return torch.cat([tensor(truncation.share), frequencies])


@pytest.mark.parametrize("units", UNITS)
def test_truncation_does_not_depend_on_units_and_size(units: str) -> None:
    expected = fallen(Units())
    assert float(expected[0]) > 0.01
    assert_close(fallen(UNITS[units]), expected, rtol=1e-6, atol=1e-9, equal_nan=True)


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (0.3, -0.2, 0.4)])
def test_truncation_does_not_depend_on_the_frame_of_a_body(origin: tuple[float, float, float]) -> None:
    """Least squares of forces and torques would: the mechanism is not at rest where it was put."""
    result = fallen(Units(), turn=turned(0.7, -0.3, 1.9), origin=origin)
    assert_close(result, fallen(Units()), rtol=1e-6, atol=1e-9, equal_nan=True)
