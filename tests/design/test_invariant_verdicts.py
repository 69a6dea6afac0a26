"""Verdicts do not depend on where the machine stands, on units, or on constants in responses."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torchmbd as mbd
from torchmbd.results.answer import Verification

pytestmark = pytest.mark.thorough
GROUND = mbd.Ground()


def spring_mass(offset: float = 0.0, stiffness: float = 3e3, force: Any = (100.0, 0.0, 0.0)) -> mbd.System:
    """A mass of 1 kg on a spring under a load, at a distance from the origin."""
    body = mbd.RigidBody("b", 1.0, (1.0,) * 3, position=(offset, 0, 0))
    slide = mbd.Prismatic(GROUND.at(offset, 0, 0), body.at(), axis="x")
    spring = mbd.AxialSpringDamper(
        GROUND.at(offset, 0, 0), body.at(), axis="x", stiffness=mbd.variable(stiffness), name="s"
    )
    return mbd.System([body], [slide], [spring, mbd.Force(body.at(), force)])


@mbd.measure
def last_place(motion: Any) -> Tensor:
    return motion.body("b").at().position[:, -1, 0]


X = mbd.Position("b", "x")
RESPONSES = {
    "final": mbd.Final(X),
    "max": mbd.Max(X),
    "at time": mbd.AtTime(X, 0.31),
    "mean": mbd.Mean(X),
    "function": last_place,
    "difference": mbd.Final(X) - 0.5 * mbd.Max(X) - 0.5 * mbd.Min(X),
}


def told(verification: Verification) -> tuple[Any, ...]:
    """The verdict without its numbers."""
    kinds = [re.sub(r"-?[0-9][-+.e0-9]*", "#", fault) for fault in verification.faults]
    return verification.verified, kinds, [answer.active for answer in verification.answers]


CASES = [("final", 20, None), ("final", 40, None), ("final", 20, 2.0), ("function", 20, 2.0), ("function", 40, None)]
CASES += [(name, 20, None) for name in ("max", "at time", "mean", "difference")]


@pytest.mark.parametrize(("name", "steps", "limit"), CASES)
def test_of_a_moved_machine_and_a_shifted_objective(name: str, steps: int, limit: float | None) -> None:
    """A feasible start, and one that violates a limit; coarse steps, and steps that are enough."""
    x = np.array([2200.0])

    def verdict(offset: float, change: Callable[[mbd.Measure], mbd.Measure]) -> tuple[Any, ...]:
        limits = [] if limit is None else [mbd.Max(mbd.Velocity("b", "x")) >= limit]
        problem = mbd.Problem(
            spring_mass(offset),
            0.5,
            maximize=change(RESPONSES[name]),
            subject_to=limits,
            steps=steps,
            backend="eager",
            bounds={"s.stiffness": (500.0, 4000.0)},
        )
        value = problem.evaluate(x[None], False)[0].objective
        return told(mbd.design.verification.verification(problem, x, value))

    verdicts = [verdict(0.0, lambda m: m), verdict(1000.0, lambda m: m)]
    verdicts += [
        verdict(0.0, lambda m: m + 1000.0),
        verdict(0.0, lambda m: 1e3 * m),
        verdict(0.0, lambda m: 1e-6 * m - 0.5),  # of which the places are 1e-7: rounding is far less than the errors
    ]
    assert all(v == verdicts[0] for v in verdicts), verdicts


@pytest.mark.parametrize("steps", [20, 40])
def test_of_a_constraint_on_a_place(steps: int) -> None:
    """Its limit moves with the machine, or has a constant and a unit as its response has."""
    x, verdicts = np.array([2200.0]), []
    for offset, factor, constant in ((0.0, 1.0, 0.0), (1000.0, 1.0, 0.0), (0.0, 1.0, 1000.0), (0.0, 1e3, -50.0)):
        limits = [factor * mbd.Max(X) + constant <= factor * (0.0905 + offset) + constant]
        system = spring_mass(offset)
        problem = mbd.Problem(
            system,
            0.5,
            mbd.Max(mbd.Velocity("b", "x")),
            limits,
            steps=steps,
            backend="eager",
            bounds={"s.stiffness": (500.0, 4000.0)},
        )
        value = problem.evaluate(x[None], False)[0].objective
        verdicts.append(told(mbd.design.verification.verification(problem, x, value)))
    assert all(v == verdicts[0] for v in verdicts), verdicts


def test_a_best_design_at_the_start_is_looked_at() -> None:
    """The step response of a spring of 32 Hz, 6 steps a period: ten times as large as F / k (1 - cos w t) at the end."""
    problem = mbd.Problem(
        spring_mass(stiffness=4e4), 0.5, mbd.Final(X), steps=97, backend="eager", bounds={"s.stiffness": (3.9e4, 4e4)}
    )
    found = mbd.verify(mbd.optimize(problem, max_iterations=5))
    true = 100.0 / 4e4 * (1.0 - math.cos(200.0 * 0.5))
    assert abs(found.answers[0].best.value - true) > 5.0 * true
    assert not found.verified
    assert "equal to the start" in found.status


@pytest.mark.parametrize("frequency", [50.0, 100.0, 200.0, 300.0, 400.0])
def test_a_load_whose_period_divides_the_steps_is_seen(frequency: float) -> None:
    """F cos(2 pi f t) at 100 steps a second is a constant load, and by half the step as well for even multiples."""

    def load(t: Tensor) -> Tensor:
        return torch.stack([100.0 * torch.cos(2.0 * math.pi * frequency * t), 0.0 * t, 0.0 * t])

    system = spring_mass(stiffness=400.0, force=load)
    motion = mbd.simulate(system, 1.0, steps=100, gradients="none", backend="eager")
    omega, t = 2.0 * math.pi * frequency, torch.linspace(0.0, 1.0, 100_001, dtype=torch.float64)
    x = 100.0 / (400.0 - omega**2) * (torch.cos(omega * t) - torch.cos(20.0 * t))  # of 1 kg on 400 N/m
    root_mean_square = torch.trapezoid(x.square(), t).sqrt()
    for response, exact in (
        (mbd.RMS(X), root_mean_square),
        (mbd.Final(X) + 1000.0, x[-1] + 1000.0),
        (last_place, x[-1]),
    ):
        error = motion.error_of(response)
        wrong = (exact - error.value).abs() > 0.1 * error.size
        near = (error.by_steps - (exact - error.value)).abs() < 0.1 * (exact - error.value).abs()
        assert bool((~wrong | near | ~error.resolved).all()), str(error)
