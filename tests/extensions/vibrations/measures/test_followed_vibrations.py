"""Vibrations that keep their shape while another crosses them between designs: closed forms, modes of bodies, lost ones."""

from __future__ import annotations

import math

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.extensions.vibrations.measures.test_system_vibrations import measured
from tests.refused import refused

pytestmark = pytest.mark.thorough

GROUND = mbd.Ground()


def masses(coupling: float = 0.0) -> mbd.System:
    """Two masses on rails, 10 rad/s and 14 rad/s, with a spring between them."""
    bodies = [mbd.RigidBody(name, 2.0, (1.0, 1.0, 1.0)) for name in "ab"]
    rails = [mbd.Prismatic(GROUND.at(), b.at(), axis="y", name=f"rail_{b.name}") for b in bodies]
    springs = [
        mbd.AxialSpringDamper(
            GROUND.at(), b.at(), axis="y", stiffness=mbd.variable(2.0 * w * w), damping=d, name=f"hold_{b.name}"
        )
        for b, w, d in zip(bodies, (10.0, 14.0), (0.4, 1.2), strict=True)
    ]
    between = mbd.AxialSpringDamper(
        bodies[0].at(), bodies[1].at(), axis="y", stiffness=mbd.variable(coupling), name="c"
    )
    return mbd.System(bodies, rails, [*springs, between])


def test_numbers_swap_and_shapes_do_not():
    """Mass a has 10, 12, 16 rad/s, b always 14: number 1 of the start is a, also where it is the faster."""
    system, w = masses(), torch.tensor([10.0, 12.0, 16.0], dtype=torch.float64)
    x = {"hold_a.stiffness": (2.0 * w * w).requires_grad_()}
    f = {follow: measured(mbd.vibrations.SystemFrequency(1, follow=follow), system, x) for follow in (True, False)}
    assert_close(2.0 * math.pi * f[True].detach(), w, rtol=1e-10, atol=0.0)
    assert_close(2.0 * math.pi * f[False].detach(), w.clamp_max(14.0), rtol=1e-10, atol=0.0)
    [slope] = torch.autograd.grad(f[True].sum(), x["hold_a.stiffness"])
    assert_close(2.0 * math.pi * slope, 1.0 / (4.0 * w), rtol=1e-10, atol=0.0)
    forward = torch.func.jvp(
        lambda k: measured(mbd.vibrations.SystemFrequency(1, follow=True), system, {"hold_a.stiffness": k}),
        (2.0 * w * w,),
        (torch.ones(3, dtype=torch.float64),),
    )
    assert_close(forward[1], slope, rtol=1e-9, atol=0.0)
    ratio = measured(mbd.vibrations.DampingRatio(1, follow=True), system, x).detach()
    assert_close(ratio, 0.4 / (4.0 * w), rtol=1e-9, atol=0.0)


def test_a_vibration_that_is_lost_is_named():
    """Where both have the same frequency a stiff coupling makes them swing with and against each other: a MAC of 1 / 2."""
    same = {"hold_a.stiffness": torch.tensor([392.0]).double(), "c.stiffness": torch.tensor([50.0]).double()}
    with refused("vibration 1 of the start"):
        measured(mbd.vibrations.SystemFrequency(1, follow=True), masses(), same)


def test_what_has_no_shape_is_refused():
    x = {"hold_b.stiffness": torch.tensor([300.0]).double()}
    equal = masses()
    equal.get_parameter("hold_b.stiffness").data.fill_(200.0)
    with refused("number", 1, kind=mbd.DesignFailure):
        measured(mbd.vibrations.SystemFrequency(1, follow=True), equal, x)
    with refused("number", 3):
        measured(mbd.vibrations.SystemFrequency(3, follow=True), masses(), x)
    with refused("follow"):
        mbd.vibrations.SystemFrequency(cluster=(1, 2), follow=True)
    with refused("follow", 3):
        mbd.vibrations.DampingRatio(1, **{"follow": 3})  # pyright: ignore[reportArgumentType]


def test_in_the_modes_of_each_design():
    """A strip whose width and height change places: its first bending, up and down, becomes the stiffer one, its modes swap."""
    ply = mbd.Ply(E1=70e9, E2=70e9, G12=27e9, G13=27e9, G23=27e9, nu12=0.3, density=2700.0)
    thickness = torch.nn.Parameter(torch.full((2,), 4e-3, dtype=torch.float64))
    section = mbd.sections.strip(0.012, ply, [0.0, 0.0], thickness, cells=(3, 1))
    body = mbd.FlexibleBody.beam("bar", mbd.BeamLine.straight(0.5, 6), section, modes=4, reference="start")
    system = mbd.System([body], [mbd.Fixed(GROUND.at(), body.at("start"))])
    [name] = [n for n, x in system.named_parameters() if x.shape == (2,) and "thickness" in n]
    x = {name: torch.tensor([[4e-3, 4e-3], [5e-3, 5e-3], [8e-3, 8e-3]], dtype=torch.float64)}
    numbers = [measured(mbd.vibrations.SystemFrequency(k), system, x) for k in (1, 2)]
    followed = [measured(mbd.vibrations.SystemFrequency(k, follow=True), system, x) for k in (1, 2)]
    for k in (0, 1):
        assert_close(followed[k][:2], numbers[k][:2], rtol=1e-9, atol=0.0)
        assert_close(followed[k][2], numbers[1 - k][2], rtol=1e-9, atol=0.0)
