"""A laminated box beam with a tip mass on a hub that a motor turns about z: lead, flap and twist between orders of the speed.

Run: torchmbd run configs/turning_blade/clear_of_orders.yaml
"""

from __future__ import annotations

import torch

import torchmbd as mbd

LENGTH, WIDTH, HEIGHT = 1.2, 0.06, 0.02  # [m]
PLY, TIP = 1e-3, 5.0  # thickness of a layer at the start [m], mass at the tip [kg]


def build(speed: float = 60.0, elements: int = 8) -> mbd.System:
    """The blade.

    speed     of the motor [rad/s]
    elements  along the blade
    """
    carbon = mbd.Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=3.6e9, nu12=0.23, density=1586.0)
    thickness = torch.nn.Parameter(torch.full((2,), PLY, dtype=torch.float64))
    section = mbd.sections.box(WIDTH, HEIGHT, carbon, mbd.deg([20.0, 45.0]), thickness=thickness, cells=(6, 3, 1))
    blade = mbd.FlexibleBeam("blade", mbd.BeamLine.straight(LENGTH, elements=elements), section)
    hub = mbd.RigidBody("hub", mass=2.0, inertia=(0.01, 0.01, 0.01))
    tip = mbd.RigidBody("tip", mass=TIP, inertia=(2e-4, 1e-4, 2e-4), position=(LENGTH, 0.0, 0.0))
    ground = mbd.Ground()
    joints = [
        mbd.Revolute(ground.at(), hub.at(), axis="z", name="bearing"),
        mbd.Drive(ground.at(), hub.at(), axis="z", speed=speed, name="motor"),
        mbd.Fixed(hub.at(), blade.at("start"), name="root"),
        mbd.Fixed(blade.at("end"), tip.at(), name="weld"),
    ]
    return mbd.System([hub, blade, tip], joints)
