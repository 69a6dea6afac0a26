"""A motion whose diagnosis is put off has the same numbers and status, and no warning of what the model leaves out."""

from __future__ import annotations

import warnings

import pytest
import torch

import torchmbd as mbd
from tests.refused import refused


def test_warnings_can_be_put_off():
    """An arm of few modes that turns fast: truncation, spin and loads have warnings."""
    system = mbd.examples.arm(modes=1)
    turning = {"arm.angular_velocity": (0.0, -30.0, 0.0)}
    plain = mbd.simulate(system, 0.01, steps=8, start=turning, gradients="none", diagnose=False)
    assert "load_share" not in plain.stats
    with pytest.warns(UserWarning, match=r"tension and pressure|first frequency|retained modes"):
        diagnosed = mbd.simulate(system, 0.01, steps=8, start=turning, gradients="none")
    assert torch.equal(diagnosed.q, plain.q)
    assert diagnosed.status == plain.status
    with refused("diagnose"):
        mbd.simulate(system, 0.01, steps=8, diagnose="no")  # pyright: ignore[reportArgumentType]


@pytest.mark.thorough
def test_the_cause_of_a_failure_is_not_put_off():
    ground, body = mbd.Ground(), mbd.RigidBody("mass", 2.0, (1.0, 1.0, 1.0), velocity=(1.0, 0.0, 0.0))
    valve = mbd.AxialSpringDamper(ground.at(), body.at(), law=lambda s, r, t: torch.sqrt(0.2 - s), name="valve")
    system = mbd.System([body], [mbd.Prismatic(ground.at(), body.at(), axis="x")], [valve])
    motions = [mbd.simulate(system, 1.0, steps=50, diagnose=x) for x in (True, False)]
    assert "the law of 'valve' is not finite near s = " in motions[0].status[0]
    assert motions[0].status == motions[1].status


def test_searches_put_warnings_off_after_their_first_gradients():
    """A warning comes with the first gradients of a problem and with each evaluation of values, and changes no number."""
    system = mbd.examples.arm(modes=1)
    turning = {"arm.angular_velocity": (0.0, -30.0, 0.0)}
    problem = mbd.Problem(system, 0.01, mbd.Max(mbd.StrainEnergy("arm")), steps=8, motion_start=turning)
    evaluations = []
    for gradients, warned in ((True, True), (True, False), (False, True)):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            evaluations += problem.evaluate(problem.start[None], gradients)
        assert warned == any("of its stiffness" in str(x.message) for x in caught)
    assert len({evaluation.objective for evaluation in evaluations}) == 1
