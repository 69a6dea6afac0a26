"""Rigid mechanisms of the IFToMM library of computational benchmark problems, and the heavy top, with their references.

Data: Gonzalez, Dopico, Lugris, Cuadrado, A benchmarking system for MBS simulation software, Multibody Syst. Dyn. 16
(2006) 179-190, problems A01, A02 and A04; Bruels, Cardona, Arnold, Mech. Mach. Theory 48 (2012) 121-137 (heavy top).
The references are the closed solutions of the same problems, which those works approximate.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.integrate import solve_ivp
from scipy.special import ellipj, ellipk
from torch import Tensor

import torchmbd as mbd
from tests.mechanisms import tensor

G = 9.81
SLOW = 5e-2  # [s] time constant of the stabilization: an explicit method can take large steps


def rod(
    name: str, start: Tensor, end: Tensor, side: float = 0.0, **given
) -> tuple[mbd.RigidBody, mbd.Frame, mbd.Frame]:
    """A rod of 1 m and 1 kg with frames at its ends, along its own y axis; side of its square section [m]."""
    y = end - start
    helper = tensor(0.0, 0.0, 1.0) if abs(float(y[2])) < 0.5 else tensor(1.0, 0.0, 0.0)
    x = torch.linalg.cross(y, helper)
    axes = torch.stack([x, y, torch.linalg.cross(x, y)], 1)  # of an upright rod: those of the ground
    across = (1.0 + side**2) / 12.0
    inertia = (across, side**2 / 6.0, across)
    body = mbd.RigidBody(name, 1.0, inertia, position=(start + end) / 2, axes=axes, **given)
    return body, body.at(0.0, -0.5, 0.0, axes=axes.T), body.at(0.0, 0.5, 0.0, axes=axes.T)


def simple_pendulum() -> mbd.System:
    """A01: a point mass of 1 kg on a massless bar of 1 m, at rest at x = -1, y = 0."""
    bob = mbd.RigidBody("bob", 1.0, (0.0, 0.0, 0.0), center=(-1.0, 0.0, 0.0))
    return mbd.System([bob], [mbd.Revolute(mbd.Ground().at(), bob.at(), "z")], gravity=(0.0, -G, 0.0))


def simple_pendulum_at(t: np.ndarray) -> np.ndarray:
    """x, y of the mass [times, 2]: sin(th / 2) = k sn(K - sqrt(g) t), k = sin(pi / 4); th from below, to the left."""
    half = math.sqrt(0.5) * ellipj(ellipk(0.5) - math.sqrt(G) * t, 0.5)[0]
    th = 2.0 * np.arcsin(half)
    return np.stack([-np.sin(th), -np.cos(th)], -1)


def n_four_bar(windows: int = 2) -> mbd.System:
    """A02: windows of rods of 1 m side by side, upright; the upper ends go at 1 m/s to the right."""
    ground, z = mbd.Ground(), "z"
    bodies, joints, uprights = [], [], []
    for k in range(windows + 1):
        foot, top = tensor(float(k), 0.0, 0.0), tensor(float(k), 1.0, 0.0)
        body, low, high = rod(f"upright_{k}", foot, top, velocity=(0.5, 0.0, 0.0), angular_velocity=(0.0, 0.0, -1.0))
        bodies.append(body)
        uprights.append(high)
        joints.append(mbd.Revolute(ground.at(float(k), 0.0, 0.0), low, z, name=f"foot_{k}"))
    for k in range(windows):
        body, left, right = rod(
            f"beam_{k}", tensor(float(k), 1.0, 0.0), tensor(k + 1.0, 1.0, 0.0), velocity=(1.0, 0.0, 0.0)
        )
        bodies.append(body)
        joints.append(mbd.Revolute(uprights[k], left, z, name=f"left_{k}"))
        joints.append(mbd.Revolute(uprights[k + 1], right, z, name=f"right_{k}"))
    return mbd.System(bodies, joints, gravity=(0.0, -G, 0.0), stabilization=SLOW)


def n_four_bar_at(t: np.ndarray, windows: int = 2) -> np.ndarray:
    """Angle of the uprights from the vertical [times]: a pendulum that goes round, by its Jacobi amplitude.

    (n / 3 + w) th'^2 / 2 + g (n / 2 + w) cos th is constant, n = w + 1 uprights and w beams.
    """
    n = windows + 1
    c = G * (n / 2 + windows) / (n / 3 + windows)  # th'' = c sin th; with ps = th - pi: (ps'/2)^2 = E - c sin^2(ps / 2)
    most = math.sqrt(0.25 + c)  # half of the largest rate, at the bottom
    m = c / most**2
    return 2.0 * ellipj(most * t - ellipk(m), m)[3] + math.pi


def bricard(side: float = 0.0) -> mbd.System:
    """A04: five rods of 1 m on edges of a cube, the sixth is the ground; each hinge is across its two rods."""
    corners = [tensor(*x) for x in ((0, 0, 0), (1, 0, 0), (1, -1, 0), (1, -1, 1), (0, -1, 1), (0, 0, 1))]
    ground, bodies = mbd.Ground(), []
    joints, last = [], ground.at()
    for k, (start, end, axis) in enumerate(zip(corners, corners[1:], "yzxyz", strict=False)):
        body, first, tip = rod(f"rod_{k}", start, end, side)
        bodies.append(body)
        joints.append(mbd.Revolute(last, first, axis, name=f"hinge_{k}"))
        last = tip
    joints.append(mbd.Revolute(last, ground.at(0.0, 0.0, 1.0), "x", name="hinge_5"))
    return mbd.System(bodies, joints, gravity=(0.0, -G, 0.0), stabilization=SLOW)


def bricard_at(t: np.ndarray) -> np.ndarray:
    """P1, ..., P5 [times, 5, 3] of the rods, by the one freedom of the closed chain.

    Turned from the cube its hinges take the angles a and b in turns, F = sin a + sin b + sin a sin b = 0. Along that
    curve (a, b)' = sg (-F_b, F_a), T = m(a, b) sg^2 / 2, and sg follows from the energy: sg' = -(m' sg^2 / 2 + V') / m.
    """

    def along(x: Tensor) -> Tensor:
        return torch.stack([-torch.cos(x[1]) * (1 + torch.sin(x[0])), torch.cos(x[0]) * (1 + torch.sin(x[1]))])

    def kinetic(x: Tensor) -> Tensor:
        v = torch.func.jvp(_corners, (x,), (along(x),))[1]
        return ((v[1:] + v[:-1]).square().sum() + v.square()[1:].sum() + v.square()[:-1].sum()) / 6.0

    def potential(x: Tensor) -> Tensor:
        y = _corners(x)[:, 1]
        return 0.5 * G * (y[1:] + y[:-1]).sum()

    def rates(_: float, state: np.ndarray) -> np.ndarray:
        x, speed = torch.from_numpy(state[:2].copy()), state[2]
        way = along(x)
        m, dm = torch.func.jvp(kinetic, (x,), (way,))
        dV = torch.func.jvp(potential, (x,), (way,))[1]
        return np.array([*(speed * way).tolist(), -(0.5 * float(dm) * speed**2 + float(dV)) / float(m)])

    result = solve_ivp(rates, (0.0, t[-1]), [0.0, 0.0, 0.0], "DOP853", t, rtol=1e-11, atol=1e-12)
    return np.stack([_corners(torch.from_numpy(x))[1:].numpy() for x in result.y[:2].T.copy()])


def _corners(angles: Tensor) -> Tensor:
    """P0, ..., P5 [6, 3] of the chain of rods for joint angles (a, b) [rad] from the cube, taken in turns."""
    A, p = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    edges = [tensor(1, 0, 0), tensor(0, -1, 0), tensor(0, 0, 1), tensor(-1, 0, 0), tensor(0, 1, 0)]
    points = [p]
    for k, (edge, axis) in enumerate(zip(edges, (1, 2, 0, 1, 2), strict=True)):
        e, f = ((axis + i) % 3 for i in (1, 2))
        c, s = torch.cos(angles[k % 2]), torch.sin(angles[k % 2])
        one, place = torch.ones(()).double(), (torch.tensor([axis, e, f, e, f]), torch.tensor([axis, e, f, f, e]))
        A = A @ torch.zeros(3, 3, dtype=torch.float64).index_put(place, torch.stack([one, c, c, -s, s]))
        p = p + A @ edge
        points.append(p)
    return torch.stack(points)


TOP_SPIN = (0.0, 150.0, -4.61538)


def heavy_top() -> mbd.System:
    """15 kg at 1 m from a spherical joint, spinning at 150 rad/s about the axis y through both."""
    J = (0.234375, 0.46875, 0.234375)
    top = mbd.RigidBody("top", 15.0, J, center=(0.0, 1.0, 0.0), angular_velocity=TOP_SPIN)
    return mbd.System([top], [mbd.Spherical(mbd.Ground().at(), top.at())], gravity=(0.0, 0.0, -G))


def heavy_top_at(t: np.ndarray) -> np.ndarray:
    """Height u of the center [times]: u'^2 = (al - be u) (1 - u^2) - (b - a u)^2 is a cubic; u by Jacobi's sn."""
    J1, J3, turn = 0.234375 + 15.0, 0.46875, TOP_SPIN[2]
    be, a, b = 2.0 * 15.0 * G / J1, J3 * TOP_SPIN[1] / J1, turn
    u1, u2, u3 = np.sort(np.roots([be, -(turn**2) - a * a, 2.0 * a * b - be, turn**2 - b * b]).real)
    m = (u2 - u1) / (u3 - u1)
    start = 0.0 if abs(u1) < abs(u2) else float(ellipk(m))
    return u1 + (u2 - u1) * ellipj(0.5 * math.sqrt(be * (u3 - u1)) * t + start, m)[0] ** 2
