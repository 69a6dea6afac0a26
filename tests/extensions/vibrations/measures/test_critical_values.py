"""Critical speeds and limits of stability in closed form, with their implicit gradients; what is not there is named."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

import torchmbd as mbd
from tests.multibody.equilibrium.test_ground_observer import rotor
from tests.refused import ANY, refused

V, GROUND = mbd.variable, mbd.Ground()
DISK = {"axis": "x", "observer": "ground"}


def disk(unequal: float = 8e3) -> mbd.System:
    """A thin disk, 2 kg, polar inertia 0.02, across 0.01 kg m2, in bearings that it feels as springs."""
    body = mbd.RigidBody("disk", 2.0, (0.02, 0.01, 0.01))
    hold = mbd.Bushing(
        GROUND.at(), body.at(), stiffness=(5e4, V(unequal), 5e3), turning_stiffness=(0.0, V(30.0), 30.0), name="bearing"
    )
    return mbd.System([body], forces=[hold])


def measured(measure: mbd.Measure, system: mbd.System, designs: dict[str, Tensor], **options: Any) -> Any:
    motion = mbd.simulate(system, 1e-4, steps=2, designs=designs, variables=list(designs), **options)
    return measure.value_and_gradient(motion)


@pytest.mark.thorough
@pytest.mark.parametrize("mode", ["forward", "reverse"])
def test_critical_speeds_of_a_disk(mode):
    """sqrt(k / m) of both directions, and sqrt(k / (J + Jp)) of backward whirl; a thin disk has no forward one."""
    system, k = disk(), torch.tensor([8e3, 9e3], dtype=torch.float64)
    speeds = [math.sqrt(30.0 / 0.03), math.sqrt(5e3 / 2.0), math.sqrt(8e3 / 2.0)]
    for number, expected in enumerate(speeds, 1):
        measure = mbd.vibrations.CriticalSpeed(number, between=(10.0, 90.0), points=9, **DISK)
        result = measured(measure, system, {"bearing.stiffness_y": k}, gradients=mode)
        assert float(result.value[0]) == pytest.approx(expected, rel=1e-9)
        slope = 0.5 / math.sqrt(8e3 * 2.0) if number == 3 else 0.0
        assert float(result.gradient[0, 0]) == pytest.approx(slope, rel=1e-8, abs=1e-12)
    assert float(result.value[1]) == pytest.approx(math.sqrt(9e3 / 2.0), rel=1e-9)


@pytest.mark.thorough
def test_an_order_is_a_multiple_of_the_speed():
    measure = mbd.vibrations.CriticalSpeed(1, order=2.0, between=(22.0, 29.0), points=4, **DISK)
    result = measured(measure, disk(), {"bearing.stiffness_y": torch.tensor([8e3]).double()}, gradients="forward")
    assert float(result.value) == pytest.approx(math.sqrt(5e3 / 2.0) / 2.0, rel=1e-9)


def with_internal_damping(c: float, speed: float = 50.0) -> mbd.System:
    """A disk on a shaft in a round bearing; c: between disk and shaft, which drives whirl at high speeds."""
    shaft = mbd.RigidBody("shaft", 0.5, (1e-3, 1e-3, 1e-3))
    disc = mbd.RigidBody("disc", 2.0, (0.01, 0.01, 0.02))
    bearing = mbd.Bushing(
        GROUND.at(), shaft.at(), (1.2e4, 3e4, 1e5), (2.0, 2.0, 10.0), (50.0, 50.0, 0.0), (0.05, 0.05, 0.0)
    )
    flex = mbd.Bushing(shaft.at(), disc.at(), (2e4, 2e4, 1e5), (c,) * 3, (80.0,) * 3, (0.01,) * 3)
    drive = mbd.Drive(GROUND, shaft, axis="z", speed=speed)
    return mbd.System([shaft, disc], [drive], [bearing, flex], free=["shaft", "disc"])


@pytest.mark.thorough
@pytest.mark.parametrize("points", [12, 40])
def test_damping_changes_no_critical_speed_and_no_clearance(points):
    """Natural frequencies are those without damping, also where internal damping makes vibrations grow."""
    seen: dict[str, Any] = {"axis": "z", "observer": "ground"}
    critical = [mbd.vibrations.CriticalSpeed(n, between=(1.0, 1000.0), points=points, **seen) for n in (1, 2)]
    clear = mbd.vibrations.CampbellClearance((1, 2), (20.0, 400.0), (1, 2, 3), points=4, **seen)
    calm, driven = (mbd.simulate(with_internal_damping(c), 1e-4, steps=2) for c in (0.0, 300.0))
    for measure in (*critical, clear):
        assert measure(driven).flatten().tolist() == pytest.approx(measure(calm).flatten().tolist(), rel=1e-9)
    stable = [
        mbd.equilibrium(with_internal_damping(300.0, w), spin=(0, 0, w), observer="ground").stable
        for w in (10.0, 400.0)
    ]
    assert stable == [True, False]


@pytest.mark.thorough
def test_whirls_that_coincide_have_a_critical_speed():
    """In equal bearings: the value is there, a derivative by the stiffness in one direction is not."""
    system = disk(5e3)
    measure = mbd.vibrations.CriticalSpeed(2, between=(10.0, 90.0), points=9, **DISK)
    k = torch.tensor([5e3], dtype=torch.float64, requires_grad=True)
    speed = measure(mbd.simulate(system, 1e-4, steps=2, designs={"bearing.stiffness_y": k}))
    assert float(speed) == pytest.approx(50.0, rel=1e-9)
    with refused("number", ANY, "coincide", kind=mbd.DesignFailure):
        speed.sum().backward()


@pytest.mark.thorough
def test_rotor5_of_ross():
    """petrobras/ross, tests/test_rotor_assembly.py: found by a search over speeds, extrapolated to elements of no length."""
    expected, result = [86.10505, 86.60493, 198.93259, 207.97166], []
    for elements in (10, 20):
        system = rotor(2.5, {1.0: 0.28, 1.5: 0.35}, (0.5, 2.0), (1e6, 1e6), elements)
        motion = mbd.simulate(system, 1e-5, steps=2)
        ranges = ((80.0, 90.0), (80.0, 90.0), (190.0, 215.0), (190.0, 215.0))
        result.append(
            [
                float(mbd.vibrations.CriticalSpeed(1 + k % 2, between=between, points=3, **DISK)(motion))
                for k, between in enumerate(ranges)
            ]
        )
    for wide, narrow, number in zip(*result, expected, strict=True):
        assert (4.0 * narrow - wide) / 3.0 == pytest.approx(number, rel=1e-3)


def shaft_with_modes() -> mbd.System:
    """A thin round shaft in two stiff round bearings, a small disk in its middle."""
    steel = mbd.GivenSection.isotropic(80e9, 0.3, 1600.0, 2e-4, Iyy=2e-8, Izz=2e-8, J=4e-8)
    line = mbd.BeamLine.straight(1.2, elements=4)
    shaft = mbd.FlexibleBody.beam("shaft", line, steel, modes=6, position=(0.6, 0, 0))
    disk = mbd.RigidBody("disk", V(3.0), (6e-3, 3e-3, 3e-3), position=(0.6, 0, 0))
    bearings = [
        mbd.Bushing(GROUND.at(0, 0, 0), shaft.at("start"), (1e7, 5e7, 5e7)),
        mbd.Bushing(GROUND.at(1.2, 0, 0), shaft.at("end"), (0.0, 5e7, 5e7)),
    ]
    hub = mbd.Fixed(shaft.at("center"), disk.at(), name="hub")
    return mbd.System([shaft, disk], [hub], bearings, free=["shaft", "disk"])


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_critical_speed_is_one_of_a_fixed_observer_whatever_axes_are_used():
    """Of a shaft with modes, whose frequencies are those of axes that turn with it: that at rest, as the disk does not tilt."""
    system = shaft_with_modes()
    m = torch.tensor([3.0], dtype=torch.float64, requires_grad=True)
    motion = mbd.simulate(system, 1e-4, steps=2, designs={"disk.mass": m}, backend="eager")
    rest = 2.0 * math.pi * mbd.vibrations.SystemFrequency(cluster=(2, 3))(motion)
    (expected,) = torch.autograd.grad(rest.sum(), m, retain_graph=True)
    for observer in ("turning", "ground"):
        critical = mbd.vibrations.CriticalSpeed(1, between=(50.0, 400.0), points=4, axis="x", observer=observer)(motion)
        assert float(critical) == pytest.approx(float(rest), rel=1e-4)
        (slope,) = torch.autograd.grad(critical.sum(), m, retain_graph=True)
        assert float(slope) == pytest.approx(float(expected), rel=1e-3)


@pytest.mark.thorough
def test_the_observer_chooses_the_axes_and_leaves_the_speed():
    """Backward whirl of a disk that tilts, at sqrt(k / (I_d + I_p)), in axes of both; two stiffnesses have no turning axes."""

    def critical(observer: str, other: float = 8e4) -> torch.Tensor:
        disk, turning = mbd.RigidBody("disk", 2.0, (0.015, 0.01, 0.01)), mbd.variable(300.0)
        stiffness = {"stiffness": (5e4, 8e4, other), "turning_stiffness": (0.0, turning, turning)}
        mount = mbd.Bushing(GROUND.at(), disk.at(), **stiffness, name="mount")
        options = {"steps": 2, "designs": {"mount.turning_stiffness_y": k}, "backend": "eager"}
        motion = mbd.simulate(mbd.System([disk], forces=[mount]), 1e-4, **options)
        return mbd.vibrations.CriticalSpeed(1, between=(80.0, 120.0), points=4, axis="x", observer=observer)(motion)

    expected = math.sqrt(300.0 / 0.025)
    k = torch.tensor([300.0], dtype=torch.float64, requires_grad=True)
    for observer in ("ground", "turning"):
        speed = critical(observer)
        (slope,) = torch.autograd.grad(speed.sum(), k)
        assert float(speed) == pytest.approx(expected, rel=1e-6)
        assert float(slope) == pytest.approx(expected / 600.0, rel=1e-5)
    assert float(critical("ground", 6e4)) == pytest.approx(expected, rel=1e-6)
    with refused("system", ANY, "observer", kind=mbd.DesignFailure):
        critical("turning", 6e4)


def ziegler(k: float = 3.0, c: float = 0.2) -> mbd.System:
    """Two links of 1 m with 2 kg at their joint and 1 kg at the tip, springs and dampers in hinges, a force that follows."""
    first, second = (
        mbd.RigidBody(name, m, (1e-7, 1e-7, 1e-7), position=(x, 0.0, 0.0))
        for name, m, x in (("first", 2.0, 1.0), ("second", 1.0, 2.0))
    )
    ends = [(GROUND.at(), first.at(-1.0, 0, 0)), (first.at(), second.at(-1.0, 0, 0))]
    hinges = [mbd.Revolute(a, b, axis="z", name=f"hinge{i}") for i, (a, b) in enumerate(ends)]
    springs = [
        mbd.RotationalSpringDamper(a, b, axis="z", stiffness=V(k), damping=V(c), name=f"spring{i}")
        for i, (a, b) in enumerate(ends)
    ]
    back = torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64))
    push = mbd.Force(second.at(0.0, 0.0, 0.0, axes=back), (V(1.0), 0.0, 0.0), axes="frame", name="push")
    return mbd.System([first, second], hinges, [*springs, push])


@pytest.mark.thorough
@pytest.mark.parametrize("mode", ["forward", "reverse"])
def test_flutter_of_zieglers_column(mode):
    """41/28 k + c^2 / 2 with masses 2, 1 and links of length 1: Herrmann and Jong, J. Appl. Mech. 32 (1965) 592-597."""
    k, c = 3.0, 0.2
    names = ["spring0.damping", "spring1.damping", "spring0.stiffness", "spring1.stiffness"]
    designs = {name: torch.tensor([c if "damping" in name else k], dtype=torch.float64) for name in names}
    result = measured(mbd.vibrations.StabilityLimit("push.x", (1.0, 6.0), points=6), ziegler(), designs, gradients=mode)
    assert float(result.value) == pytest.approx(41.0 / 28.0 * k + 0.5 * c**2, rel=1e-6)
    slopes = result.gradient[0]
    assert float(slopes[2] + slopes[3]) == pytest.approx(41.0 / 28.0, rel=1e-6)
    assert float(slopes[0] + slopes[1]) == pytest.approx(c, rel=1e-5)


def test_what_is_not_there_is_named():
    system = disk()
    motion = mbd.simulate(system, 1e-4, steps=2)
    with refused("between", (20.0, 35.0), "critical speed 2 of order 1", kind=mbd.DesignFailure):
        mbd.vibrations.CriticalSpeed(2, between=(20.0, 35.0), points=4, **DISK)(motion)
    column = mbd.simulate(ziegler(), 1e-4, steps=2)
    with refused("between", ANY, "no vibration begins to grow", kind=mbd.DesignFailure):
        mbd.vibrations.StabilityLimit("push.x", (0.1, 1.0), points=3)(column)
    undamped = mbd.simulate(ziegler(c=0.0), 1e-4, steps=2)
    with refused("parameter", "push.x", "push.x = 5", kind=mbd.DesignFailure):
        mbd.vibrations.StabilityLimit("push.x", (1.0, 13.0), points=4)(undamped)
    with refused("parameter of one number", "push.w"):
        mbd.Problem(ziegler(), 1e-4, mbd.vibrations.StabilityLimit("push.w"), steps=2)
    for make, path in (
        (lambda: mbd.vibrations.CriticalSpeed(0), "number"),
        (lambda: mbd.vibrations.CriticalSpeed(1, between=(0.0, 2.0)), "between"),
        (lambda: mbd.vibrations.CriticalSpeed(1, order=-1.0), "order"),
        (lambda: mbd.vibrations.StabilityLimit("push.x", (2.0, 1.0)), "between"),
        (lambda: mbd.vibrations.StabilityLimit("push.x", (1.0, 2.0), points=1), "points"),
        (lambda: mbd.vibrations.StabilityLimit(3), "parameter"),
    ):
        with refused(path):
            make()


@pytest.mark.parametrize("stiffening", [True, False])
def test_an_unbalanced_rotor_is_told_what_it_lacks(stiffening):
    """The disk in the middle of a round shaft turns about a point beside its center of mass."""
    rod = mbd.GivenSection.isotropic(E=210e9, nu=0.3, density=7850.0, area=3e-4, Iyy=7.9e-9, Izz=7.9e-9, J=1.6e-8)
    ends = {"reduction": "craig-bampton", "interface": ["center", "end"], "stiffening": stiffening}
    shaft = mbd.FlexibleBody.beam("shaft", mbd.BeamLine.straight(1.0, 4), rod, modes=2, reference="start", **ends)
    ground, bearing = mbd.Ground(), (1e8, 1e8, 1e8)
    for eccentricity in (0.0, 1e-3):
        disk = mbd.RigidBody("disk", 5.0, (0.02, 0.01, 0.01), center=(0, eccentricity, 0), position=(0.5, 0, 0))
        joints = [mbd.Fixed(shaft.at("center"), disk.at()), mbd.Drive(ground, shaft, axis="x", speed=10.0)]
        bearings = [mbd.Bushing(ground.at(x, 0, 0), shaft.at(n), bearing) for n, x in (("start", 0.0), ("end", 1.0))]
        motion = mbd.simulate(mbd.System([shaft, disk], joints, bearings), 1e-4, steps=2)
        critical = mbd.vibrations.CriticalSpeed(1, between=(40.0, 300.0), axis="x")
        if eccentricity:
            with pytest.raises(mbd.DesignFailure, match="an unbalance has no steady state"):
                critical(motion)
        else:
            assert critical(motion).item() == pytest.approx(
                math.sqrt(48 * 210e9 * 7.9e-9 / (5.0 + 17 / 35 * 2.355)), rel=0.02
            )
