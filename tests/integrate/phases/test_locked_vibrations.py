"""A beam that is latched vibrates: the shares of its loads do not grow with the steps, and energy that errors make is named.

Two closed systems of aluminum without damping: a rod that swings on a hinge, which is locked; and a clamped rod whose end
carries an arm across it, whose hinge is locked, so that the rod is struck along its axis. A latch takes energy and gives none.
"""

from __future__ import annotations

import warnings

import pytest
import torch

import torchmbd as mbd

E, DENSITY, LENGTH, SPEED = 70e9, 2700.0, 0.5, 5.0


def rod(side: float, elements: int, **options) -> mbd.FlexibleBody:
    section = mbd.GivenSection.isotropic(
        E=E, nu=0.3, density=DENSITY, area=side**2, Iyy=side**4 / 12, Izz=side**4 / 12, J=0.14 * side**4
    )
    place = (0.0 if options.get("reference") else 0.5 * LENGTH, 0.0, 0.0)
    return mbd.FlexibleBody.beam("rod", mbd.BeamLine.straight(LENGTH, elements), section, position=place, **options)


def quiet(system: mbd.System, duration: float, **options) -> mbd.Trajectory:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return mbd.simulate(system, duration, gradients="none", backend="eager", **options)


def struck(steps: int, **options) -> mbd.Trajectory:
    """The rod with an arm of 0.3 kg and 0.15 m from its hinge to its center, which turns at 5 rad/s until it is latched."""
    body, half = rod(8e-3, 8, **options), 0.15
    across = [[0, 0, -1], [0, 1, 0], [1, 0, 0]]
    arm = mbd.RigidBody("arm", 0.3, (1e-4, 2.5e-3, 2.5e-3), position=(LENGTH, 0.0, half), axes=across)
    joints = [
        mbd.Fixed(mbd.Ground().at(), body.at("start")),
        mbd.Revolute(arm.at(-half, 0, 0), body.at("end"), axis="y", name="elbow"),
    ]
    return quiet(
        mbd.System([body, arm], joints, truncation=None),
        0.02,
        steps=steps,
        start={"arm.angular_velocity": [0.0, SPEED, 0.0], "arm.velocity": [SPEED * half, 0.0, 0.0]},
        phases=[mbd.Phase(until=2.03e-3), mbd.Phase(lock=["elbow"])],
    )


@pytest.mark.thorough
@pytest.mark.parametrize(
    "options",
    [{"modes": 20}, {"modes": 4, "reduction": "craig-bampton", "interface": ["end"], "reference": "start"}],
    ids=["mean axes", "interface"],
)
def test_shares_of_loads_do_not_grow_with_the_steps(options):
    """Accelerations do, where steps begin to resolve the fastest modes."""
    motions = [struck(steps, **options) for steps in (20, 60)]
    shares = [motion.stats["load_share"]["rod"] for motion in motions]
    assert shares[1] == pytest.approx(shares[0], rel=0.3)
    if options["modes"] == 20:
        coarse, fine = (float(motion.a.abs().max()) for motion in motions)
        assert fine > 2.0 * coarse


def swung(step: float, steps: int) -> mbd.Trajectory:
    """The rod at 20 rad/s, whose hinge is latched within the second step."""
    body, speed = rod(0.01, 16, modes=6), 20.0
    hinge = mbd.Revolute(mbd.Ground().at(), body.at("start"), axis="y", name="hinge")
    return quiet(
        mbd.System([body], [hinge], gravity=(0.0, 0.0, -9.81), truncation=None),
        steps * step,
        steps=steps,
        start={"rod.angular_velocity": [0.0, speed, 0.0], "rod.velocity": [0.0, 0.0, -0.5 * speed * LENGTH]},
        phases=[mbd.Phase(until=1.2 * step), mbd.Phase(lock=["hinge"])],
    )


@pytest.mark.thorough
def test_energy_that_nothing_gives_is_named():
    """Steps of a fifth of the fastest periods make energy; longer ones take some."""
    for step, steps, grows in ((2.6e-4, 100, True), (4.0e-4, 30, False)):
        motion = swung(step, steps)
        energies = motion.energies
        gain = float(energies.balance.max() / torch.maximum(energies.kinetic, energies.strain).max())
        assert (gain > 0.06) == grows
        assert ("energy comes from nothing" in motion.status[0]) == grows
        assert grows or motion.status == ["ok"]
