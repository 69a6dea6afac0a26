"""A mechanism with closed loops, here and in Exudyn: twelve flexible laminated links are the edges of a cube of hubs.

Every link has a spherical joint to the hub at each of its ends: 24 joints, and six freedoms of the hubs against each other
beside those of the whole. Diagonals of the faces and four legs are springs with dampers; a linear controller reads place and
velocity of one hub and pushes it towards a point. The cube is released under gravity.

Exudyn has its own items for all of it, the controller as a spring and damper in Cartesian coordinates, and hubs as points.
Checked in tests/experiments/test_benchmark.py.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import product

import numpy as np
import torch
from torch import Tensor, nn

import torchmbd as mbd
from experiments.peers.exudyn_peer import Model, ReducedBody, Run, reduced
from torchmbd.examples import slider_crank

EDGE, WIDTH, LEG, HUB = 0.3, 0.03, 0.1, 0.2  # [m], of a hub [kg]
GRAVITY = 9.81  # along -y
STIFFNESS, DAMPING = 2e3, 2.0  # of a spring
GAIN, RATE, SHIFT = 4e3, 8.0, (0.01, 0.02, -0.01)  # of the controller, and where it pushes its hub
CORNERS: tuple[tuple[int, ...], ...] = tuple(product((0, 1), repeat=3))
HELD = (1, 1, 1)


def _edges() -> list[tuple[tuple[int, ...], tuple[int, ...], int]]:
    """Corners and axis of each link."""
    edges = []
    for axis in range(3):
        for a in CORNERS:
            if not a[axis]:
                edges.append((a, (*a[:axis], 1, *a[axis + 1 :]), axis))
    return edges


def _springs() -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """One diagonal of each face."""
    pairs = []
    for axis in range(3):
        for side in (0, 1):
            a, b = [0, 0, 0], [1, 1, 1]
            a[axis] = b[axis] = side
            pairs.append((tuple(a), tuple(b)))
    return pairs


def _place(corner: tuple[int, ...]) -> np.ndarray:
    return EDGE * np.array(corner, dtype=float)


def build(modes: int = 8, cells: tuple[int, int] = (16, 2)) -> mbd.System:
    """The system; its links are link0 to link11."""
    ply, ground = mbd.Ply(**slider_crank.CARBON), mbd.Ground()
    hubs, bodies, joints = {}, [], []
    for corner in CORNERS:
        name = "hub" + "".join(map(str, corner))
        hubs[corner] = mbd.RigidBody(name, mass=HUB, inertia=(1e-4, 1e-4, 1e-4), position=tuple(_place(corner)))
    for i, (a, b, axis) in enumerate(_edges()):
        laminate = mbd.Laminate(ply, angles=mbd.deg([45, -45, 45]), thickness=1e-3)
        mesh = mbd.mesh.rectangle(length=EDGE, width=WIDTH, cells=cells)
        axes = torch.eye(3, dtype=torch.float64).roll(axis, 0)
        middle = tuple(0.5 * (_place(a) + _place(b)))
        body = mbd.FlexibleBody.plate(f"link{i}", mesh, laminate, modes=modes, position=middle, axes=axes)
        bodies.append(body)
        joints += [mbd.Spherical(hubs[a].at(), body.at("left")), mbd.Spherical(body.at("right"), hubs[b].at())]
    forces: list = [
        mbd.SpringDamper(hubs[a].at(), hubs[b].at(), stiffness=STIFFNESS, damping=DAMPING, rest=EDGE * 2**0.5)
        for a, b in _springs()
    ]
    for corner in CORNERS:
        if not corner[1]:
            foot = ground.at(*(_place(corner) - np.array([0.0, LEG, 0.0])))
            forces.append(mbd.SpringDamper(foot, hubs[corner].at(), stiffness=STIFFNESS, damping=DAMPING, rest=LEG))
    forces.append(_controller(hubs[HELD]))
    return mbd.System([*bodies, *hubs.values()], joints, forces, gravity=(0.0, -GRAVITY, 0.0))


def _controller(hub: mbd.RigidBody) -> mbd.Controller:
    """u = GAIN (goal - p) - RATE p'."""
    law = nn.Linear(6, 3, dtype=torch.float64).requires_grad_(False)
    eye = torch.eye(3, dtype=torch.float64)
    law.weight.copy_(torch.cat([-GAIN * eye, -RATE * eye], 1))
    law.bias.copy_(GAIN * torch.from_numpy(_place(HELD) + np.array(SHIFT)))
    at = hub.at()
    inputs = [mbd.signals.PointPosition(at), mbd.signals.PointVelocity(at)]
    return mbd.Controller(law, inputs, [mbd.signals.ForceOn(at, axis) for axis in "xyz"])


def peer(system: mbd.System, designs: Mapping[str, Tensor]) -> list[Callable[[float, int], Run]]:
    """Simulations (duration, steps) -> Run of a batch of designs in Exudyn."""
    edges = _edges()
    links = [reduced(system, f"link{i}", designs) for i in range(len(edges))]
    lanes = max(len(lane) for lane in links)
    mesh = system.body("link0").mesh
    left, right = mesh.node("left"), mesh.node("right")

    def run(links: list[ReducedBody], duration: float, steps: int) -> Run:
        model = Model(GRAVITY)
        hubs = {corner: model.point(model.mass(HUB, _place(corner))) for corner in CORNERS}
        for link, (a, b, _) in zip(links, edges, strict=True):
            number = model.flexible(link, _place(a) - link.axes @ link.nodes[left])
            model.spherical(hubs[a], model.node(number, left))
            model.spherical(model.node(number, right), hubs[b])
        for a, b in _springs():
            model.spring(hubs[a], hubs[b], STIFFNESS, DAMPING, EDGE * 2**0.5)
        for corner in CORNERS:
            if not corner[1]:
                foot = model.point(model.ground, _place(corner) - np.array([0.0, LEG, 0.0]))
                model.spring(foot, hubs[corner], STIFFNESS, DAMPING, LEG)
        model.hold(hubs[HELD], _place(HELD) + np.array(SHIFT), GAIN, RATE)
        return model.solve(duration, steps)

    each = [[lane[min(i, len(lane) - 1)] for lane in links] for i in range(lanes)]
    return [lambda duration, steps, links=links: run(links, duration, steps) for links in each]
