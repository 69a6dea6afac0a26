"""A tapered carbon tube swings a tool through 90 degrees. How thin may its wall be, at which ply angles?"""

import torch

import torchmbd as mbd


def build() -> mbd.System:
    carbon = mbd.examples.carbon()
    wall, angles = mbd.variable(0.25e-3), torch.nn.Parameter(mbd.deg([45.0, -45.0, 0.0]))
    radii = (0.028125, 0.024375, 0.020625, 0.016875)  # [m], in the middles of four elements between 30 and 15 mm
    sections = [mbd.sections.tube(r, carbon, angles, thickness=wall, cells=(12, 1)) for r in radii]
    arm = mbd.FlexibleBody.beam("arm", mbd.BeamLine.straight(1.2, 4), sections, reference="start", damping=5e-3)
    tool = mbd.RigidBody("tool", mass=0.3, inertia=(2e-4, 2e-4, 2e-4), position=(1.2, 0, 0))
    ground = mbd.Ground()
    shoulder = mbd.Revolute(ground.at(), arm.at("start"), axis="z", name="shoulder")
    motor = mbd.Drive(ground.at(), arm.at("start"), axis="z", angle=mbd.SmoothStep(mbd.deg(90.0), 0.5), name="motor")
    return mbd.System([arm, tool], [shoulder, motor, mbd.Fixed(arm.at("end"), tool.at())], gravity=(0, 0, -9.81))


def problem() -> mbd.Problem:
    sway, sag = (mbd.Displacement("arm", axis, node="end") for axis in "yz")
    limits = [
        mbd.Frequency("arm") >= 60.0,
        mbd.Max(mbd.PlyFailure("arm")) <= 0.3,
        mbd.Max(abs(sway)) <= 3.5e-3,
        mbd.Max(abs(sag)) <= 1.2e-3,
    ]
    bounds = {"arm.section0.angles": mbd.deg([-90, 90]), "arm.section0.thickness": (0.1e-3, 1e-3)}
    return mbd.Problem(build(), duration=0.8, minimize=mbd.Mass("arm"), subject_to=limits, bounds=bounds)


if __name__ == "__main__":
    print(mbd.optimize(problem()))
