"""Derivatives of frequencies and poles of whole systems: forward = reverse = differences; eigenvalues that coincide."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import SOFT, laminate, plate, tensor, turned
from tests.multibody.equilibrium.test_ground_observer import rotor
from tests.refused import refused
from tests.sensitivity.number_cases import differences
from tests.sensitivity.test_rest import NAMES, hanging
from torchmbd.extensions.vibrations.spectrum import Spectrum
from torchmbd.multibody.equilibrium.linearized import Linearization

V, GROUND = mbd.variable, mbd.Ground()
Values = Callable[[mbd.System, dict[str, Tensor]], Tensor]


def check(
    system: mbd.System, names: list[str], values: Values, rtol: float = 1e-6, steps: dict[str, float] | None = None
) -> None:
    """Of a number [lanes] of designs: .backward(), torch.func in both modes, and differences of high order."""
    start = {name: system.get_parameter(name).detach().clone() for name in names}
    x = {name: y[None].clone().requires_grad_() for name, y in start.items()}
    values(system, x).sum().backward()
    single = lambda b: values(system, {name: y[None] for name, y in b.items()})[0]  # noqa: E731
    forward, reverse = torch.func.jacfwd(single)(start), torch.func.jacrev(single)(start)
    expected = differences(lambda b: values(system, b), system, names, steps)
    for name, y in x.items():
        assert y.grad is not None
        size = float(y.grad.abs().max())
        assert size > 0.0
        for other, bound in ((forward, 1e-9), (reverse, 1e-9), (expected, rtol)):
            assert_close(other[name], y.grad[0], rtol=0.0, atol=bound * size, msg=lambda m, n=name: f"{n}: {m}")


def lowest(system: mbd.System, designs: dict[str, Tensor], **options: Any) -> Tensor:
    return mbd.equilibrium(system, designs=designs, **options).frequencies[:, :3].log().sum(1)


def some_poles(system: mbd.System, designs: dict[str, Tensor], **options: Any) -> Tensor:
    poles = mbd.equilibrium(system, designs=designs, **options).poles
    return (poles.real + 0.03 * poles.imag)[:, [1, 3, 5]].sum(1)


@pytest.mark.thorough
@pytest.mark.parametrize("values", [lowest, some_poles])
@pytest.mark.parametrize("driven", [True, False])
def test_at_rest(values, driven):
    """Of a bent plate on an arm: by angles, a load and a spring, with the equilibrium that moves with them."""
    names = ["rod.laminate.angles", "push.x", "motor.amplitude" if driven else "spring.stiffness"]
    check(hanging(driven), names, lambda s, b: values(s, b, times=(0.1,)))
    assert set(names) <= set(NAMES)


def blade(offset: Any = 0.1, speed: float = 30.0, damping: float = 1e-5) -> mbd.System:
    """A laminated strip on a hub, off its axis and at a pitch, with a motor."""
    ply = mbd.Ply(E1=140e9, E2=10e9, G12=5e9, G13=5e9, G23=4e9, nu12=0.3, density=1600.0)
    section = mbd.sections.strip(0.04, ply, mbd.deg([20.0, -50.0, 35.0, 80.0]), 5e-4, cells=(4, 1))
    beam = mbd.FlexibleBeam("blade", mbd.BeamLine.straight(0.6, 4), section, damping=damping)
    hub = mbd.RigidBody("hub", 1.0, (1e-2, 1e-2, 1e-2))
    tip = mbd.RigidBody("tip", V(0.05), (1e-5, 1e-5, 1e-5), position=(0.7, 0.02, 0.01))
    joints = [
        mbd.Revolute(GROUND.at(), hub.at(), axis="z", name="hinge"),
        mbd.Drive(GROUND.at(), hub.at(), axis="z", speed=speed, name="motor"),
        mbd.Fixed(hub.at(offset, 0, 0), beam.at("start"), name="root"),
        mbd.Fixed(beam.at("end"), tip.at(0.0, -0.02, -0.01), name="weld"),
    ]
    return mbd.System([hub, beam, tip], joints)


def angles_of(system: mbd.System) -> list[str]:
    return [name for name, _ in system.named_parameters() if name.endswith("angles")]


@pytest.mark.thorough
@pytest.mark.parametrize("values", [lowest, some_poles])
def test_in_steady_rotation(values):
    """Of a bent blade: by ply angles and a tip mass."""
    system = blade()
    # By the mass the values carry the rounding of the equilibrium: differences err by 1e-6 with steps of 1e-3, 5e-8 with 1e-2.
    steps = {"tip.mass": 1e-2}
    check(system, [*angles_of(system), "tip.mass"], lambda s, b: values(s, b, spin=(0.0, 0.0, 30.0)), steps=steps)


def test_by_the_speed():
    """Of a mass in the ground's bearings, seen turning: d(w + speed)/d(speed) = 1 and d(w - speed)/d(speed) = -1."""
    body = mbd.RigidBody("disk", 2.0, (0.02, 0.01, 0.01))
    hold = mbd.Bushing(GROUND.at(), body.at(), stiffness=(1e4, 8e3, 8e3), turning_stiffness=(0.0, 1e3, 1e3))
    system = mbd.System([body], forces=[hold])
    spin = torch.tensor([[9.0, 0.0, 0.0], [11.0, 0.0, 0.0]], dtype=torch.float64, requires_grad=True)
    rest = mbd.equilibrium(system, spin=spin)
    for shift in (-1.0, 1.0):
        w = 2.0 * math.pi * rest.frequencies
        k = (w - (math.sqrt(4e3) + shift * spin[:, :1])).detach().abs().argmin(1, keepdim=True)
        (slope,) = torch.autograd.grad(w.gather(1, k).sum(), spin, retain_graph=True)
        assert_close(slope[:, 0], torch.full((2,), shift, dtype=torch.float64), rtol=1e-9, atol=0.0)


@pytest.mark.thorough
def test_eigenvalues_that_coincide():
    """A rotor at rest whose stiffness passes through symmetry: the sum of two frequencies is smooth, one is refused."""
    system = rotor(1.5, {0.5: 0.28}, (0.0, 1.5), (V(1e6), 1e6), 6)
    names = [name for name, _ in system.named_parameters() if name.endswith("stiffness_y")]
    k = {name: torch.full((1,), 1e6, dtype=torch.float64, requires_grad=True) for name in names}
    w = mbd.equilibrium(system, designs=k).frequencies
    assert float(w[0, 2]) == pytest.approx(float(w[0, 3]), rel=1e-9)
    pair = w[0, 2:4].sum()
    slope = torch.autograd.grad(pair, list(k.values()), retain_graph=True)
    with refused("number", [3, 4]):
        torch.autograd.grad(w[0, 2], list(k.values()), retain_graph=True)
    h = 1e2
    for name, by in zip(names, slope, strict=True):
        shifted = [
            mbd.equilibrium(system, designs={n: x.detach() + sign * h * (n == name) for n, x in k.items()}).frequencies
            for sign in (-1.0, 1.0)
        ]
        assert float(by) == pytest.approx(float((shifted[1] - shifted[0])[0, 2:4].sum()) / (2.0 * h), rel=1e-6)


def test_what_has_no_derivative_is_named():
    """A free motion, and the double pole of one: zeros would be lost gradients."""
    body = mbd.RigidBody("disk", V(2.0), (0.02, 0.01, 0.01))
    hinge = mbd.Revolute(GROUND.at(), body.at(), axis="z")
    system = mbd.System([body], [hinge])
    with refused("number", 1, "free motion"):
        mbd.equilibrium(system).frequencies.sum().backward()
    with refused("number", 1, "free motion"):
        mbd.equilibrium(system).poles.real.sum().backward()
    spring = mbd.RotationalSpringDamper(GROUND.at(), body.at(), axis="z", stiffness=V(3.0), name="s")
    held, x = mbd.System([body], [hinge], [spring]), torch.tensor(2.0, dtype=torch.float64)
    with refused("motion"):
        torch.func.hessian(lambda k: mbd.equilibrium(held, designs={"s.stiffness": k[None]}).frequencies[0, 0])(x)


def chain(k: float = 50.0, d: float = 2.0, masses: int = 3, held: bool = False) -> mbd.System:
    """Masses of 2 kg on a rail, with springs and dampers between them; held: also to the ground."""
    bodies = [mbd.RigidBody(f"mass{i}", 2.0, (1.0, 1.0, 1.0)) for i in range(masses)]
    ends = [GROUND] * held + bodies
    springs = [
        mbd.AxialSpringDamper(a.at(), b.at(), axis="y", stiffness=V(k), damping=d, name=f"spring{i}")
        for i, (a, b) in enumerate(itertools.pairwise(ends))
    ]
    return mbd.System(bodies, [mbd.Prismatic(GROUND.at(), b.at(), axis="y") for b in bodies], springs)


def test_poles_of_a_free_motion_are_zero_and_the_others_count():
    """Free in one direction: its poles would be +-1e-8 by rounding, and the first of the poles that oscillate."""
    k = torch.tensor([50.0], dtype=torch.float64, requires_grad=True)
    rest = mbd.equilibrium(chain(), designs={"spring0.stiffness": k})
    assert rest.poles[0, :2].tolist() == [0.0, 0.0]
    # D w / (2 k), w^2 = k / m, 3 k / m.
    assert rest.damping_ratios[0, :2].tolist() == pytest.approx([0.1, 0.1 * 3.0**0.5])
    (slope,) = torch.autograd.grad(rest.damping_ratios[0, 0], k, retain_graph=True)
    assert float(slope) == pytest.approx(-0.1 / (4.0 * 50.0), rel=1e-9)  # one of two springs alike, at constant damping
    motion = mbd.simulate(chain(), 1e-4, steps=2)
    assert float(mbd.vibrations.DampingRatio(1)(motion)) == pytest.approx(0.1)
    assert float(mbd.vibrations.StabilityMargin()(motion)) == 0.0
    with refused("number", 2, "free motion", kind=mbd.DesignFailure):
        mbd.vibrations.StabilityMargin()(motion).sum().backward()


def test_slow_poles_of_strong_dampers_are_no_free_motions():
    poles = mbd.equilibrium(chain(1.0, 1e6, 2, held=True)).poles[0].real
    assert poles[2:].tolist() == pytest.approx([-1e-6, -1e-6], rel=1e-3)  # -k / d


def test_poles_without_a_mass_are_refused_by_name():
    body = mbd.RigidBody("mass", 1.0, (0.0, 0.0, 0.0))
    system = mbd.System([body], [mbd.Spherical(GROUND.at(), body.at(0, 0, -1.0))], gravity=(0, 0, -9.81))
    with refused("system", kind=mbd.DesignFailure):
        mbd.equilibrium(system).poles  # noqa: B018


def test_vibrations_that_grow_in_rotation_have_no_derivative():
    """A mass on negative springs, seen by a turning observer: s = +-i speed +- sqrt(-k), of which i speed is no eigenvalue."""
    speed, k = 3.0, -1.0
    eye = torch.eye(2, dtype=torch.float64)
    C = 2.0 * speed * torch.tensor([[0.0, -1.0], [1.0, 0.0]]).double()
    rest = Linearization.of_matrices(eye, C, (k - speed**2) * eye)
    spectrum = Spectrum.natural(rest)
    assert spectrum.values.isnan().all()
    assert spectrum.fault == ("not a number: vibrations grow",) * 2


def servo_arm() -> mbd.System:
    """A laminated arm that a servo holds against its weight: a network of the hinge and of the tip's velocity."""
    law = torch.nn.Sequential(torch.nn.Linear(5, 2), torch.nn.Tanh(), torch.nn.Linear(2, 1)).double()
    make = torch.Generator().manual_seed(7)
    with torch.no_grad():
        for x in law.parameters():
            x.copy_(0.1 * torch.randn(x.shape, generator=make, dtype=torch.float64))
        law[0].weight[0, :2] = torch.tensor([1.0, 0.05])
        law[2].weight[:] = torch.tensor([[-3.0, 0.4]])
    arm = plate("arm", made_of=laminate((20.0, -50.0), 3e-3, SOFT), damping=1e-4, position=(0.15, 0.0, 0.0))
    hinge = mbd.Revolute(GROUND.at(axes=turned(0.2, 0.5, -0.4)), arm.at("left"), axis="y", name="hinge")
    joint = [mbd.signals.JointAngle(hinge), mbd.signals.JointRate(hinge)]
    servo = mbd.Controller(
        law, [*joint, mbd.signals.PointVelocity(arm.at("right"))], [mbd.signals.JointTorque(hinge)], name="servo"
    )
    return mbd.System([arm], [hinge], [servo], gravity=(0.5, -3.0, 1.0), truncation=None)


@pytest.mark.thorough
def test_under_control():
    """By the weights of a small network and by ply angles; the equilibrium moves with all of them."""
    system = servo_arm()
    check(system, ["servo.0.weight", "servo.2.weight", "arm.laminate.angles"], some_poles)


def test_by_gains_in_closed_form():
    """s = (-k_d +- sqrt(k_d^2 - 4 m k_p)) / (2 m) of a mass on a rail under a force -k_p x - k_d x'."""
    mass, gains = torch.tensor([2.0]).double(), torch.tensor([[[-50.0, -3.0]]]).double()
    body = mbd.RigidBody("mass", V(2.0), (1.0, 1.0, 1.0))
    rail = mbd.Prismatic(GROUND.at(), body.at(), axis="y")
    law = torch.nn.Linear(2, 1, bias=False).double()
    read = [mbd.signals.JointTravel(rail), mbd.signals.JointSpeed(rail)]
    system = mbd.System([body], [rail], [mbd.Controller(law, read, [mbd.signals.JointForce(rail)], name="servo")])
    for x in (mass, gains):
        x.requires_grad_()
    s = mbd.equilibrium(system, designs={"mass.mass": mass, "servo.weight": gains}).poles[0, 1]
    expected = (gains[0, 0, 1] + torch.sqrt(gains[0, 0, 1] ** 2 + 4.0 * mass[0] * gains[0, 0, 0] + 0j)) / (
        2.0 * mass[0]
    )
    assert_close(s, expected, rtol=1e-12, atol=0.0)
    for part in (lambda z: z.real, lambda z: z.imag):
        slopes = [torch.autograd.grad(part(z), [mass, gains], retain_graph=True) for z in (s, expected)]
        for x, y in zip(*slopes, strict=True):
            assert_close(x, y, rtol=1e-10, atol=1e-14)


def test_a_refusal_names_the_design():
    """A hinge whose spring is slack in the second design."""
    wheel = mbd.RigidBody("wheel", 1.0, (1.0, 1.0, 1.0))
    hinge = mbd.Revolute(mbd.Ground().at(), wheel.at(), axis="z", name="hinge")
    spring = mbd.RotationalSpringDamper(mbd.Ground().at(), wheel.at(), "z", stiffness=mbd.variable(4.0), name="spring")
    k = torch.tensor([4.0, 0.0], dtype=torch.float64, requires_grad=True)
    rest = mbd.equilibrium(mbd.System([wheel], [hinge], [spring]), designs={"spring.stiffness": k})
    with refused("number", 1, "lane 1", kind=mbd.DesignFailure):
        rest.frequencies.sum().backward()


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("designs", [[[0.7, -0.3], [0.0, 0.0]], [[0.0, 0.0], [0.7, -0.3]]])
def test_designs_that_retain_different_numbers_of_modes_answer_as_alone(designs: list[list[float]]):
    """Missing modes are infinite at the end: no vibration is lost, and measures have the values and gradients of one design."""
    system, plies = mbd.examples.arm(modes=4), "arm.laminate.angles"
    alone = [mbd.equilibrium(system, designs={plies: tensor(*x)}) for x in designs]
    counts = [x.frequencies.shape[1] for x in alone]
    assert counts[0] != counts[1]
    b = tensor(*designs).requires_grad_()
    batch = mbd.equilibrium(system, designs={plies: b})
    for lane, (one, n) in enumerate(zip(alone, counts, strict=True)):
        for x, y, k in ((batch.frequencies, one.frequencies, n), (batch.poles, one.poles, 2 * n)):
            assert_close(x[lane, :k].detach(), y[0].detach(), rtol=1e-9, atol=1e-6)
            assert bool(x[lane, k:].isinf().all())
        assert bool((batch.poles[lane, 2 * n :].real == -torch.inf).all())
        assert_close(batch.damping_ratios[lane, : n - 1], one.damping_ratios[0, : n - 1], rtol=1e-6, atol=1e-9)
    finite = batch.frequencies.isfinite()
    (slopes,) = torch.autograd.grad(batch.frequencies[finite].sum(), b)
    forward = torch.func.jvp(
        lambda x: mbd.equilibrium(system, designs={plies: x}).frequencies[finite].sum(), (b.detach(),), (slopes,)
    )[1]
    assert_close(forward, slopes.square().sum(), rtol=1e-8, atol=0)
    for lane, x in enumerate(designs):
        y = tensor(*x).requires_grad_()
        (own,) = torch.autograd.grad(mbd.equilibrium(system, designs={plies: y}).frequencies.sum(), y)
        assert_close(slopes[lane], own, rtol=1e-6, atol=1e-9 * float(slopes.abs().max()))
    with pytest.raises(mbd.DesignFailure, match=f"the vibrations of lane {counts.index(min(counts))}"):
        batch.eigenvalues("natural", [max(counts) - 1])
