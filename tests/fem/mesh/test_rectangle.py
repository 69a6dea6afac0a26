"""rectangle(): size, names, symmetry of the diagonals and a small bandwidth."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.refused import refused
from torchmbd.fem.mesh import rectangle


@pytest.mark.parametrize("cells", [(1, 1), (3, 2), (2, 5), (24, 4), (np.int64(2), np.int64(3))])
def test_covers_the_rectangle_facing_up(cells):
    mesh = rectangle(3.0, 0.5, cells)
    assert len(mesh.nodes) == (cells[0] + 1) * (cells[1] + 1)
    assert mesh.areas.sum().item() == pytest.approx(1.5, rel=1e-14)
    assert (mesh.normals[:, 2] == 1.0).all()
    assert_close(mesh.nodes.amax(0), torch.tensor([1.5, 0.25, 0.0], dtype=torch.float64))
    assert_close(mesh.nodes.amin(0), torch.tensor([-1.5, -0.25, 0.0], dtype=torch.float64))


def test_named_nodes_are_where_they_say():
    mesh = rectangle(3.0, 0.5, (4, 2))
    places = {
        "left": [-1.5, 0.0, 0.0],
        "right": [1.5, 0.0, 0.0],
        "bottom": [0.0, -0.25, 0.0],
        "top": [0.0, 0.25, 0.0],
        "center": [0.0, 0.0, 0.0],
        "corner_left_bottom": [-1.5, -0.25, 0.0],
        "corner_right_top": [1.5, 0.25, 0.0],
    }
    for name, place in places.items():
        assert mesh.nodes[mesh.node(name)].tolist() == place
    assert all(mesh.nodes[k, 0] == 1.5 for k in mesh.node_set("right_edge"))
    assert len(mesh.node_set("bottom_edge")) == 5


def test_no_name_without_a_node():
    mesh = rectangle(3.0, 0.5, (3, 1))
    for name in ("left", "bottom", "center"):
        with refused("node", name) as caught:
            mesh.node(name)
        assert "an even number of cells" in caught.value.hint


@pytest.mark.parametrize("cells", [(4, 2), (6, 4), (24, 4)])
@pytest.mark.parametrize("axis", [0, 1])
def test_even_meshes_are_their_own_mirror_image(cells, axis):
    mesh = rectangle(3.0, 0.5, cells, "triangle")
    sign = torch.ones(3, dtype=torch.float64)
    sign[axis] = -1.0
    middles = {tuple(m) for m in mesh.nodes[mesh.triangles].mean(1).round(decimals=9).add(0.0).tolist()}
    mirrored = {tuple(m) for m in (sign * mesh.nodes[mesh.triangles].mean(1)).round(decimals=9).add(0.0).tolist()}
    assert middles == mirrored


@pytest.mark.parametrize("cells", [(4, 2), (6, 4), (24, 4), (2, 2), (2, 8)])
def test_the_center_meets_eight_triangles(cells):
    mesh = rectangle(3.0, 0.5, cells, "triangle")
    assert (mesh.triangles == mesh.node("center")).sum() == 8


@pytest.mark.parametrize("cells", [(20, 3), (3, 20)])
def test_bandwidth_is_that_of_the_short_direction(cells):
    triangles = rectangle(1.0, 1.0, cells, "triangle").triangles
    assert (triangles.amax(1) - triangles.amin(1)).max() == 5


@pytest.mark.parametrize(
    ("arguments", "path"),
    [
        ((0.0, 1.0, (2, 2)), "length"),
        ((1.0, float("nan"), (2, 2)), "width"),
        ((1.0, 1.0, (2, 0)), "cells"),
        ((1.0, 1.0, (2.0, 2)), "cells"),
        ((1.0, 1.0, (2, 2, 2)), "cells"),
        ((1.0, 1.0, (2000, 2000)), "cells"),
    ],
)
def test_bad_input_is_named(arguments, path):
    with refused(path):
        rectangle(*arguments)


def test_quadrilaterals_on_the_same_nodes():
    """Of which it is made by default."""
    mesh, other = rectangle(3.0, 2.0, (3, 4)), rectangle(3.0, 2.0, (3, 4), "triangle")
    assert torch.equal(mesh.nodes, other.nodes)
    assert mesh.node_sets == other.node_sets
    assert mesh.quads.shape == (12, 4)
    assert len(mesh.triangles) == 0
    assert_close(mesh.areas, torch.full((12,), 0.5, dtype=torch.float64))
    assert (mesh.normals[:, 2] == 1.0).all()
    with refused("kind", "quads"):
        rectangle(3.0, 2.0, (3, 4), "quads")
