"""A filament-wound shaft between two bearings, a disk in its middle. How light may it be below its critical speed?"""

import torch

import torchmbd as mbd

LENGTH, RADIUS = 1.2, 0.03  # [m]


def build() -> mbd.System:
    carbon = mbd.Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=3.6e9, nu12=0.3, density=1586.0)
    wall, angles = mbd.variable(1e-3), torch.nn.Parameter(mbd.deg([45.0, -45.0]))
    tube = mbd.sections.tube(RADIUS, carbon, angles, thickness=wall, cells=(12, 1))
    shaft = mbd.FlexibleBody.beam("shaft", mbd.BeamLine.straight(LENGTH, 6), tube, position=(LENGTH / 2, 0, 0))
    disk = mbd.RigidBody("disk", 3.0, (6e-3, 3e-3, 3e-3), position=(LENGTH / 2, 0, 0))
    ground = mbd.Ground()
    bearings = [
        mbd.Bushing(ground.at(0, 0, 0), shaft.at("start"), (1e7, 5e7, 5e7), name="bearing_a"),
        mbd.Bushing(ground.at(LENGTH, 0, 0), shaft.at("end"), (0.0, 5e7, 5e7), name="bearing_b"),
    ]
    hub = mbd.Fixed(shaft.at("center"), disk.at(), name="hub")
    return mbd.System([shaft, disk], [hub], bearings, free=["shaft", "disk"])


def problem() -> mbd.Problem:
    limits = [mbd.vibrations.CriticalSpeed(1, between=(20.0, 2000.0), axis="x") >= 350.0]
    bounds = {"shaft.section.angles": mbd.deg([0, 90]), "shaft.section.thickness": (0.3e-3, 3e-3)}
    links = {"shaft.section.angles[1]": {"shaft.section.angles[0]": -1.0}}
    return mbd.Problem(
        build(), 1e-4, steps=2, minimize=mbd.Mass("shaft"), subject_to=limits, bounds=bounds, links=links
    )


if __name__ == "__main__":
    print(mbd.optimize(problem()))
