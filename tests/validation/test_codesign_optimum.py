"""A mass that a spring of unknown stiffness and a motor of unknown switch move as far as possible, to rest: a closed optimum.

    maximize y(2)    y'' = -k y + u,  |u| <= 1,  y(0) = y'(0) = y'(2) = 0        u = 1, then -1: bang-bang, by the theory

D. R. Herber, J. T. Allison, Unified scaling of dynamic optimization design formulations, IDETC 2017; closed solution in
github.com/danielrherber/dt-qp-project, examples/nonlin/simple-sasa: y = 1.2031314, k = 0.8543229, switch at 1.457314 s.
Times of phases are no variables of a problem, but places of events are: a drum at constant speed switches the motor when it has
turned by 1 rad.
"""

from __future__ import annotations

import numpy as np
import pytest

import torchmbd as mbd

V, GROUND = mbd.variable, mbd.Ground()
FAR, STIFFNESS, SWITCH = 1.2031314, 0.8543229, 1.457314


def problem(steps: int = 40) -> mbd.Problem:
    mass, drum = (mbd.RigidBody(name, 1.0, (1.0, 1.0, 1.0)) for name in ("mass", "drum"))
    joints = [
        mbd.Prismatic(GROUND.at(), mass.at(), axis="x"),
        mbd.Revolute(GROUND.at(), drum.at(), axis="z"),
        mbd.Drive(GROUND, drum, axis="z", speed=V(1.0), name="timer"),
    ]
    spring = mbd.AxialSpringDamper(GROUND.at(), mass.at(), axis="x", stiffness=V(1.0), name="spring")
    motor = mbd.Force(mass.at(), (1.0, 0.0, 0.0), name="motor")
    switch = mbd.Event(mbd.Angle("drum", "z") - 1.0, "rising")
    return mbd.Problem(
        mbd.System([mass, drum], joints, [spring, motor]),
        duration=2.0,
        steps=steps,
        phases=[mbd.Phase(until=switch), mbd.Phase(laws={"motor": mbd.forces.OfTime(-1.0)})],
        maximize=mbd.Final(mbd.Position("mass", "x")),
        subject_to=mbd.Final(mbd.Velocity("mass", "x")).equals(0.0),
        bounds={"timer.speed": (0.51, 5.0), "spring.stiffness": (0.05, 10.0)},
    )


@pytest.mark.thorough
@pytest.mark.parametrize("start", [(1.0, 1.0), (0.6, 0.3), (0.8, 2.5)])
def test_three_starts_reach_the_closed_optimum(start):
    """Speed of the drum, stiffness."""
    result = mbd.optimize(problem(), "slsqp", start=np.array(start))
    assert result.status == "converged"
    speed, stiffness = result.x
    assert (-result.value, stiffness, 1.0 / speed) == pytest.approx((FAR, STIFFNESS, SWITCH), rel=1e-3)


@pytest.mark.thorough
def test_the_error_is_that_of_the_steps():
    """Of second order in them."""
    far = [-mbd.optimize(problem(steps), "slsqp", start=np.array([0.69, 0.85])).value for steps in (20, 40)]
    assert (far[0] - FAR) / (far[1] - FAR) == pytest.approx(4.0, rel=0.1)
