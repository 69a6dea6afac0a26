"""Small mechanisms for first trials; the examples in docstrings use them.

>>> mbd.simulate(mbd.examples.pendulum(), 0.5, steps=50).status
['ok']

Modules with a function `build`, the mechanisms of many tests:

    slider_crank    of the paper, with a laminated rod
    two_link_arm    a laminated arm whose elbow latches, in two phases

More mechanisms are in experiments/models of the repository.
Checked in tests/test_docstrings.py.
"""

from __future__ import annotations

import torch

from torchmbd.examples import slider_crank, two_link_arm
from torchmbd.fem import mesh
from torchmbd.fem.materials import Laminate, Ply, Strength
from torchmbd.math.angles import deg
from torchmbd.multibody.bodies import FlexibleBody, Ground, RigidBody
from torchmbd.multibody.joints import Fixed, Revolute
from torchmbd.multibody.system import System

__all__ = ["arm", "carbon", "pendulum", "slider_crank", "two_link_arm"]


def __dir__() -> list[str]:
    return [*__all__]


def carbon() -> Ply:
    """A ply of carbon fibers in epoxy.

    >>> mbd.examples.carbon().E1 / 1e9  # GPa, along the fibers
    128.0
    """
    strength = Strength(Xt=1.5e9, Xc=1.2e9, Yt=50e6, Yc=250e6, S12=70e6)
    return Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=3.6e9, nu12=0.23, density=1586.0, strength=strength)


def arm(modes: int = 2, laminate: Laminate | None = None) -> System:
    """A laminated plate of 0.5 m with a tool of 0.2 kg at its end swings on a hinge under gravity.

    modes     retained modes of the plate
    laminate  of the plate; None: two plies of 1 mm at 45 and -45 degrees

    Bodies "arm" (flexible) and "tool" (rigid); joints "hinge" and "grip"; its angles are "arm.laminate.angles".

    >>> system = mbd.examples.arm()
    >>> [body.name for body in system.bodies], [joint.name for joint in system.joints]
    (['arm', 'tool'], ['hinge', 'grip'])
    """
    field = None if laminate is None else laminate.field  # where angles vary over a mesh, it is the mesh of the body
    plate = mesh.rectangle(length=0.5, width=0.05, cells=(4, 2)) if field is None else field.mesh
    if laminate is None:
        laminate = Laminate(carbon(), deg([45.0, -45.0]), thickness=1e-3)
    upright = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]  # columns: the axes of the mesh in ground axes
    body = FlexibleBody.plate("arm", plate, laminate, modes=modes, position=(0.25, 0, 0), axes=upright)
    tool = RigidBody("tool", mass=0.2, inertia=(1e-4, 1e-4, 1e-4), position=(0.5, 0, 0))
    hinge = Revolute(Ground().at(0, 0, 0), body.at("left"), axis="z", name="hinge")
    grip = Fixed(body.at("right"), tool.at(0, 0, 0), name="grip")
    return System([body, tool], [hinge, grip], gravity=(0, -9.81, 0))


def pendulum(length: float = 1.0, speed: float = 1.0) -> System:
    """A point mass of 1 kg hangs on a hinge and starts with a horizontal speed.

    length  from the hinge to the mass [m]
    speed   at the start [m/s]

    Body "bob" (rigid); joint "hinge".

    >>> rest = mbd.equilibrium(mbd.examples.pendulum())
    >>> round(rest.vibrations[0].frequencies.item(), 4)  # sqrt(g / length) / (2 pi) [Hz]
    0.4985
    """
    velocity, spin = (speed, 0.0, 0.0), (0.0, 0.0, speed / length)
    inertia = torch.full((3,), 1e-9, dtype=torch.float64)
    bob = RigidBody("bob", 1.0, inertia, position=(0, -length, 0), velocity=velocity, angular_velocity=spin)
    return System([bob], [Revolute(Ground().at(), bob.at(0, length, 0), "z", "hinge")], gravity=(0, -9.81, 0))
