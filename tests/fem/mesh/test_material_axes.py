"""Material directions around a cylinder with a rib across it, along a curve, and in a coordinate system."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from torchmbd.errors import InputError

RADIUS, COUNT = 0.5, 12


def cylinder() -> mbd.Mesh:
    """A closed tube about z, two rings of cells, and in it a rib in the plane y = 0 whose normal is around the axis."""
    angle = 2.0 * math.pi * torch.arange(COUNT, dtype=torch.float64) / COUNT
    rings = [
        torch.stack([RADIUS * angle.cos(), RADIUS * angle.sin(), torch.full_like(angle, z)], 1) for z in (0.0, 0.2, 0.4)
    ]
    middle = torch.tensor([[0.2, 0.0, 0.0], [0.2, 0.0, 0.2]], dtype=torch.float64)
    quads = [
        [row * COUNT + k, row * COUNT + (k + 1) % COUNT, (row + 1) * COUNT + (k + 1) % COUNT, (row + 1) * COUNT + k]
        for row in range(2)
        for k in range(COUNT)
    ]
    rib = [3 * COUNT, 0, COUNT, 3 * COUNT + 1]
    return mbd.Mesh(torch.cat([*rings, middle]), quads=torch.tensor([*quads, rib]))


def centers(mesh: mbd.Mesh) -> Tensor:
    return mesh.nodes[mesh.quads].mean(1)


def test_around_a_cylinder_and_along_it_in_a_rib():
    mesh = cylinder()
    d, x = mbd.mesh.around((0.0, 0.0, 2.0)).of_cells(mesh), centers(mesh)
    expected = torch.stack([-x[:, 1], x[:, 0], 0.0 * x[:, 0]], 1)
    expected = expected / expected.norm(dim=1, keepdim=True)
    expected[-1] = torch.tensor([0.0, 0.0, 1.0])  # the rib is normal to it
    assert_close(d, expected, rtol=0, atol=1e-12)


def test_the_rule_turns_and_moves_with_the_mesh():
    """No direction depends on the place or the orientation of the whole in space."""
    mesh, c = cylinder(), math.cos(0.7)
    A = torch.tensor([[c, 0.0, math.sin(0.7)], [0.0, 1.0, 0.0], [-math.sin(0.7), 0.0, c]], dtype=torch.float64)
    shift = torch.tensor([3.0, -2.0, 1e3], dtype=torch.float64)
    moved = mbd.Mesh(mesh.nodes @ A.mT + shift, quads=mesh.quads)
    d = mbd.mesh.around((0.0, 0.0, 1.0)).of_cells(mesh)
    assert_close(mbd.mesh.around(A[:, 2], shift).of_cells(moved), d @ A.mT, rtol=0, atol=1e-9)


@pytest.mark.thorough
def test_plates_take_a_rule_as_the_directions_that_it_gives():
    mesh, rule = cylinder(), mbd.mesh.around((0.0, 0.0, 1.0))
    laminate = mbd.Laminate(mbd.examples.carbon(), [0.3, -0.1], thickness=1e-3)
    of_rule, of_cells = (
        mbd.FlexibleBody.plate("a", mesh, laminate, modes=1, direction=d) for d in (rule, rule.of_cells(mesh))
    )
    assert_close(of_rule.assembly.stiffness().values, of_cells.assembly.stiffness().values, rtol=0, atol=0)


def test_along_a_curve():
    mesh = mbd.mesh.rectangle(1.0, 0.2, (10, 2))
    x = torch.linspace(-0.5, 0.5, 41, dtype=torch.float64)
    curve = torch.stack([x, x**2, 0.0 * x], 1)
    d = mbd.mesh.along(curve).of_cells(mesh)
    place = centers(mesh)
    slope = 2.0 * place[:, 0]
    near = (place[:, 1] - place[:, 0] ** 2).abs() < 0.1
    assert_close((d[:, 1] / d[:, 0])[near], slope[near], rtol=0, atol=0.12)


def test_axes_of_systems():
    mesh = cylinder()
    radial = mbd.mesh.in_system(torch.eye(3).double(), kind="cylindrical").of_cells(mesh)
    assert_close(radial[:-1], mbd.mesh.around((0.0, 0.0, 1.0)).of_cells(mesh)[:-1], rtol=0, atol=1e-12)  # r is normal
    assert_close(radial[-1], torch.tensor([1.0, 0.0, 0.0]).double(), rtol=0, atol=1e-12)
    axial = mbd.mesh.in_system(torch.eye(3).double(), kind="cylindrical", axis="z").of_cells(mesh)
    assert_close(axial, torch.tensor([0.0, 0.0, 1.0]).double().expand_as(axial), rtol=0, atol=0)


@pytest.mark.parametrize(
    ("rule", "text"),
    [
        (lambda: mbd.mesh.around((0.0, 0.0, 0.0)), "axis = (0.0, 0.0, 0.0): must be"),
        (lambda: mbd.mesh.along([[0.0, 0.0, 0.0]]), "points of a curve have shape (1, 3): must have shape [k, 3]"),
        (lambda: mbd.mesh.in_system([[1.0, 0, 0], [0, 2.0, 0], [0, 0, 1.0]]), "must be three orthonormal columns"),
        (lambda: mbd.mesh.in_system(torch.eye(3).double(), axis="r"), "'r'"),
    ],
)
def test_bad_rules_are_refused(rule, text):
    with pytest.raises(InputError) as error:
        rule()
    assert text in str(error.value)
