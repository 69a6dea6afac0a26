"""The blade of the NREL 5 MW turbine carries a damper in its tip. How heavy may it be at a first frequency of 0.5 Hz?"""

from pathlib import Path

import numpy as np

import torchmbd as mbd

LENGTH, STIFF, ARM = 61.5, 1e10, 0.3  # [m]; [N] and [m], of no effect on bending


def build() -> mbd.System:
    table = np.loadtxt(Path(__file__).with_name("nrel_5mw_blade.csv"), delimiter=",")
    sections = []
    for mass, flap, edge in table[:, 1:]:
        stiffness = np.diag([STIFF, STIFF, STIFF, flap, flap, edge])
        sections.append((stiffness, mass * np.diag([1.0, 1.0, 1.0, 2 * ARM**2, ARM**2, ARM**2])))
    blade = mbd.FlexibleBeam(
        "blade", mbd.BeamLine.straight(LENGTH, 40), mbd.SectionTable(table[:, 0].tolist(), sections)
    )
    damper = mbd.RigidBody("damper", mbd.variable(100.0), (1.0, 1.0, 1.0), position=(LENGTH, 0, 0))
    joints = [
        mbd.Fixed(mbd.Ground().at(), blade.at("start"), name="root"),
        mbd.Fixed(blade.at("end"), damper.at(), name="seat"),
    ]
    return mbd.System([blade, damper], joints)


def problem() -> mbd.Problem:
    limits, bounds = [mbd.vibrations.SystemFrequency(1) >= 0.5], {"damper.mass": (1.0, 2000.0)}
    return mbd.Problem(build(), 1e-3, steps=2, maximize=mbd.Mass("damper"), subject_to=limits, bounds=bounds)


if __name__ == "__main__":
    print(mbd.optimize(problem()))
