"""A jib of an I-beam swings through 60 degrees, a load hangs on its rope. How light may flanges and web be?"""

import torchmbd as mbd

LENGTH, ROPE, LOAD = 3.0, 1.5, 20.0  # [m], [m], [kg]


def build() -> mbd.System:
    angles = {"top": mbd.deg([0, 0]), "web": mbd.deg([15, -15]), "bottom": mbd.deg([0, 0])}
    section = mbd.sections.i_section(
        0.08, 0.12, mbd.examples.carbon(), angles, thickness=mbd.variable(3e-3), cells=(2, 6, 1)
    )
    jib = mbd.FlexibleBody.beam(
        "jib", mbd.BeamLine.straight(LENGTH, 6), section, reference="start", damping=2e-3, stiffening=True
    )
    load = mbd.RigidBody("load", LOAD, (1.0, 1.0, 1.0), position=(LENGTH, 0, -ROPE))
    ground = mbd.Ground()
    joints = [
        mbd.Revolute(ground.at(), jib.at("start"), axis="z", name="slewing"),
        mbd.Drive(ground.at(), jib.at("start"), axis="z", angle=mbd.SmoothStep(mbd.deg(60.0), 3.0), name="motor"),
        mbd.Universal(jib.at("end"), load.at(0, 0, ROPE), axes="xy", name="rope"),
    ]
    return mbd.System([jib, load], joints, gravity=(0, 0, -9.81))


def problem() -> mbd.Problem:
    sag, sway = (mbd.Max(abs(mbd.Displacement("jib", axis, node="end"))) for axis in "zy")
    limits = [sag <= 0.015, sway <= 0.015, mbd.Max(mbd.PlyFailure("jib")) <= 0.5]
    bounds = {"jib.section.thickness": (2e-3, 5e-3), "jib.section.angles": mbd.deg([-90, 90])}
    return mbd.Problem(
        build(), duration=4.5, start="equilibrium", minimize=mbd.Mass("jib"), subject_to=limits, bounds=bounds
    )


if __name__ == "__main__":
    print(mbd.optimize(problem()))
