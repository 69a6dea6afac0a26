"""A lane that diverges, or fails, is a status: the others have their motion, and it costs no time."""

from __future__ import annotations

from typing import Any

import pytest
import torch

import torchmbd as mbd
from tests.mechanisms import tensor
from torchmbd.integrate.stepper import EagerStepper

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")
DAMPING, ANGLE = "damper.damping", mbd.Angle("fore", "z", seen_from="arm")


def elbow() -> mbd.System:
    """Two bars in a plane; a damper of the elbow that may push."""
    arm, fore = (
        mbd.RigidBody(name, 1.0, (0.02, 0.03, 0.04), position=(x, 0, 0)) for name, x in (("arm", 0.2), ("fore", 0.6))
    )
    at = arm.at(0.2, 0, 0), fore.at(-0.2, 0, 0)
    joints = [
        mbd.Revolute(mbd.Ground().at(0, 0, 0), arm.at(-0.2, 0, 0), "z", "shoulder"),
        mbd.Revolute(*at, "z", "elbow"),
    ]
    damper = mbd.RotationalSpringDamper(*at, "z", 0.0, mbd.variable(0.1), name="damper")
    return mbd.System([arm, fore], joints, [damper], gravity=(0, -9.81, 0))


PHASES: dict[str, Any] = {
    "an event of an angle": [mbd.Phase(until=mbd.Event(ANGLE - 5.0, "rising")), mbd.Phase()],
    "a lock after it": [mbd.Phase(until=0.35), mbd.Phase(lock=["elbow"])],
    "a lock at an event": [mbd.Phase(until=mbd.Event(ANGLE + 50.0, "falling")), mbd.Phase(lock=["elbow"])],
}


@pytest.mark.thorough
@pytest.mark.parametrize("phases", PHASES)
def test_a_lane_that_diverges_is_a_status(phases: str) -> None:
    """It counts full turns by the thousand, so that the event seemed to read other times: an error for all lanes."""
    designs = {DAMPING: tensor(0.1, -30.0)}
    motion = mbd.simulate(elbow(), 0.375, steps=250, designs=designs, phases=PHASES[phases], gradients="none")
    alone = mbd.simulate(
        elbow(), 0.375, steps=250, designs={DAMPING: tensor(0.1)}, phases=PHASES[phases], gradients="none"
    )
    assert motion.status[0] == alone.status[0]
    assert motion.status[1].startswith("failed")
    torch.testing.assert_close(motion.q[0], alone.q[0], equal_nan=True)


def test_steps_that_are_too_long_beside_a_lock_are_judged() -> None:
    """In a plane some multipliers of joints that act are zero."""
    motion = mbd.simulate(
        elbow(),
        0.6,
        steps=40,
        designs={DAMPING: tensor(0.1, -30.0)},
        phases=PHASES["a lock after it"],
        gradients="none",
    )
    assert motion.status[0] == "ok"


def test_no_steps_are_made_after_all_lanes_have_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    step, made = EagerStepper._step, []

    def spoilt(self: EagerStepper, i: int, *arguments: Any) -> Any:
        made.append(i)
        x = step(self, i, *arguments)
        return x._replace(v=x.v * torch.nan) if i >= 10 else x

    monkeypatch.setattr(EagerStepper, "_step", spoilt)
    motion = mbd.simulate(elbow(), 0.6, steps=400, backend="eager", gradients="none")
    assert motion.status[0].startswith("failed: the motion is not finite from t = 0.0")
    assert 10 < len(made) < 60  # with those of its retries
    assert bool(motion.q[0, -1].isnan().all())
