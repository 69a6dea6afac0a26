"""Facets: local axes are right-handed, follow the material direction, and keep lengths.

Normals of the smooth shell: exact on a plate, of second order on a sphere, and not across a fold.
"""

import math

import pytest
import torch
from torch.testing import assert_close

from tests.fem.elements.plate_cases import irregular, mapped, rotation, turned
from tests.refused import refused
from torchmbd.fem.elements.facet import corner_normals, facets
from torchmbd.fem.mesh import Mesh, rectangle


def test_axes_are_rotations_along_the_direction():
    mesh = turned(irregular(2.0, 1.0, (3, 2)), rotation(1))
    direction = torch.tensor([0.4, -1.0, 0.7], dtype=torch.float64)
    plane = facets(mesh, direction)
    assert_close(plane.axes @ plane.axes.mT, torch.eye(3, dtype=torch.float64).expand(12, 3, 3))
    assert (torch.linalg.det(plane.axes) > 0).all()
    assert_close(plane.axes[:, 2], mesh.normals)
    assert ((plane.axes[:, 0] @ direction) > 0).all()
    assert (abs(plane.axes[:, 1] @ direction) < 1e-14).all()


def test_corners_keep_lengths_and_area():
    mesh = turned(irregular(2.0, 1.0, (3, 2)), rotation(2))
    plane = facets(mesh, (1.0, 0.2, 0.3))
    p, c = mesh.nodes[mesh.triangles], plane.corners
    assert_close((c - c.roll(1, 1)).norm(dim=2), (p - p.roll(1, 1)).norm(dim=2))
    assert_close(c.mean(1), torch.zeros(12, 2, dtype=torch.float64), rtol=0, atol=1e-15)
    assert_close(plane.area, mesh.areas)


def test_one_direction_for_each_cell():
    mesh = rectangle(1.0, 1.0, (1, 1), "triangle")
    plane = facets(mesh, torch.tensor([[1.0, 0, 0], [0, 2.0, 5.0]]))
    assert_close(plane.axes[1, 0], torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))


@pytest.mark.parametrize("direction", [(0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (float("nan"), 0.0, 0.0)])
def test_direction_without_projection_is_refused(direction):
    nodes = [[0.0, 0, 0], [1.0, 0, 0], [1.0, 1, 1], [0.0, 1, 0]]
    with refused("direction"):
        facets(Mesh(nodes, [[0, 1, 3], [1, 2, 3]]), direction)


def test_shape_of_the_direction():
    with refused("direction"):
        facets(rectangle(1.0, 1.0, (2, 2), "triangle"), torch.ones(2, 3))


def test_cells_are_what_lies_at_a_side():
    """Two triangles inside, one at an edge, three where plates branch; also for some triangles of a mesh."""
    nodes = torch.tensor([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, -4, 0], [0, 0, 6]], dtype=torch.float64)
    mesh = Mesh(nodes, [[0, 1, 2], [0, 3, 1], [0, 1, 4]])
    expected = torch.tensor([[2.0, 1.0, 1.0], [2.0, 2.0, 2.0], [2.0, 3.0, 3.0]], dtype=torch.float64)
    assert_close(facets(mesh).side_area, expected)
    assert_close(facets(mesh, (1.0, 0.0, 0.0), torch.tensor([2])).side_area, expected[2:])


def test_a_warped_quadrilateral_lies_on_its_mean_plane():
    nodes = torch.tensor([[0, 0, 0.1], [2, 0, -0.1], [2, 1, 0.1], [0, 1, -0.1], [3, 0, -0.1]], dtype=torch.float64)
    mesh = turned(Mesh(nodes, [[1, 4, 2]], quads=[[0, 1, 2, 3]]), rotation(4))
    plane = facets(mesh, rotation(4)[:, 0], kind="quad")
    assert_close(plane.height, torch.tensor([[0.1, -0.1, 0.1, -0.1]], dtype=torch.float64))
    expected = torch.tensor([[[-1, -0.5], [1, -0.5], [1, 0.5], [-1, 0.5]]], dtype=torch.float64)
    assert_close(plane.corners, expected)
    assert plane.mixed.tolist() == [[False, True, False, False]]
    other = facets(mesh, rotation(4)[:, 0], kind="triangle")
    assert other.mixed.tolist() == [[False, False, True]]
    assert_close(plane.side_area[0, 1], (mesh.areas[0] + mesh.areas[1]) / 2)
    assert_close(plane.side_area[0, 1], other.side_area[0, 2])


def sphere(n):
    def place(s, t):
        a, b = 0.2 + 0.8 * s, 0.3 + 0.9 * t
        return math.cos(a) * math.cos(b), math.sin(a) * math.cos(b), math.sin(b)

    return mapped((n, n), place)


def test_a_plate_has_one_normal():
    mesh = turned(irregular(1.0, 0.5, (4, 3)), rotation(3))
    assert_close(corner_normals(mesh)["triangle"], mesh.normals[:, None].expand(-1, 3, 3), rtol=0, atol=1e-14)


def test_inside_a_sphere_they_point_along_the_radius():
    """The error falls with the square of the mesh size at inner nodes."""
    errors = []
    for n in (6, 12):
        mesh = sphere(n)
        x = mesh.nodes[mesh.triangles]
        sign = (mesh.normals[0] @ x[0, 0]).sign()
        inner = (mesh.node_set("left_edge") + mesh.node_set("right_edge")) + (
            mesh.node_set("top_edge") + mesh.node_set("bottom_edge")
        )
        away = ~torch.isin(mesh.triangles, torch.tensor(inner))
        errors.append(float((corner_normals(mesh)["triangle"] - sign * x).norm(dim=2)[away].max()))
    assert errors[1] < 2e-3
    assert math.log2(errors[0] / errors[1]) > 1.5


def test_a_fold_stays_a_fold():
    """Two plates at a right angle keep their normals; at 20 degrees they share one."""
    for angle, shared in ((90.0, False), (20.0, True)):
        a = math.radians(angle)
        nodes = [[0, 0, 0], [0, 1, 0], [-1, 0, 0], [math.cos(a), 0, math.sin(a)]]
        mesh = Mesh(torch.tensor(nodes, dtype=torch.float64), [[0, 1, 2], [1, 0, 3]])
        result = corner_normals(mesh)["triangle"]
        assert (float((result[0, 0] - mesh.normals[0]).norm()) > 0.1) == shared
        assert_close(result[0, 2], mesh.normals[0])
        if shared:
            assert_close(result[0, 0], result[1, 1])


def test_a_wall_on_a_bent_plate_does_not_count():
    """Where three facets meet at an edge, the normal of the smooth two is their mean, as without the wall."""
    bend, wall = math.radians(20.0), math.radians(100.0)
    nodes = [[0, 0, 0], [0, 1, 0], [-1, 0, 0], *([math.cos(a), 0, math.sin(a)] for a in (bend, wall))]
    mesh = Mesh(torch.tensor(nodes, dtype=torch.float64), [[0, 1, 2], [1, 0, 3], [1, 0, 4]])
    result, mean = corner_normals(mesh)["triangle"], mesh.normals[0] + mesh.normals[1]
    for facet, corner in ((0, 0), (1, 1)):
        assert_close(result[facet, corner], mean / mean.norm(), rtol=0, atol=1e-14)
    assert_close(result[2], mesh.normals[2].expand(3, 3), rtol=0, atol=1e-14)
