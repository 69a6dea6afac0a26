"""A C-profile carries a camera beside its shear center. How thin may its walls be, at which angle should its plies lie?"""

import math

import torchmbd as mbd

LENGTH, LOAD = 1.0, 1.0  # [m], [kg]


def build() -> mbd.System:
    angles = mbd.deg([30, -30, -30, 30])
    section = mbd.sections.c_section(
        0.03, 0.06, mbd.examples.carbon(), angles, thickness=mbd.variable(0.8e-3), cells=(6, 1)
    )
    boom = mbd.FlexibleBody.beam("boom", mbd.BeamLine.straight(LENGTH, 8), section, reference="start", damping=2e-3)
    camera = mbd.RigidBody("camera", LOAD, (2e-3, 2e-3, 2e-3), position=(LENGTH, 0, 0))
    joints = [
        mbd.Fixed(mbd.Ground().at(), boom.at("start"), name="wall"),
        mbd.Fixed(boom.at("end"), camera.at(), name="mount"),
    ]
    return mbd.System([boom, camera], joints, gravity=(0, 0, -9.81))


def problem() -> mbd.Problem:
    sag, twist = mbd.Max(abs(mbd.Displacement("boom", "z", node="end"))), mbd.Max(abs(mbd.Angle("camera", "x")))
    limits = [sag <= 7e-4, twist <= math.radians(0.5)]
    bounds = {"boom.section.angles": mbd.deg([0, 90]), "boom.section.thickness": (0.1e-3, 2e-3)}
    first = "boom.section.angles[0]"
    links = {f"boom.section.angles[{k}]": {first: sign} for k, sign in ((1, -1.0), (2, -1.0), (3, 1.0))}
    return mbd.Problem(
        build(), 0.1, start="equilibrium", minimize=mbd.Mass("boom"), subject_to=limits, bounds=bounds, links=links
    )


if __name__ == "__main__":
    print(mbd.optimize(problem()))
