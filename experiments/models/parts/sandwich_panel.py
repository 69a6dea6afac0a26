"""A sandwich panel unfolds by a spring and latches. How thin may its skins and its core be?"""

import torchmbd as mbd


def build() -> mbd.System:
    carbon = mbd.examples.carbon()
    foam = mbd.Ply.isotropic(E=70e6, nu=0.3, density=60.0)
    laminate = mbd.Laminate([carbon, foam, carbon], mbd.deg([0, 0, 0]), thickness=[0.2e-3, 6e-3, 0.2e-3])
    laminate.thickness.requires_grad_(True)
    plate = mbd.mesh.rectangle(0.8, 0.5, cells=(6, 4))  # [m]
    panel = mbd.FlexibleBody.plate("panel", plate, laminate, reference="left", damping=1e-3)
    root = mbd.RigidBody("root", 0.5, (1e-3, 1e-3, 1e-3))
    ground = mbd.Ground()
    joints = [
        mbd.Revolute(ground.at(), root.at(), axis="y", name="hinge"),
        mbd.Fixed(root.at(), panel.at("left"), name="edge"),
    ]
    stiffness, damping, unwound = 0.2, 0.02, 2.0  # [N m/rad], [N m s/rad], [rad]
    spring = mbd.RotationalSpringDamper(ground.at(), root.at(), "y", stiffness, damping, unwound, name="spring")
    return mbd.System([root, panel], joints, [spring])


def phases() -> list[mbd.Phase]:
    """The panel turns by 90 degrees; then the hinge is locked."""
    unfolded = mbd.Event(mbd.Angle("root", "y") - mbd.deg(90.0), "rising")
    return [mbd.Phase(until=unfolded, name="unfolding"), mbd.Phase(lock=["hinge"], name="latched")]


def problem() -> mbd.Problem:
    tip = mbd.Max(abs(mbd.Displacement("panel", "z", node="right")))
    limits = [tip <= 0.02, mbd.Frequency("panel") >= 15.0]
    bounds = {"panel.laminate.thickness": ([0.1e-3, 2e-3, 0.1e-3], [1e-3, 20e-3, 1e-3])}
    settings = {"phases": phases(), "variables": ["panel.laminate.thickness"]}
    return mbd.Problem(build(), 2.5, minimize=mbd.Mass("panel"), subject_to=limits, bounds=bounds, **settings)


if __name__ == "__main__":
    print(mbd.optimize(problem()))
