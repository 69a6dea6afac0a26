"""Pressure on plates and shells: against weight, against sums over the nodes, and bad input."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.fem.elements.plate_cases import moved
from tests.mechanisms import SOFT, laminate, plate, random_state, tensor, turned
from tests.refused import ANY, refused
from torchmbd.fem.elements.quad_shape import gauss
from torchmbd.multibody.equations import equations

GROUND = mbd.Ground()


def door(loaded: bool, gravity: Tensor) -> mbd.System:
    """A soft plate on a hinge, askew, under its weight; or under a pressure of the same size."""
    swing, made_of = turned(0.4, -0.3, 0.6), laminate(ply=SOFT)
    body = plate("door", made_of=made_of, axes=swing)
    hinge = mbd.Revolute(GROUND.at(*(swing @ tensor(-0.15, 0.0, 0.0)).tolist(), axes=swing), body.at("left"), axis="y")
    weight = float(made_of.mass_per_area * gravity.norm())
    forces = [mbd.Pressure(body, weight, direction=gravity)] if loaded else []
    return mbd.System([body], [hinge], forces, gravity=None if loaded else gravity)


@pytest.mark.thorough
def test_a_load_of_fixed_direction_is_weight():
    gravity = tensor(3.0, -4.0, 8.0)
    one, other = (mbd.simulate(door(loaded, gravity), 0.05, steps=50).require_ok() for loaded in (True, False))
    assert float(other.body("door").strain_energy.max()) > 1e-4
    assert_close(one.q, other.q, rtol=0, atol=1e-10)
    energies = one.energies
    assert float(energies.balance.abs().max()) < 5e-3 * float(energies.kinetic.max())


def shell(kind: str = "triangle") -> mbd.FlexibleBody:
    """A roof bent about x, turned past the vertical on one side: components of both signs."""
    flat = mbd.mesh.rectangle(length=0.3, width=0.2, cells=(4, 6), kind=kind)
    x, y, _ = flat.nodes.T
    angle = 16.0 * y
    nodes = torch.stack([x, 0.08 * torch.sin(angle), 0.08 * torch.cos(angle) + 0.2 * x], 1)
    return mbd.FlexibleBody.plate("roof", moved(flat, nodes), laminate(), modes=4)


def corner_areas(p: torch.Tensor) -> Tensor:
    """Directed areas of the corners of a cell: thirds, or the integral of the bilinear shape functions by Gauss points."""
    if len(p) == 3:
        return torch.linalg.cross(p[1] - p[0], p[2] - p[0]).expand(3, 3) / 6.0
    points = gauss(p[None, :, :2])
    natural = torch.einsum("pac,pci->pai", points.jacobian[0], points.slopes[0])
    tangents = natural @ p
    return points.shape.T @ torch.linalg.cross(tangents[:, 0], tangents[:, 1])


@pytest.mark.parametrize("kind", ["triangle", "quad"])
def test_a_following_load_is_a_sum_over_the_nodes(kind):
    """Of the undeformed shell, the frame anywhere: forces and moments on the body, and on its modes."""
    body, p = shell(kind), 7.0
    system = mbd.System([body], forces=[mbd.Pressure(body, lambda t: p + t)])
    T, data = system.topology, system("data")
    q, v, _ = random_state(system, 3, bend=0.0)
    at = equations.placement(T, data, q, T.prescribed(tensor(0.5)[0]))
    result = equations.generalized_forces(T, data, at, equations.applied_on_vectors(T, data, at, v))
    nodes = body.mesh.nodes - body.origin
    forces = torch.zeros_like(nodes)
    for corners in body.mesh.cells[kind]:
        forces[corners] += (p + 0.5) * corner_areas(nodes[corners])
    psi = body.structure()["psi"].detach()
    A = at.A[:, :, 0, 0, 0]
    assert_close(result[0][:, 0, 0, 0], A @ forces.sum(0), rtol=0, atol=1e-11)
    assert_close(result[1][:, 0, 0, 0], torch.linalg.cross(nodes, forces).sum(0), rtol=0, atol=1e-11)
    expected = torch.einsum("nk,nkm->m", forces, psi[:, :3])
    assert_close(result[2][:, 0, 0, 0], expected, rtol=0, atol=1e-10 * float(expected.abs().max()))


@pytest.mark.thorough
def test_a_closed_form():
    """A clamped strip of an isotropic material without contraction under p: it bends by p L^4 / (8 D) at its end."""
    E, h, L, p = 7e9, 2e-3, 0.4, 3.0
    ply = mbd.Ply(E1=E, E2=E, G12=E / 2, G13=E / 2, G23=E / 2, nu12=0.0, density=2000.0)
    mesh = mbd.mesh.rectangle(length=L, width=0.05, cells=(16, 2))
    body = mbd.FlexibleBody.plate("strip", mesh, mbd.Laminate(ply, (0.0,), h), modes=4, reference="left_edge")
    system = mbd.System([body], [mbd.Fixed(GROUND.at(-L / 2, 0, 0), body.at("left"))], [mbd.Pressure(body, p)])
    result = mbd.equilibrium(system)
    w = result.body("strip").w[0, 0]
    tip = float(body.structure()["psi"].detach()[mesh.node("right"), 2] @ w)
    assert tip == pytest.approx(p * L**4 / (8.0 * E * h**3 / 12.0), rel=5e-3)


def test_bad_pressures_are_named():
    body = plate("panel")
    box = mbd.RigidBody("box", 1.0, (1.0, 1.0, 1.0))
    assert len(mbd.Pressure(body, 1.0, direction=(3.0, -4.0, 0.0)).parts) == 2  # along two axes of one body
    wrong: list[tuple[Any, tuple[Any, ...]]] = [
        (lambda: mbd.Pressure(box, 1.0), ("body", ANY, "Pressure acts on")),
        (lambda: mbd.Pressure(body, float("nan")), ("pressure_panel.pressure", math.nan)),
        (lambda: mbd.Pressure(body, 1.0, direction=(0, 0, 0)), ("direction", (0, 0, 0), "not all zero")),
        (lambda: mbd.Pressure(body, 1.0, direction=(0, 1)), ("direction", (0, 1))),
        (
            lambda: mbd.System([box], forces=[mbd.Pressure(body, 1.0)], free=["box"]),
            ("forces.pressure_panel", ANY, "'panel'", "not among"),
        ),
    ]
    for make, said in wrong:
        with refused(*said):
            make()


@pytest.mark.thorough
@pytest.mark.parametrize("load", [-200.0, 200.0])
def test_a_load_along_a_stiffened_plate_is_a_weight(load):
    """[Pa], of both signs: a clamped strip that hangs or stands has the frequencies of one under gravity."""
    ply, mesh = mbd.Ply.isotropic(E=70e9, nu=0.3, density=2700.0), mbd.mesh.rectangle(0.5, 0.05, (6, 1))
    options: dict = {"modes": 4, "reference": "left_edge", "stiffening": True}
    body = mbd.FlexibleBody.plate("strip", mesh, mbd.Laminate(ply, [0.0], [1e-3]), **options)

    def frequencies(gravity: float, *forces: mbd.Pressure) -> Tensor:
        wall = mbd.Fixed(mbd.Ground().at(-0.25, 0.0, 0.0), body.at("left_edge"))
        system = mbd.System([body], [wall], list(forces), gravity=(gravity, 0.0, 0.0), truncation=None)
        return mbd.equilibrium(system).vibrations[0].frequencies

    pushed = frequencies(0.0, mbd.Pressure(body, abs(load), direction=(load, 0.0, 0.0)))
    assert_close(pushed, frequencies(load / 2.7), rtol=1e-8, atol=0.0)
    assert abs(float(pushed[0] / frequencies(0.0)[0]) - 1.0) > 0.2


@pytest.mark.thorough
@pytest.mark.parametrize("direction", [None, (0.0, 0.0, -1.0)])
def test_a_finer_mesh_has_a_finer_load(direction):
    """The error by the mesh against four times the cells: a load that stays at the coarse nodes makes it twice as large."""
    response = mbd.Integral(mbd.Displacement("strip", "z", node="right"))

    def motion(times: int) -> mbd.Trajectory:
        mesh = mbd.mesh.rectangle(0.4, 0.05, cells=(4 * times, 2 * times))
        made_of = mbd.Laminate(mbd.examples.carbon(), mbd.deg([30.0, -30.0]), thickness=1e-3)
        body = mbd.FlexibleBody.plate("strip", mesh, made_of, modes=3, reference="left_edge", damping=1e-3)
        wall = mbd.Fixed(GROUND.at(), body.at("left"))
        load = mbd.Pressure(body, mbd.variable(10.0), direction=direction)
        system = mbd.System([body], [wall], [load], truncation=None)
        return mbd.simulate(system, 0.02, steps=100, gradients="none", backend="eager")

    coarse = motion(1)
    error = coarse.error_of(response, modes=False)
    assert error.by_mesh is not None
    assert 0.7 < (error.by_mesh / (response(motion(4)) - error.value)).item() < 1.3
