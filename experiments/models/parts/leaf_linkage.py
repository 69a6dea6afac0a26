"""A crank and a coupler swing the tip of a leaf spring, the rocker of a four-bar linkage. How soft may it be at 60 Hz?"""

import torchmbd as mbd

CRANK, COUPLER, LEAF, WIDTH = 0.01, 0.15, 0.2, 0.03  # [m]


def build() -> mbd.System:
    laminate = mbd.Laminate(mbd.examples.carbon(), mbd.deg([20, -20]), thickness=0.6e-3, symmetric=True)
    laminate.thickness.requires_grad_(True)
    upright = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]  # the leaf stands along y, its normal lies along x
    strip = mbd.mesh.rectangle(LEAF, WIDTH, cells=(12, 2))
    leaf = mbd.FlexibleBody.plate("leaf", strip, laminate, axes=upright, reference="left_edge", damping=1e-5)
    crank = mbd.RigidBody("crank", 0.05, (1e-5, 1e-5, 1e-5), position=(-COUPLER, LEAF, 0))
    coupler = mbd.RigidBody("coupler", 0.05, (1e-6, 1e-4, 1e-4), position=(-COUPLER / 2, LEAF, 0))
    ground = mbd.Ground()
    joints = [
        mbd.Fixed(ground.at(), leaf.at("left_edge"), name="foot"),
        mbd.Revolute(ground.at(-COUPLER, LEAF - CRANK, 0), crank.at(0, -CRANK, 0), axis="z", name="shaft"),
        mbd.Drive(ground.at(-COUPLER, LEAF - CRANK, 0), crank.at(0, -CRANK, 0), axis="z", speed=20.0, name="motor"),
        mbd.Spherical(crank.at(), coupler.at(-COUPLER / 2, 0, 0), name="pin"),
        mbd.Universal(coupler.at(COUPLER / 2, 0, 0), leaf.at("right"), axes="zx", name="eye"),
    ]
    return mbd.System([crank, coupler, leaf], joints)


def problem() -> mbd.Problem:
    limits = [mbd.Frequency("leaf") >= 60.0, mbd.Max(mbd.PlyFailure("leaf")) <= 1.0]
    bounds = {"leaf.laminate.thickness": (0.2e-3, 1e-3), "leaf.laminate.angles": mbd.deg([-90, 90])}
    energy = mbd.Max(mbd.StrainEnergy("leaf"))
    return mbd.Problem(build(), duration=0.35, minimize=energy, subject_to=limits, bounds=bounds)


if __name__ == "__main__":
    print(mbd.optimize(problem()))
