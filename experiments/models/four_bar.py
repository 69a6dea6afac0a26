"""A four-bar linkage whose coupler is a carbon strip; the crank turns at constant speed.

Chosen, no publication. Its coupler bends most where the rocker turns back.
"""

from __future__ import annotations

import math

import torchmbd as mbd

CARBON = mbd.Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=3.6e9, nu12=0.23, density=1586.0)
CRANK, COUPLER, ROCKER, BASE = 0.1, 0.35, 0.25, 0.4  # lengths [m]; Grashof: the crank turns round


def build(angle: float = 30.0, speed: float = 40.0) -> mbd.System:
    """Plies of the coupler at +-angle [deg], speed of the crank [rad/s]; it starts along x."""
    reach = BASE - CRANK  # from the crank's pin to the rocker's base
    cosine = (reach**2 + COUPLER**2 - ROCKER**2) / (2 * reach * COUPLER)
    up = math.acos(cosine)  # of the coupler, from x
    pin = (CRANK + COUPLER * math.cos(up), COUPLER * math.sin(up))  # of coupler and rocker
    lean = math.atan2(pin[1], pin[0] - BASE)
    strip = mbd.Laminate(CARBON, mbd.deg([angle, -angle]), thickness=1.5e-3)
    mesh = mbd.mesh.rectangle(COUPLER, 0.03, cells=(12, 2))
    middle = ((CRANK + pin[0]) / 2, pin[1] / 2, 0.0)
    upright = [[math.cos(up), 0, math.sin(up)], [math.sin(up), 0, -math.cos(up)], [0, 1, 0]]
    coupler = mbd.FlexibleBody.plate("coupler", mesh, strip, modes=4, position=middle, axes=upright)
    crank = mbd.RigidBody("crank", 0.1, (1e-4, 1e-4, 1e-4))
    turned = [[math.cos(lean), -math.sin(lean), 0], [math.sin(lean), math.cos(lean), 0], [0, 0, 1]]
    rocker = mbd.RigidBody("rocker", 0.1, (5e-4, 5e-4, 5e-4), position=(BASE, 0, 0), axes=turned)
    ground = mbd.Ground()
    return mbd.System(
        [crank, coupler, rocker],
        [
            mbd.Revolute(ground.at(), crank.at(), axis="z"),
            mbd.Drive(ground, crank, axis="z", speed=speed),
            mbd.Spherical(crank.at(CRANK, 0, 0), coupler.at("left")),
            mbd.Universal(coupler.at("right"), rocker.at(ROCKER, 0, 0), axes="yz"),
            mbd.Revolute(ground.at(BASE, 0, 0), rocker.at(), axis="z"),
        ],
    )


def motion() -> mbd.Trajectory:
    """Two turns of the crank."""
    return mbd.simulate(build(), 4.0 * math.pi / 40.0, steps=400, gradients="none")
