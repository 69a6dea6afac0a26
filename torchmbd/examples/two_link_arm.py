"""A two-link arm that straightens by a swing and locks: a motor turns a laminated upper arm, the forearm hangs on a free elbow.

    phase 1   the elbow is free; its inertia leaves the forearm behind, until the arm is straight
    phase 2   the elbow is locked (a latch), the motor ends its turn

Chosen, no publication: a plate of two layers between rigid hinges, a stiff forearm with a tool, no gravity.
Checked in tests/experiments/test_two_link_arm.py.
"""

from __future__ import annotations

from torchmbd.design import Angle
from torchmbd.fem import mesh
from torchmbd.fem.materials import Laminate, Ply
from torchmbd.integrate import Event, Phase
from torchmbd.math.angles import deg
from torchmbd.math.variable import variable
from torchmbd.multibody.bodies import FlexibleBody, Ground, RigidBody
from torchmbd.multibody.joints import Drive, Fixed, Revolute, SmoothStep
from torchmbd.multibody.system import System

CARBON = Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=5.36e9, nu12=0.23, density=1586.0)
UPPER, FORE = 0.4, 0.3  # lengths [m]
ON_EDGE = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]  # the plate's normal lies in the plane of motion


def build(turn: float = 110.0, duration: float = 0.8, cells: tuple[int, int] = (8, 2), modes: int = 4) -> System:
    """The shoulder turns by `turn` [deg] within `duration` [s], both design variables: motor.size [rad], motor.duration [s]."""
    ground = Ground()
    laminate = Laminate(CARBON, deg([30.0, -30.0]), thickness=2e-3, symmetric=True)
    plate = mesh.rectangle(length=UPPER, width=0.04, cells=cells)
    upper = FlexibleBody.plate("upper", plate, laminate, modes=modes, position=(UPPER / 2, 0, 0), axes=ON_EDGE)
    hub = RigidBody("hub", 0.5, (1e-3, 1e-3, 1e-3))
    ahead = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]  # the forearm points along y
    fore = RigidBody("fore", 0.3, (1e-4, 2.5e-3, 2.5e-3), position=(UPPER, FORE / 2, 0), axes=ahead)
    law = SmoothStep(variable(deg(turn)), variable(duration))
    return System(
        bodies=[hub, upper, fore],
        joints=[
            Revolute(ground.at(0, 0, 0), hub.at(0, 0, 0), axis="z", name="shoulder"),
            Drive(ground, hub, axis="z", angle=law, name="motor"),
            Fixed(hub.at(0, 0, 0), upper.at("left"), name="root"),
            Revolute(fore.at(-FORE / 2, 0, 0), upper.at("right"), axis="z", name="elbow"),
        ],
    )


def phases() -> list[Phase]:
    """Until the forearm stands as the hub does; then the elbow is locked."""
    bent = Angle("fore", "z", seen_from="hub")
    return [Phase(until=Event(bent, "falling"), name="swing"), Phase(lock=["elbow"], name="locked")]
