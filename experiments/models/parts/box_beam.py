"""One web of a box beam is of carbon, the other of glass. How light may it be with little sag and twist under a load?"""

import math

import torchmbd as mbd

LENGTH, LOAD = 1.5, 20.0  # [m], [kg]


def build() -> mbd.System:
    carbon = mbd.examples.carbon()
    glass = mbd.Ply(E1=39e9, E2=8.6e9, G12=3.8e9, G13=3.8e9, G23=3.3e9, nu12=0.28, density=2100.0)
    plies = [carbon, carbon, carbon, carbon, carbon, carbon, glass, glass]  # two in each of top, right, bottom, left
    angles = {wall: mbd.deg([30, -30]) for wall in ("top", "right", "bottom", "left")}
    section = mbd.sections.box(0.1, 0.05, plies, angles, thickness=mbd.variable(1e-3), cells=(8, 4, 1))
    beam = mbd.FlexibleBody.beam("beam", mbd.BeamLine.straight(LENGTH, 6), section, reference="start", damping=2e-3)
    load = mbd.RigidBody("load", LOAD, (0.05, 0.05, 0.05), position=(LENGTH, 0, 0))
    joints = [
        mbd.Fixed(mbd.Ground().at(), beam.at("start"), name="wall"),
        mbd.Fixed(beam.at("end"), load.at(), name="seat"),
    ]
    return mbd.System([beam, load], joints, gravity=(0, 0, -9.81))


def problem() -> mbd.Problem:
    sag, twist = mbd.Max(abs(mbd.Displacement("beam", "z", node="end"))), mbd.Max(abs(mbd.Angle("load", "x")))
    limits = [sag <= 5e-3, twist <= math.radians(0.03)]
    bounds = {"beam.section.angles": mbd.deg([0, 90]), "beam.section.thickness": (0.3e-3, 3e-3)}
    flange, web = "beam.section.angles[0]", "beam.section.angles[2]"
    links = {f"beam.section.angles[{k}]": {web if k in (3, 6, 7) else flange: (-1.0) ** k} for k in (1, 3, 4, 5, 6, 7)}
    return mbd.Problem(
        build(), 0.1, start="equilibrium", minimize=mbd.Mass("beam"), subject_to=limits, bounds=bounds, links=links
    )


if __name__ == "__main__":
    print(mbd.optimize(problem()))
