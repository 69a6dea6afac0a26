"""A two-link arm that straightens by a swing and locks: a motor turns a laminated upper arm, the forearm hangs on a free elbow.

    phase 1   the elbow is free; its inertia leaves the forearm behind, until the arm is straight
    phase 2   the elbow is locked (a latch), the motor ends its turn

Chosen, no publication: a plate of two layers between rigid hinges, a stiff forearm with a tool, no gravity.
Checked in tests/experiments/test_two_link_arm.py.
"""

from __future__ import annotations

import torchmbd as mbd
from torchmbd.design import Angle

CARBON = mbd.Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=5.36e9, nu12=0.23, density=1586.0)
UPPER, FORE = 0.4, 0.3  # lengths [m]
ON_EDGE = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]  # the plate's normal lies in the plane of motion


def build(turn: float = 110.0, duration: float = 0.8, cells: tuple[int, int] = (8, 2), modes: int = 4) -> mbd.System:
    """The shoulder turns by `turn` [deg] within `duration` [s], both design variables: motor.size [rad], motor.duration [s]."""
    ground = mbd.Ground()
    laminate = mbd.Laminate(CARBON, mbd.deg([30.0, -30.0]), thickness=2e-3, symmetric=True)
    plate = mbd.mesh.rectangle(length=UPPER, width=0.04, cells=cells)
    upper = mbd.FlexibleBody.plate("upper", plate, laminate, modes=modes, position=(UPPER / 2, 0, 0), axes=ON_EDGE)
    hub = mbd.RigidBody("hub", 0.5, (1e-3, 1e-3, 1e-3))
    ahead = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]  # the forearm points along y
    fore = mbd.RigidBody("fore", 0.3, (1e-4, 2.5e-3, 2.5e-3), position=(UPPER, FORE / 2, 0), axes=ahead)
    law = mbd.SmoothStep(mbd.variable(mbd.deg(turn)), mbd.variable(duration))
    return mbd.System(
        bodies=[hub, upper, fore],
        joints=[
            mbd.Revolute(ground.at(0, 0, 0), hub.at(0, 0, 0), axis="z", name="shoulder"),
            mbd.Drive(ground, hub, axis="z", angle=law, name="motor"),
            mbd.Fixed(hub.at(0, 0, 0), upper.at("left"), name="root"),
            mbd.Revolute(fore.at(-FORE / 2, 0, 0), upper.at("right"), axis="z", name="elbow"),
        ],
    )


def phases() -> list[mbd.Phase]:
    """Until the forearm stands as the hub does; then the elbow is locked."""
    bent = Angle("fore", "z", seen_from="hub")
    return [mbd.Phase(until=mbd.Event(bent, "falling"), name="swing"), mbd.Phase(lock=["elbow"], name="locked")]
