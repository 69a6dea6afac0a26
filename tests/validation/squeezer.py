"""Andrews' squeezing mechanism: seven planar bodies with three loops, one motor torque and one spring.

Data, initial angles and the reference at t = 0.03 s (PSIDE, tolerances 1e-14): Lioen, de Swart, Test Set for Initial
Value Problem Solvers, CWI (1998), problem "Andrews' squeezing mechanism"; also Hairer, Wanner, Solving Ordinary
Differential Equations II, section VII.7, from which the geometry of the bodies is taken.
"""

from __future__ import annotations

import torch

import torchmbd as mbd
from tests.mechanisms import tensor, turned

START = {
    "beta": -0.0617138900142764496358948458001,
    "Theta": 0.0,
    "gamma": 0.455279819163070380255912382449,
    "Phi": 0.222668390165885884674473185609,
    "delta": 0.487364979543842550225598953530,
    "Omega": -0.222668390165885884674473185609,
    "epsilon": 1.23054744454982119249735015568,
}
# Angles [rad], their rates [rad/s] and accelerations [rad/s2] at t = 0.03 s, in the order of START.
ANGLES = (
    15.81077119629904,
    -15.75637105984298,
    0.04082224013073101,
    -0.5347301163226948,
    0.5244099658805304,
    0.5347301163226948,
    1.048080741042263,
)
RATES = (
    1139.920302151208,
    -1424.379294994111,
    11.03291221937134,
    19.29337464421385,
    0.5735699284790808,
    -19.29337464421385,
    0.3231791658026955,
)
# Angle of a body from the x axis, as sums of the angles: K1, ..., K7.
SUMS = {
    "K1": ("beta",),
    "K2": ("beta", "Theta"),
    "K3": ("gamma",),
    "K4": ("Phi", "delta"),
    "K5": ("delta",),
    "K6": ("Omega", "epsilon"),
    "K7": ("epsilon",),
}
# Mass [kg], inertia about the center [kg m2], and center in body axes [m].
BODIES = {
    "K1": (0.04325, 2.194e-6, (0.00092, 0.0)),
    "K2": (0.00365, 4.410e-7, (-0.0115, 0.0)),
    "K3": (0.02373, 5.255e-6, (0.01043, -0.01874)),
    "K4": (0.00706, 5.667e-7, (0.0, 0.01421 - 0.02)),
    "K5": (0.07050, 1.169e-5, (0.02308, 0.00916)),
    "K6": (0.00706, 5.667e-7, (0.02 - 0.01421, 0.0)),
    "K7": (0.05498, 1.912e-5, (0.00449, -0.01228)),
}
A, B, C = (-0.06934, -0.00227), (-0.03635, 0.03273), (0.014, 0.072)


def of_body(values: dict[str, float], name: str) -> float:
    """Angle of a body, or its rate."""
    return sum(values[part] for part in SUMS[name])


def squeezer() -> mbd.System:
    """The mechanism at the start, at rest."""
    turn = {name: turned(0.0, 0.0, of_body(START, name)) for name in BODIES}

    def ahead(origin: torch.Tensor, name: str, x: float, y: float) -> torch.Tensor:
        return origin + turn[name] @ tensor(x, y, 0.0)

    origin = {"K1": tensor(0.0, 0.0, 0.0), "K3": tensor(*B, 0.0), "K5": tensor(*A, 0.0), "K7": tensor(*A, 0.0)}
    origin |= {"K2": ahead(origin["K1"], "K1", 0.007, 0.0), "K4": ahead(origin["K5"], "K5", 0.04, 0.0)}
    origin["K6"] = ahead(origin["K7"], "K7", 0.0, -0.04)
    K = {
        name: mbd.RigidBody(name, m, (J, J, J), center=(*c, 0.0), position=origin[name], axes=turn[name])
        for name, (m, J, c) in BODIES.items()
    }
    ground, tip = mbd.Ground(), K["K2"].at(-0.028, 0.0)
    hinges = [
        (ground.at(), K["K1"].at()),
        (K["K1"].at(0.007, 0.0), K["K2"].at()),
        (ground.at(*B), K["K3"].at()),
        (ground.at(*A), K["K5"].at()),
        (ground.at(*A), K["K7"].at()),
        (K["K5"].at(0.04, 0.0), K["K4"].at()),
        (K["K7"].at(0.0, -0.04), K["K6"].at()),
        (tip, K["K3"].at(0.0, -0.035)),
        (tip, K["K4"].at(0.0, -0.02)),
        (tip, K["K6"].at(0.02, 0.0)),
    ]
    joints = [mbd.Revolute(a, b, "z", name=f"hinge_{k}") for k, (a, b) in enumerate(hinges)]
    forces = [
        mbd.Torque(K["K1"].at(), (0.0, 0.0, 0.033)),
        mbd.SpringDamper(ground.at(*C), K["K3"].at(0.02, -0.018), stiffness=4530.0, rest=0.07785),
    ]
    return mbd.System(list(K.values()), joints, forces, stabilization=2e-4)
