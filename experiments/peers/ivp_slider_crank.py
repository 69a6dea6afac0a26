"""The elastic slider-crank of the test set for IVP solvers. `python -m experiments.peers.ivp_slider_crank`

A crank that turns at 150 rad/s drives a rod of two bending and two axial functions with a slider at its end; the published
solution at 0.1 s is of the linear rod. Data: F. Mazzia, C. Magherini, Test Set for Initial Value Problem Solvers, release
2.4 (2008), slider crank (crank.f, B. Simeon); in public also SciML/SciMLBenchmarks.jl, benchmarks/DAE/slider_crank.jmd.

    w1, w2    sin(pi x / l), sin(2 pi x / l) along y         w3, w4   quadratic, along x: one in the middle, one at the end

The mass matrix of w3, w4 is that of the source, 15 times that of these functions, in sum m t t' and in the modal mass.
Of the rod with quadratic stiffness no numbers are published: `reference` integrates the source's equations by another
method, which has the published numbers of the linear rod.
Checked in tests/validation/test_ivp_slider_crank.py.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy.integrate
import torch
from numpy.typing import NDArray

import torchmbd as mbd

M2, M3, L1, L2, J1, J2 = 0.151104, 0.075552, 0.15, 0.30, 0.002727, 0.0045339259
E, SIDE, RHO, SPEED, DURATION, PI = 0.20e12, 0.0080, 7870.0, 150.0, 0.1, 3.1415927
START = (0.0, 0.0, 0.103339863e-4, 0.169327969e-4)  # w1 to w4
START_RATE = (0.444896105, 0.463434311e-2, -0.178591076e-5, -0.268938672e-5)
#: at 0.1 s: angle of the rod, place of the slider, w1 to w4, multipliers: less the forces on the slider along y (of its
#: guide) and x (of the rod), and less the torque of the drive.
PUBLISHED = {
    "phi2": -0.331173498825626,
    "x3": 0.169737332842786,
    "q1": 0.1893192899613509e-3,
    "q2": 0.2375751249879174e-4,
    "q3": -0.5323896770569702e-5,
    "q4": -0.8363313279112129e-5,
    "lambda1": -62.32935833287916,
    "lambda2": -163.7920993367306,
    "lambda3": 25.29857947066878,
}


class Rod(NamedTuple):
    """Matrices of the source: mass and stiffness [4, 4], sum m t_x t_y' - t_y t_x', and integrals of the functions."""

    M: NDArray[Any]
    K: NDArray[Any]
    B: NDArray[Any]
    c1: NDArray[Any]
    c2: NDArray[Any]
    c12: NDArray[Any]
    c21: NDArray[Any]
    K2: NDArray[Any]


def rod(nonlinear: bool) -> Rod:
    """The matrices; K2: third derivatives of E A / 2 int u' v'^2 dx."""
    mass, k = RHO * SIDE**2 * L2, E * SIDE**2 / L2
    M, K, B, K2 = np.zeros((4, 4)), np.zeros((4, 4)), np.zeros((4, 4)), np.zeros((4, 4, 4))
    M[0, 0] = M[1, 1] = 0.5 * mass
    M[2:, 2:] = mass * np.array([[8.0, 1.0], [1.0, 2.0]])
    bending = k * PI**4 * (SIDE / L2) ** 2
    K[0, 0], K[1, 1] = bending / 24.0, bending * 2.0 / 3.0
    K[2:, 2:] = k / 3.0 * np.array([[16.0, -8.0], [-8.0, 7.0]])
    B[2, 0], B[3, 0], B[3, 1] = 16.0 / PI**3, 1.0 / PI - 8.0 / PI**3, -0.5 / PI
    if nonlinear:
        f, g = 0.5 * E * SIDE**2 / L2**2 * PI**2, 80.0 / (9.0 * PI**2)
        for (a, b, c), x in {(0, 0, 3): f, (1, 1, 3): 4 * f, (0, 1, 2): 4 * f * g, (0, 1, 3): -2 * f * g}.items():
            for place in {(a, b, c), (a, c, b), (b, a, c), (b, c, a), (c, a, b), (c, b, a)}:
                K2[place] = x
    c1, c2 = mass * np.array([0.0, 0.0, 2 / 3, 1 / 6]), mass * np.array([2 / PI, 0.0, 0.0, 0.0])
    c12 = L2 * mass * np.array([0.0, 0.0, 1 / 3, 1 / 6])
    c21 = L2 * mass * np.array([1 / PI, -0.5 / PI, 0.0, 0.0])
    return Rod(M, K, mass * (B - B.T), c1, c2, c12, c21, K2)


def build(nonlinear: bool = False) -> mbd.System:
    """Our system: a rigid crank, the reduced rod in its frame from pin to pin, a slider."""
    beam = rod(nonlinear)
    x = np.linspace(0.0, L2, 5)
    shapes = np.zeros((5, 3, 4))
    shapes[:, 1, 0], shapes[:, 1, 1] = np.sin(np.pi * x / L2), np.sin(2 * np.pi * x / L2)
    shapes[:, 0, 2], shapes[:, 0, 3] = 4 * x / L2 * (1 - x / L2), x / L2 * (2 * x / L2 - 1)
    S1, C0, C1 = np.zeros((3, 4)), np.zeros((3, 3, 4)), np.zeros((3, 3, 4, 4))
    S1[0], S1[1], C0[0, 0], C0[1, 0] = beam.c1, beam.c2, beam.c12, beam.c21
    C1[0, 0, 2:, 2:], C1[1, 1, :2, :2] = beam.M[2:, 2:], beam.M[:2, :2]
    C1[0, 1, 2:, :2], C1[1, 0, :2, 2:] = beam.B[2:, :2], beam.B[2:, :2].T
    invariants = {"mass": M2, "S0": (M2 * L2 / 2, 0.0, 0.0), "S1": S1, "J": np.diag([1e-5, J2, J2]), "C0": C0, "C1": C1}
    nodes = np.stack([x, 0 * x, 0 * x], 1)
    sets = {"pin": [0], "end": [4]}
    body = mbd.FlexibleBody.from_reduced(
        "rod",
        nodes,
        shapes,
        beam.K,
        invariants,
        node_sets=sets,
        K2=beam.K2 if nonlinear else None,
        position=(L1, 0.0, 0.0),
    )
    psi = body.structure()["psi"][:, :3].flatten(0, 1)
    start = torch.from_numpy(shapes).flatten(0, 1) @ torch.tensor([START, START_RATE], dtype=torch.float64).T
    modal, rate = torch.linalg.lstsq(psi, start).solution.T
    body.bent(modal, rate)
    crank = mbd.RigidBody("crank", mass=0.36, inertia=(J1, J1, J1))
    slider = mbd.RigidBody("slider", M3, (1e-5, 1e-5, 1e-5), position=(L1 + L2, 0.0, 0.0))
    ground = mbd.Ground()
    joints = [
        mbd.Revolute(ground.at(), crank.at(), axis="z"),
        mbd.Drive(ground, crank, axis="z", speed=SPEED, name="drive"),
        mbd.Spherical(crank.at(L1, 0.0, 0.0), body.at("pin")),
        mbd.Universal(body.at("end"), slider.at(), axes="yz", name="end"),
        mbd.Prismatic(ground.at(), slider.at(), axis="x", name="guide"),
    ]
    return mbd.System([crank, body, slider], joints, truncation=None)


def ours(nonlinear: bool = False, steps: int = 40_000, duration: float = DURATION) -> dict[str, float]:
    """What is published, of our motion at its end."""
    motion = mbd.simulate(build(nonlinear), duration, steps=steps, gradients="none", backend="native").require_ok()
    view = motion.body("rod")
    moved, A = view.displacements[0, -1], view.A[0, -1]
    v = moved[1:4, 1]
    return {
        "phi2": float(torch.atan2(A[1, 0], A[0, 0])),
        "x3": float(motion.body("slider").r[0, -1, 0]),
        "q1": float(v[1]),
        "q2": float(0.5 * (v[0] - v[2])),
        "q3": float(moved[2, 0]),
        "q4": float(moved[4, 0]),
        "lambda1": -float(motion.reaction("guide").force[0, -1, 1]),
        "lambda2": -float((A @ motion.reaction("end").force[0, -1])[0]),
        "lambda3": -float(motion.reaction("drive").torque[0, -1, 2]),
    }


def reference(nonlinear: bool = False, accuracy: float = 1e-10, duration: float = DURATION) -> dict[str, float]:
    """The equations of the source for phi1, phi2, x3, w1 to w4, with accelerations of the constraints, by DOP853."""
    beam = rod(nonlinear)
    angle = np.array([0.0, 0.0, L1 + L2 + START[3]])
    p0 = np.concatenate([angle, START])
    v0 = np.concatenate([[SPEED, -SPEED * L1 / (L2 + START[3]), START_RATE[3]], START_RATE])

    def accelerations(y: NDArray[Any]) -> NDArray[Any]:
        p, v = y[:7], y[7:]
        q, qd, (v1, v2) = p[3:], v[3:], v[:2]
        c, s = np.cos(p[0] - p[1]), np.sin(p[0] - p[1])
        A = np.zeros((10, 10))
        A[0, 0], A[2, 2] = J1 + M2 * L1**2, M3
        A[0, 1] = A[1, 0] = 0.5 * L1 * L2 * M2 * c + L1 * (s * beam.c2 @ q + c * beam.c1 @ q)
        A[1, 1] = J2 + q @ beam.M @ q + 2 * beam.c12 @ q
        A[0, 3:7] = A[3:7, 0] = L1 * (c * beam.c2 - s * beam.c1)
        A[1, 3:7] = A[3:7, 1] = beam.c21 + q @ beam.B
        A[3:7, 3:7] = beam.M
        f = np.zeros(10)
        f[0] = -0.5 * L1 * L2 * M2 * v2**2 * s + L1 * v2**2 * (c * beam.c2 - s * beam.c1) @ q
        f[0] -= 2 * L1 * v2 * (c * beam.c1 + s * beam.c2) @ qd
        f[1] = 0.5 * L1 * L2 * M2 * v1**2 * s + L1 * v1**2 * (s * beam.c1 - c * beam.c2) @ q
        f[1] -= 2 * v2 * (beam.c12 @ qd + q @ beam.M @ qd) + qd @ beam.B @ qd
        f[3:7] = v2**2 * (beam.M @ q + beam.c12) + L1 * v1**2 * (c * beam.c1 + s * beam.c2) + 2 * v2 * beam.B @ qd
        f[3:7] -= beam.K @ q + 0.5 * beam.K2 @ q @ q
        (c1, s1), (c2, s2), l = (np.cos(p[0]), np.sin(p[0])), (np.cos(p[1]), np.sin(p[1])), L2 + q[3]
        G = np.zeros((3, 7))
        G[0, [0, 1, 6]], G[1, [0, 1, 2, 6]], G[2, 0] = (L1 * c1, l * c2, s2), (L1 * s1, l * s2, 1.0, -c2), 1.0
        A[7:, :7], A[:7, 7:] = G, G.T
        f[7] = L1 * s1 * v1**2 + l * s2 * v2**2 - 2 * v2 * c2 * qd[3]
        f[8] = -L1 * c1 * v1**2 - l * c2 * v2**2 - 2 * v2 * s2 * qd[3]
        return np.linalg.solve(A, f)

    def rates(_: float, y: NDArray[Any]) -> NDArray[Any]:
        return np.concatenate([y[7:], accelerations(y)[:7]])

    solution = scipy.integrate.solve_ivp(
        rates, (0.0, duration), np.concatenate([p0, v0]), "DOP853", rtol=accuracy, atol=1e-3 * accuracy
    )
    y = solution.y[:, -1]
    return dict(zip(PUBLISHED, [*y[1:7], *accelerations(y)[7:]], strict=True))


def main() -> None:
    """Print both rods beside the published numbers and those of `reference`."""
    for nonlinear in (False, True):
        mine, other = ours(nonlinear), reference(nonlinear)
        print("quadratic stiffness" if nonlinear else "linear stiffness")
        print(f"{'at 0.1 s':10}{'published':>16}{'reference':>16}{'ours':>16}{'ours / reference - 1':>22}")
        for name, x in mine.items():
            theirs = "" if nonlinear else f"{PUBLISHED[name]:.8g}"
            print(f"{name:10}{theirs:>16}{other[name]:16.8g}{x:16.8g}{x / other[name] - 1:22.1e}")


if __name__ == "__main__":
    main()
