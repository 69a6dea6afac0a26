"""Facets: local axes are right-handed, follow the material direction, and keep lengths."""

import pytest
import torch
from torch.testing import assert_close

from tests.fem.elements.plate_cases import irregular, rotation, turned
from torchmbd.errors import InputError
from torchmbd.fem.elements.facet import facets
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
    with pytest.raises(InputError, match=r"no projection into triangle [01]"):
        facets(Mesh(nodes, [[0, 1, 3], [1, 2, 3]]), direction)


def test_shape_of_the_direction():
    with pytest.raises(InputError, match=r"shape \(2, 3\)"):
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
