"""Every number that may be a design variable: forward = reverse, both = differences, native = eager, lanes = designs alone.

One test over a registry of systems: a new kind of parameter is a line in `SYSTEMS`, or a variable in one of them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import nn
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import GRAVITY, INERTIA, SOFT, box, laminate, plate, tensor, turned
from tests.refused import ANY, refused
from tests.sensitivity.number_cases import beam, check, check_native, hung, ply

pytestmark = [
    pytest.mark.usefixtures("compiled"),
    pytest.mark.filterwarnings("ignore:the joints do not allow|body|the retained modes|joints are open|units of"),
]

GROUND = mbd.Ground()
LEAN = turned(0.2, 0.5, -0.4)
RUBBER = {"E": 1.28e8, "nu": 0.3, "density": 1586.0}
v = mbd.variable


def parameter(*x: float) -> nn.Parameter:
    return nn.Parameter(tensor(*x))


def metal(**more: float) -> dict[str, nn.Parameter]:
    return {name: v(x) for name, x in (RUBBER | more).items()}


def tilted_gravity() -> mbd.System:
    """A rigid and a flexible pendulum; the direction of gravity is unknown."""
    arm = box("arm", angular_velocity=(0.0, 0.0, 1.0))
    rod = plate("rod", 2, made_of=laminate((20.0, -50.0), 3e-3, SOFT), position=(0.35, 0.0, 0.0))
    hinge = mbd.Revolute(GROUND.at(axes=LEAN), arm.at(), axis="x", name="hinge")
    return mbd.System(
        [arm, rod], [hinge, mbd.Spherical(arm.at(0.2, 0.0, 0.0), rod.at("left"))], gravity=parameter(*GRAVITY)
    )


def turned_joints() -> mbd.System:
    """Places and axes of joints on the ground, a rigid and a flexible body."""
    arm = box("arm", position=(0.1, 0.05, -0.02), axes=turned(0.4, -0.7, 0.3), angular_velocity=(2.0, -1.0, 3.0))
    tip, swing = tensor(0.2, 0.1, -0.05), turned(-0.5, 0.2, 0.9)
    origin = arm.position + arm.axes @ tip - swing @ tensor(-0.15, 0.0, 0.0)
    rod = plate("rod", 2, made_of=laminate((20.0, -50.0), 3e-3, SOFT), position=origin, axes=swing)
    foot = GROUND.at(v(0.1), v(0.05), -0.02, axes=LEAN, turn=(v(0.02), v(0.1), v(-0.03)))
    end = arm.at(v(0.2), v(0.1), v(-0.05), turn=(v(0.1), 0.05, v(0.03)))
    joints = [
        mbd.Revolute(foot, arm.at(), axis="x", name="hinge"),
        mbd.Revolute(end, rod.at("left"), axis="x", name="elbow"),
    ]
    return mbd.System([arm, rod], joints, gravity=GRAVITY)


def damped_rods() -> mbd.System:
    """Rayleigh's factors, one ratio for all modes."""
    section = mbd.sections.rectangle(0.01, 0.02, ply(), cells=(2, 2), angles=[0.3])
    return hung(beam(section, damping=v(1e-4)).damped(v(0.03), rate=v(0.5)), "start")


def ratio_of_each_mode() -> mbd.System:
    section = mbd.sections.rectangle(0.01, 0.02, ply(), cells=(2, 2), angles=[0.3])
    return hung(beam(section).damped(parameter(0.02, 0.05, 0.01, 0.03)), "start")


def metal_plate() -> mbd.System:
    made_of = mbd.Laminate(mbd.Ply.isotropic(**metal()), [0.1, 0.2], 3e-3)
    return hung(plate("rod", 2, made_of=made_of))


def metal_section() -> mbd.System:
    return hung(beam(mbd.sections.rectangle(0.01, 0.02, mbd.Ply.isotropic(**metal()), cells=(2, 2))), "start")


def metal_beam() -> mbd.System:
    return exact_beam(mbd.GivenSection.isotropic(**metal(area=2e-4, Iyy=1.7e-9, Izz=6.7e-9, J=4.6e-9)))


def entries_of_a_section() -> mbd.System:
    coupling = v(0.05)
    stiffness = torch.diag(tensor(2.6e4, 8.2e3, 8.2e3, 0.23, 0.22, 0.86)).tolist()
    mass = torch.diag(tensor(0.32, 0.32, 0.32, 1.3e-5, 3e-6, 1e-5)).tolist()
    stiffness[3][4] = stiffness[4][3] = coupling
    for k in (3, 4, 5):
        stiffness[k][k] = v(stiffness[k][k])
    mass[0][0] = mass[1][1] = mass[2][2] = v(0.32)
    return exact_beam(mbd.GivenSection(stiffness, mass))


def clamps_and_mounts() -> mbd.System:
    """A rod on an elastic clamp: stiffness and damping of each direction."""
    rod = plate("rod", 2, made_of=laminate((20.0, -50.0), 3e-3, SOFT))
    mount = mbd.Bushing(
        GROUND.at(-0.15, 0.0, 0.0),
        rod.at("left"),
        stiffness=(v(3e2), 4e2, v(5e2)),
        damping=v(0.3),
        turning_stiffness=v(0.8),
        turning_damping=(v(1e-3), 2e-3, v(3e-3)),
        name="clamp",
    )
    return mbd.System([rod], [], [mount], gravity=GRAVITY, free=["rod"])


def rubbing_joints() -> mbd.System:
    """Springs and friction in joints."""
    arm = box("arm", angular_velocity=(0.0, 0.0, 3.0))
    block = box("block", position=(0.3, 0.1, 0.0), velocity=(0.5, 0.0, 0.0))
    hinge = mbd.Revolute(GROUND.at(axes=LEAN), arm.at(), axis="z", name="hinge")
    slide = mbd.Prismatic(GROUND.at(axes=LEAN), block.at(), axis="x", name="slide")
    forces = [
        mbd.RotationalSpringDamper(GROUND.at(), arm.at(), law=mbd.forces.Friction(v(0.4), v(2.0)), name="rub"),
        mbd.AxialSpringDamper(
            GROUND.at(axes=LEAN), block.at(), axis="x", law=mbd.forces.Friction(v(2.0), v(0.8)), name="brake"
        ),
        mbd.SpringDamper(arm.at(0.1), block.at(), v(30.0), v(0.4), v(0.2), name="spring"),
    ]
    return mbd.System([arm, block], [hinge, slide], forces, gravity=GRAVITY)


def exact_beam(section: Any = None) -> mbd.System:
    """A beam of finite rotations, its damping, and a load."""
    numbers = RUBBER | {"area": 2e-4, "Iyy": 1.7e-9, "Izz": 6.7e-9, "J": 4.6e-9}
    section = section or mbd.GivenSection.isotropic(**numbers)
    rod = mbd.FlexibleBeam("rod", mbd.BeamLine.straight(0.3, elements=3), section, damping=v(2e-3))
    hinge = mbd.Revolute(GROUND.at(axes=LEAN), rod.at("start"), axis="x", name="hinge")
    return mbd.System([rod], [hinge], [mbd.Torque(rod.at("end"), (0.02, 0.03, v(0.01)), name="twist")], gravity=GRAVITY)


def masses_and_plies() -> mbd.System:
    """Numbers of a rigid body, of its start, and of plies."""
    arm = box(
        "arm",
        mass=v(0.7),
        inertia=nn.Parameter(INERTIA.clone()),
        center=parameter(0.03, -0.02, 0.04),
        angular_velocity=parameter(0.4, 0.3, 1.0),
    )
    soft = SOFT | {name: v(SOFT[name]) for name in ("E1", "E2", "G12", "nu12", "density")}
    rod = plate("rod", 2, made_of=mbd.Laminate(mbd.Ply(**soft), mbd.deg([20.0, -50.0]), parameter(1e-3, 2e-3)))
    joints = [
        mbd.Spherical(GROUND.at(), arm.at(), name="ball"),
        mbd.Universal(arm.at(0.2, 0.0, 0.0), rod.at("left"), name="cross"),
    ]
    return mbd.System([arm, rod], joints, gravity=GRAVITY)


#: What varies -> (system, steps of differences as shares of the parameters: 1e-3 by default)
SYSTEMS: dict[str, tuple[Callable[[], mbd.System], dict[str, float]]] = {
    "gravity": (tilted_gravity, {}),
    "places and axes of joints": (turned_joints, {"turn": 0.1}),
    "Rayleigh's factors and a damping ratio": (damped_rods, {}),
    "damping ratios": (ratio_of_each_mode, {}),
    "metal in a laminate": (metal_plate, {"nu": 0.02}),
    "metal in a section": (metal_section, {"nu": 0.03}),
    "metal of a beam": (metal_beam, {"section": 0.01, "twist": 0.05}),
    "entries of a section": (entries_of_a_section, {"stiffness": 0.03, "twist": 0.05}),
    "clamps": (clamps_and_mounts, {}),
    "springs and friction": (rubbing_joints, {"speed": 5e-3, "force": 3e-2}),  # linear: smaller steps show rounding
    "an exact beam": (exact_beam, {"twist": 0.05}),
    "bodies and plies": (masses_and_plies, {"nu12": 0.02}),
}


def variables(system: mbd.System) -> list[str]:
    return [name for name, x in system.named_parameters() if x.requires_grad and not name.endswith("angles")]


@pytest.mark.thorough
@pytest.mark.parametrize("kind", SYSTEMS)
def test_gradients(kind):
    build, sizes = SYSTEMS[kind]
    system = build()
    names = variables(system)
    steps = {name: size for name in names for part, size in sizes.items() if part in name}
    options = {"iterations": (14, 8), "duration": 2e-3} if system.beams else {}
    check(system, names, steps=steps, **options)
    check_native(system, names, **options)


def test_each_kind_has_its_names():
    """Names as files have them."""
    assert variables(tilted_gravity()) == ["gravity"]
    assert {"hinge_a.x", "hinge_a.turn_x", "elbow_a.turn_z"} < set(variables(turned_joints()))
    assert {"rod.damping.time", "rod.damping.rate", "rod.damping.ratios"} == set(variables(damped_rods()))
    assert {"rod.laminate.ply.E", "rod.laminate.ply.nu"} < set(variables(metal_plate()))
    assert {"rod.section.stiffness_45", "rod.section.mass_11"} < set(variables(entries_of_a_section()))
    assert {"clamp.stiffness_x", "clamp.turning_damping_z"} < set(variables(clamps_and_mounts()))
    assert {"rub.force", "brake.speed"} < set(variables(rubbing_joints()))


def test_metal_of_variables_is_the_metal_of_its_numbers():
    fixed, varying = mbd.Ply.isotropic(2.1e11, 0.3, 7850.0), mbd.Ply.isotropic(v(2.1e11), v(0.3), v(7850.0))
    for angle in (0.0, 0.4):
        one, other = (mbd.Laminate(ply, [angle], 2e-3).stiffness() for ply in (fixed, varying))
        assert_close(other.A, one.A)
        assert_close(other.As, one.As)


REFUSED: dict[str, tuple[Callable[[], object], str]] = {
    "negative stiffness": (lambda: mbd.Bushing(GROUND.at(), box("b").at(), v(-1.0)), r"\.stiffness = -1.0 N/m"),
    "negative damping": (lambda: mbd.Bushing(GROUND.at(), box("b").at(), 1.0, -2.0), r"\.damping = -2.0 N s/m"),
    "negative friction": (lambda: mbd.forces.Friction(v(-1.0), 0.1), "force of a Friction = -1.0"),
    "damping time": (lambda: plate("p", damping=v(-1e-3)), "p.damping = .*must be zero or"),
    "damping rate": (lambda: plate("p").damped(0.0, rate=-1.0), "p.damping.rate = -1.0 1/s"),
    "damping ratio": (lambda: plate("p").damped(v(1.2)), "p.damping.ratio = .*must be a number of at least 0"),
    "modulus": (lambda: mbd.Ply.isotropic(v(-1.0), 0.3, 7850.0), r"E = -1\.0: must be a finite number > 0"),
    "Poisson's ratio": (lambda: mbd.Ply.isotropic(2e11, v(0.6), 7850.0), r"nu = 0\.6: must be above -1 and at most 0"),
    "one side of a matrix": (
        lambda: mbd.GivenSection([[1.0, v(0.1)] + [0.0] * 4] + [[0.0] * 6] * 5, torch.eye(6)),
        "entry 1,2 is a variable, and entry 2,1 is not the same variable",
    ),
    "a turn that nothing uses": (
        lambda: mbd.System(
            [arm := box("arm")],
            [mbd.Revolute(GROUND.at(), arm.at(turn=(v(0.1), 0.0, 0.0)), name="hinge")],
        ),
        "turn of frame b of 'hinge' is a design variable, but no axis of this frame is used",
    ),
    "a long turn": (lambda: box("b").at(turn=(4.0, 0.0, 0.0)), "b.turn = .*at most pi"),
    "a turn of two": (lambda: box("b").at(turn=(4.0, 0.0)), "b.turn = .*three finite numbers"),
    "gravity of two": (lambda: mbd.System([box("b")], gravity=parameter(1.0, 2.0)), "gravity = .*three finite"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_numbers_that_cannot_be(kind):
    make, message = REFUSED[kind]
    with pytest.raises(mbd.InputError, match=message):
        make()


@pytest.mark.parametrize(
    ("build", "name", "allowed"),
    [
        (clamps_and_mounts, "clamp.damping", "zero or positive numbers"),
        (rubbing_joints, "rub.force", "positive numbers"),
        (damped_rods, "rod.damping.rate", "zero or positive numbers"),
        (metal_plate, "rod.laminate.ply.E", "positive numbers"),
    ],
)
def test_designs_of_a_wrong_sign_are_refused(build, name, allowed):
    with refused(name, ANY, "lane 1", allowed):
        mbd.simulate(build(), 0.01, steps=2, designs={name: tensor(1.0, -1.0)})


def test_the_equations_as_a_module_have_the_gravity():
    system = tilted_gravity()
    equations = system()
    assert "gravity" in dict(equations.named_parameters())
    z = equations.initial_state().detach()
    up = tensor(0.0, 0.0, 9.81)
    turned_over = torch.func.functional_call(equations, {"gravity": up}, (torch.tensor(0.0), z))
    own = mbd.System(system.bodies, system.joints, gravity=up)()(torch.tensor(0.0), z)
    assert_close(turned_over, own, rtol=1e-12, atol=1e-12)
    (g,) = torch.autograd.grad(equations(torch.tensor(0.0), z).square().sum(), [system.get_parameter("gravity")])
    assert float(g.norm()) > 0.0


def test_weight_is_that_of_the_design():
    """A free ball falls with the gravity of each lane, and its loads know it."""
    system = mbd.System([box("b", center=(0.0, 0.0, 0.0))], gravity=parameter(0.0, 0.0, -9.81), free=["b"])
    motion = mbd.simulate(system, 1.0, steps=20, designs={"gravity": tensor(0, 0, -2.0, 1.0, 0, 0).reshape(2, 3)})
    assert_close(motion.body("b").r[:, -1], tensor(0, 0, -1.0, 0.5, 0, 0).reshape(2, 3), rtol=1e-9, atol=1e-12)
