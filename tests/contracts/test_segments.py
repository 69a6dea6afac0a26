"""A motion without phases and one with a single phase in which nothing is locked, released or replaced are the same motion.

Numbers, gradients, status, statistics and warnings are identical bit for bit, for every integrator, native and eager.
"""

from __future__ import annotations

import warnings
from typing import Any

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import pendulum
from torchmbd.examples import slider_crank
from torchmbd.integrate import METHODS
from torchmbd.integrate.registry import INTEGRATORS

NAME = "rod.laminate.angles"
DESIGNS = mbd.deg([[20.0, -50.0], [10.0, 70.0]])
NAMED = [mbd.Phase(name="all of it")]


def numbers(phases: Any, method: str, gradients: str, **options: Any) -> tuple[list[torch.Tensor], Any, Any, Any]:
    """Motion and gradient, status, statistics and warnings."""
    angles = DESIGNS.clone().requires_grad_(gradients == "reverse")
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        motion = mbd.simulate(
            pendulum(damping=1e-4), 0.02, method, designs={NAME: angles}, phases=phases, gradients=gradients, **options
        )
        result = [motion.q, motion.v, motion.a, motion.lam]
        if gradients == "reverse":
            result += torch.autograd.grad(mbd.Max(mbd.StrainEnergy("rod"))(motion).sum() + motion.q.sum(), [angles])
        if gradients == "forward":
            result += [x for x in (motion.dq_db, motion.dlam_db) if x is not None]
    stats = repr({k: v.tolist() if isinstance(v, torch.Tensor) else v for k, v in motion.stats.items()})
    return result, motion.status, stats, [str(w.message) for w in seen]


def identical(method: str, gradients: str, **options: Any) -> None:
    numbers(None, method, gradients, **options)  # what is said once in a process
    plain, status, stats, said = numbers(None, method, gradients, **options)
    for phases in ([mbd.Phase()], NAMED):
        phased, *rest = numbers(phases, method, gradients, **options)
        assert all(torch.equal(a, b) for a, b in zip(plain, phased, strict=True))
        assert rest == [status, stats, said]


# The others take minutes together.
SOME = ("rk4", "dopri5", *(method for method in METHODS if INTEGRATORS[method].adjoint))


@pytest.mark.thorough
@pytest.mark.parametrize("method", [x if x in SOME else pytest.param(x, marks=pytest.mark.slow) for x in METHODS])
@pytest.mark.filterwarnings("ignore:Functional iteration did not converge")
def test_one_phase_is_none_for_every_integrator(method):
    identical(method, "reverse" if INTEGRATORS[method].adjoint else "forward", steps=12)


@pytest.mark.parametrize("options", [{"steps": 2}, {"steps": 12, "checkpoint": 4}, {}, {"steps": 12, "halvings": 2}])
def test_steps_that_are_too_few_chosen_or_kept_in_part_are_those_of_no_phase(options):
    identical("generalized_alpha", "none", **options)


@pytest.mark.thorough
@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("gradients", ["forward", "reverse"])
def test_native_steps_are_those_of_no_phase(gradients):
    identical("generalized_alpha", gradients, steps=30, backend="native")


def test_the_duration_has_its_gradient_with_one_phase():
    slopes = []
    for phases in (None, [mbd.Phase()]):
        T = torch.tensor(0.02, dtype=torch.float64, requires_grad=True)
        motion = mbd.simulate(pendulum(damping=1e-4), T, steps=10, phases=phases)
        slopes += torch.autograd.grad(motion.q[:, -1].sum(), [T])
    assert torch.equal(*slopes)


@pytest.mark.parametrize("phases", [None, [mbd.Phase(until=0.0093), mbd.Phase(lasting=0.0111), mbd.Phase()]])
def test_a_body_that_a_drive_moves_has_its_exact_motion_in_every_segment(phases):
    """It is none of the unknowns: steps of any size leave no error, on both sides of switches, which begin anew."""
    from torchmbd.examples.slider_crank import build

    system = build(6)
    motion = mbd.simulate(system, 0.04, steps=40, phases=phases, gradients="none")
    drive = next(joint for joint in system.joints if isinstance(joint, mbd.Drive))
    plain = mbd.simulate(system, 0.04, steps=40, gradients="none")
    names = system.topology.names
    bodies, k = len(names), names.index(drive.b.body.name)
    for name, components in (("q", 7), ("v", 6), ("a", 6)):
        rows = [component * bodies + k for component in range(components)]
        x, y = (getattr(m, name)[..., rows] for m in (motion, plain))
        torch.testing.assert_close(x, y, rtol=0.0, atol=1e-13 * float(y.abs().max()))


@pytest.mark.thorough
@pytest.mark.parametrize("options", [{"steps": 240}, {"steps": 240, "checkpoint": 5}, {}])
@pytest.mark.parametrize("gradients", ["none", "reverse"])
def test_a_switch_that_changes_nothing(options, gradients):
    """Status, statistics and numbers of the motion without it, to what two further steps leave."""
    system = slider_crank.build(3, cells=(6, 2), modes=4)
    name, result = "rod.laminate.angles", []
    for phases in (None, [mbd.Phase(until=0.0107), mbd.Phase()]):
        angles = mbd.deg([[20.0, -30.0, 40.0], [0.0, 5.0, -5.0]]).requires_grad_(gradients == "reverse")
        motion = mbd.simulate(system, 0.024, designs={name: angles}, phases=phases, gradients=gradients, **options)
        energy = mbd.Integral(mbd.StrainEnergy("rod"))(motion)
        slopes = torch.autograd.grad(energy.sum(), angles) if gradients == "reverse" else ()
        result.append((motion, [energy.detach(), *slopes]))
    (plain, values), (switched, others) = result
    assert switched.status == plain.status == ["ok", "ok"]
    assert set(switched.stats) == set(plain.stats)
    assert switched.stats["steps"] == plain.stats["steps"]
    for statistic in ("turn", "step_error", "suggested_steps"):
        assert_close(switched.stats[statistic], plain.stats[statistic], rtol=0.1, atol=0)
    assert_close(switched.q, plain.q, rtol=0, atol=1e-6)
    for x, y in zip(others, values, strict=True):
        assert_close(x, y, rtol=0, atol=1e-3 * float(y.abs().max()))
