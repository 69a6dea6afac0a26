"""Gradients of motions that start in static equilibrium, of equilibria themselves, and by what is given for a start."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import GRAVITY, SOFT, box, finished, laminate, plate, tensor, turned
from tests.sensitivity.number_cases import GROUND, check, check_native, differences, number

V = mbd.variable
NAMES = ("rod.laminate.angles", "hinge_a.x", "tip_a.y", "spring.stiffness", "push.x", "motor.amplitude")


def hanging(driven: bool = True) -> mbd.System:
    """An arm on a hinge, held by a spring or turned by a drive that runs at the start, and a soft plate at its end."""
    tip, swing = tensor(0.2, 0.1, -0.05), turned(-0.5, 0.2, 0.9)
    arm = box("arm", position=(0.1, 0.05, -0.02), axes=turned(0.4, -0.7, 0.3))
    origin = arm.position + arm.axes @ tip - swing @ tensor(-0.15, 0.0, 0.0)
    rod = plate("rod", 2, made_of=laminate((20.0, -50.0), 3e-3, SOFT), position=origin, axes=swing)
    foot = GROUND.at(V(0.1), 0.05, -0.02, axes=turned(0.2, 0.5, -0.4))
    joints = [
        mbd.Revolute(foot, arm.at(), axis="x", name="hinge"),
        mbd.Universal(arm.at(0.2, V(0.1), -0.05), rod.at("left"), axes="zx", name="tip"),
    ]
    if driven:
        joints.append(mbd.Drive(foot, arm.at(), axis="x", angle=mbd.Sine(V(0.4), 1.5), name="motor"))
    forces = [
        mbd.SpringDamper(GROUND.at(), arm.at(0.1, 0.0, 0.02), stiffness=V(20.0), damping=0.3, name="spring"),
        mbd.Force(rod.at("right"), (V(0.3), -0.2, 0.1), name="push"),
    ]
    return mbd.System([arm, rod], joints, forces, gravity=GRAVITY)


def resting(system: mbd.System, designs: dict[str, Tensor], **options) -> Tensor:
    return number(system, designs, start="equilibrium", **options)


def static(system: mbd.System, designs: dict[str, Tensor], times=(0.0, 0.1), **options) -> Tensor:
    """Positions, reactions and energies of an equilibrium at two times [lanes]."""
    result = mbd.equilibrium(system, times=times, designs=designs)
    parts = [result.body("rod").nodes, result.body("arm").p, 0.1 * result.lam, result.reaction("hinge").torque]
    return sum((y * (1.0 + y)).flatten(1).sum(1) for y in parts) + result.body("rod").strain_energy.sum(1)


@pytest.mark.thorough
@pytest.mark.parametrize(("driven", "names"), [(False, ("tip_a.y", "spring.stiffness")), (True, NAMES)])
def test_gradients_of_motions_from_rest(driven, names):
    check(hanging(driven), list(names), resting)


@pytest.mark.thorough
def test_both_backends(native):
    check_native(hanging(), list(NAMES), resting)


@pytest.mark.thorough
def test_gradients_of_equilibria():
    system = hanging()
    start = {name: system.get_parameter(name).detach().clone() for name in NAMES}
    x = {name: y.clone().requires_grad_() for name, y in start.items()}
    static(system, x).sum().backward()
    forward = torch.func.jacfwd(lambda b: static(system, b)[0])(start)
    reverse = torch.func.jacrev(lambda b: static(system, b)[0])(start)
    expected = differences(lambda b: static(system, b), system, list(NAMES))
    for name, y in x.items():
        size = float(y.grad.abs().max())
        assert_close(forward[name], y.grad, rtol=0, atol=1e-8 * size)
        assert_close(reverse[name], y.grad, rtol=0, atol=1e-8 * size)
        assert_close(y.grad, expected[name], rtol=0, atol=1e-6 * size, msg=lambda m, n=name: f"{n}: {m}")


@pytest.mark.thorough
def test_phases_from_rest():
    """A locked hinge holds what hangs at it; forward and reverse agree, and with differences."""
    phases = [mbd.Phase(until=0.008, lock=["hinge"]), mbd.Phase()]
    system = hanging(False)

    def locked(system: mbd.System, designs: dict[str, Tensor], **options) -> Tensor:
        motion = finished(
            mbd.simulate(
                system,
                0.02,
                steps=6,
                iterations=(8, 4),
                designs=designs,
                phases=phases,
                start="equilibrium",
                **options,
            )
        )
        return (motion.q[:, :, :14].square() + motion.q[:, :, :14]).sum((1, 2)) + motion.body("rod").nodes.sum(
            (1, 2, 3)
        )

    check(system, ["rod.laminate.angles", "hinge_a.x", "push.x"], locked)


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore:the joints do not allow the initial velocities")
def test_gradients_by_what_is_given_for_the_start():
    """Reverse mode: by modal coordinates, rates, and through a motion into the next."""
    system = hanging(False)

    def f(w: Tensor, v: Tensor) -> Tensor:
        motion = mbd.simulate(
            system, 0.02, steps=6, iterations=(8, 4), start={"rod.modal": w, "arm.angular_velocity": v}
        )
        more = mbd.simulate(system, 0.02, steps=6, iterations=(8, 4), start=motion)
        return more.body("rod").nodes.square().sum() + more.v.square().sum()

    w, v = tensor(1e-3, -5e-4).requires_grad_(), tensor(0.3, -0.2, 0.5).requires_grad_()
    f(w, v).backward()
    for way in ((tensor(0.6, -0.8), tensor(0.0, 0.0, 0.0)), (tensor(0.0, 0.0), tensor(0.5, -0.7, 0.4))):
        h = 1e-3 * max(float(x.detach().abs().max()) for x, e in zip((w, v), way, strict=True) if e.any())

        def slope(h: float, way=way) -> Tensor:
            ends = [f(*(x.detach() + s * h * e for x, e in zip((w, v), way, strict=True))) for s in (1.0, -1.0)]
            return ((ends[0] - ends[1]) / (2.0 * h)).detach()

        expected = (4.0 * slope(h) - slope(2.0 * h)) / 3.0
        assert_close(w.grad @ way[0] + v.grad @ way[1], expected, rtol=1e-6, atol=0)


def two_springs(kind: str, soft: float, stiff: float) -> mbd.System:
    """A soft and a stiff spring: of two sliders, of one behind the other, or in two directions of one body."""
    slider, other = box("slider"), box("other", position=(0.5, 0.0, 0.0))
    if kind == "directions":
        spring = mbd.Bushing(GROUND.at(), slider.at(), (V(soft), stiff, stiff), turning_stiffness=stiff, name="soft")
        return mbd.System([slider], [], [spring, mbd.Force(slider.at(), (0.5, 0.0, 1.0), name="push")])
    foot = GROUND.at(0.5, 0.0, 0.0) if kind == "apart" else slider.at(0.5, 0.0, 0.0)
    joints = [mbd.Prismatic(x, y.at(), axis="x") for x, y in ((GROUND.at(), slider), (GROUND.at(0.5, 0, 0), other))]
    forces = [
        mbd.Bushing(GROUND.at(), slider.at(), (V(soft), 0.0, 0.0), name="soft"),
        mbd.Bushing(foot, other.at(), (stiff, 0.0, 0.0), name="stiff"),
        mbd.Force(slider.at(), (0.5, 0.0, 0.0), name="push"),
        mbd.Force(other.at(), (3.0, 0.0, 0.0), name="pull"),
    ]
    return mbd.System([slider, other], joints, forces)


@pytest.mark.parametrize("soft", [10.0, 1e-2])
@pytest.mark.parametrize(
    ("kind", "stiff"),
    [(x, y) for x in ("apart", "directions") for y in (1e6, 1e12)] + [("apart", 1e14), ("behind", 1e10)],
)
def test_a_soft_spring_beside_a_stiff_one_moves(kind: str, stiff: float, soft: float):
    """The travel F / k and its derivative -F / k^2 do not depend on the stiffness beside k, in both modes."""
    system = two_springs(kind, soft, stiff)
    [(name, k)] = [(n, x) for n, x in system.named_parameters() if n.startswith("soft")]
    force = 3.5 if kind == "behind" else 0.5

    def travel(k: Tensor) -> Tensor:
        return mbd.equilibrium(system, designs={name: k}).body("slider").r[0, 0, 0]

    assert_close(travel(k.detach()), tensor(force / soft).squeeze(), rtol=1e-12, atol=0)
    for differentiate in (torch.func.jacrev, torch.func.jacfwd):
        slope = differentiate(travel)(k.detach()).sum()
        assert_close(slope, tensor(-force / soft**2).squeeze(), rtol=1e-8, atol=0)


def test_a_spring_below_the_rounding_of_a_stiff_one_is_refused():
    with pytest.raises(mbd.DesignFailure, match="remain on force x"):
        mbd.equilibrium(two_springs("behind", 1e-2, 1e12))
