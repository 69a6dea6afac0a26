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
