"""Gradients of both responses at general angles against central differences.

generalized_alpha: against differences of its own discrete map, solved to rounding. torchdiffeq: against differences of a
tighter run of another method, because an adaptive run is no smooth function of the design.
"""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

import torchmbd as mbd
from tests.mechanisms import soft_slider_crank, sprung
from torchmbd.examples.slider_crank import build
from torchmbd.integrate import Trajectory

pytestmark = pytest.mark.thorough

ENERGY = mbd.StrainEnergy("rod")
MEASURES = {"integral": mbd.Integral(ENERGY), "max": mbd.Max(ENERGY)}
GENERAL = {"L1": (33.0,), "L2": (33.0, -21.0), "L3": (33.0, -21.0, 57.0)}


def around(system: mbd.System, h: float) -> dict[str, Tensor]:
    """The design and its neighbors by one step up and down in every variable: [1 + 2 n, n]."""
    (name,) = (name for name, x in system.named_parameters() if x.requires_grad)
    b = dict(system.named_parameters())[name].detach()
    steps = h * torch.eye(len(b), dtype=torch.float64)
    return {name: torch.cat([b[None], b + steps, b - steps])}


def differences(measure: mbd.Integral, motion: Trajectory, h: float) -> Tensor:
    up, down = measure.value(motion)[1:].chunk(2)
    return (up - down) / (2 * h)


def agree(found: Tensor, expected: Tensor, tolerance: float) -> None:
    assert float(expected.abs().min()) > 1e-3 * float(expected.abs().max())  # a general position
    assert float((found - expected).abs().max()) < tolerance * float(expected.abs().max())


@pytest.fixture(scope="module", params=GENERAL)
def both(request) -> tuple[Trajectory, Trajectory]:
    """A motion with sensitivities, and the motions of all neighbors, by the same steps."""
    angles = GENERAL[request.param]
    system = build(len(angles), angles, cells=(6, 2), modes=4)
    options = {"steps": 120, "iterations": (4, 4), "refresh": 1}
    return (
        mbd.simulate(system, 0.02, gradients="forward", **options),
        mbd.simulate(system, 0.02, designs=around(system, 1e-5), **options),
    )


@pytest.mark.parametrize("name", MEASURES)
def test_generalized_alpha_against_differences_of_its_discrete_map(name, both):
    motion, neighbors = both
    assert motion.ok
    assert neighbors.ok
    result = MEASURES[name].value_and_gradient(motion)
    assert float(result.value[0]) == pytest.approx(float(MEASURES[name].value(neighbors)[0]), rel=1e-9)
    agree(result.gradient[0], differences(MEASURES[name], neighbors, 1e-5), 1e-5)


def test_default_iterations_leave_little(both):
    """Three corrections with an inverse kept for two steps: cheaper, and still exact enough to optimize with."""
    motion, _ = both
    loose = mbd.simulate(motion.system, 0.02, steps=120, gradients="forward")
    for measure in MEASURES.values():
        agree(measure.value_and_gradient(loose).gradient[0], measure.value_and_gradient(motion).gradient[0], 1e-3)
    assert float(loose.stats["iteration_error"].max()) < 1e-3
    assert float(loose.stats["tangent_error"].max()) < 1e-2


@pytest.mark.parametrize("name", MEASURES)
def test_torchdiffeq_against_differences_of_a_tight_run(name, soft):
    motion, neighbors = soft
    agree(MEASURES[name].value_and_gradient(motion).gradient[0], differences(MEASURES[name], neighbors, 1e-4), 1e-5)


@pytest.fixture(scope="module")
def soft() -> tuple[Trajectory, Trajectory]:
    """A softened slider-crank: dopri5 with sensitivities; dopri8 without, much tighter."""
    system = soft_slider_crank((33.0, -21.0))
    motion = mbd.simulate(system, 0.006, "dopri5", steps=12, gradients="forward", rtol=1e-7, atol=1e-9)
    neighbors = mbd.simulate(system, 0.006, "dopri8", steps=12, designs=around(system, 1e-4), rtol=1e-11, atol=1e-13)
    return motion.require_ok(), neighbors.require_ok()


@pytest.mark.slow
@pytest.mark.parametrize("layup", GENERAL)
def test_torchdiffeq_against_differences_of_a_tight_run_on_the_full_rod(layup):
    """The rod of the paper, undamped, 4 modes: tens of thousands of evaluations."""
    angles = GENERAL[layup]
    system = build(len(angles), angles, cells=(12, 2), modes=4)
    motion = mbd.simulate(system, 0.01, "dopri5", steps=100, gradients="forward", rtol=1e-8, atol=1e-10).require_ok()
    designs = around(system, 1e-4)
    neighbors = mbd.simulate(system, 0.01, "dopri8", steps=100, designs=designs, rtol=1e-11, atol=1e-13).require_ok()
    for measure in MEASURES.values():
        agree(measure.value_and_gradient(motion).gradient[0], differences(measure, neighbors, 1e-4), 1e-5)


def test_coarse_steps_and_variables_of_any_size():
    """Ten steps of a sprung mechanism: a degree of an angle does 1e-7 of what a meter of thickness does, and as exactly."""
    system = sprung(kind="triangle")  # ten steps resolve it: default iteration 4e-4 off with quadrilaterals
    names = ["rod.laminate.angles", "rod.laminate.thickness"]
    tight = mbd.simulate(
        system, 0.05, steps=10, gradients="forward", variables=names, iterations=(8, 8), refresh=0
    ).dq_db
    result = mbd.simulate(system, 0.05, steps=10, gradients="forward", variables=names).dq_db
    assert tight is not None
    assert result is not None
    sizes = tight.abs().amax((0, 1, 2))
    assert float(sizes.min()) < 1e-6 * float(sizes.max())
    assert float(((result - tight).abs().amax((0, 1, 2)) / sizes).max()) < 2e-5


@pytest.mark.filterwarnings("ignore")  # the motion is as hard as warnings say
@pytest.mark.extensions
def test_gradients_of_a_motion_whose_steps_are_hard_to_solve():
    """Steps need further corrections: what they leave may be little of the states, and must be little of gradients."""
    ply = mbd.Ply(128e9, 10.1e9, 5.36e9, 5.36e9, 3.6e9, 0.23, 1586.0, alpha1=-0.3e-6, alpha2=28e-6)
    laminate = mbd.Laminate(ply, mbd.deg([30, -20, 65]), thickness=0.4e-3)
    upright = {"position": (0.25, 0, 0), "axes": [[1, 0, 0], [0, 0, 1], [0, -1, 0]], "reference": "left"}
    mesh = mbd.mesh.rectangle(0.5, 0.05, (6, 2))
    arm = mbd.FlexibleBody.plate("arm", mesh, laminate, modes=4, damping=2e-3, expansion=True, **upright)
    tool = mbd.RigidBody("tool", 0.1, (2e-4, 1e-4, 1.5e-4), center=(0.01, 0.02, 0), position=(0.5, 0, 0))
    hinge = mbd.Revolute(mbd.Ground().at(), arm.at("left"), axis="z")
    tip = arm.at("right", axes=[[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    guide = mbd.Prismatic(tip, tool.at(), axis="y")
    spring = mbd.AxialSpringDamper(tip, tool.at(), "y", stiffness=80.0, damping=0.3, rest=0.0)
    warm = mbd.Temperature(arm, mbd.forces.Scaled(30.0, lambda t: torch.sin(20.0 * t)))
    push = mbd.Torque(arm.at("left"), (0, 0, 0.2))
    system = mbd.System([arm, tool], [hinge, guide], [spring, push, warm], gravity=(0, -9.81, 0), truncation=None)
    energy = mbd.Integral(mbd.StrainEnergy("arm"), window=(0.02, 0.11))
    name, step = "arm.laminate.thickness", 2e-8
    options = {"steps": 140, "backend": "native"}

    motion = mbd.simulate(system, 0.14, gradients="reverse", variables=[name], **options).require_ok()
    assert float(motion.stats["further_corrections"]) >= 2
    slope = energy.value_and_gradient(motion).gradient[0]
    sides = laminate.thickness.detach() + step * torch.cat([torch.eye(3), -torch.eye(3)]).double()
    up, down = energy(mbd.simulate(system, 0.14, gradients="none", designs={name: sides}, **options)).split(3)
    torch.testing.assert_close(slope, (up - down) / (2.0 * step), rtol=0.02, atol=0)
