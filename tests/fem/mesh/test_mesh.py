"""Mesh: geometry of known triangles, named nodes, and every kind of bad input refused by element or node."""

import math
import pickle

import pytest
import torch
from torch.testing import assert_close

from tests.refused import ANY, refused
from torchmbd.errors import InputError
from torchmbd.fem.mesh import Mesh, directed_area, rectangle

SQUARE = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]]
HALVES = [[0, 1, 2], [0, 2, 3]]


def test_areas_and_normals_in_space():
    s = math.sqrt(0.5)
    mesh = Mesh(torch.tensor([[0, 0, 0], [2, 0, 0], [0, s, s]]), torch.tensor([[0, 1, 2]]))
    assert mesh.areas.item() == pytest.approx(1.0, rel=1e-7)
    assert_close(mesh.normals, torch.tensor([[0.0, -s, s]], dtype=torch.float64), rtol=1e-7, atol=1e-12)
    assert mesh.nodes.dtype == torch.float64


def test_named_nodes_and_sets():
    mesh = Mesh(SQUARE, HALVES, {"origin": [0], "left": [0, 3]})
    assert mesh.node("origin") == 0
    assert mesh.node_set("left") == (0, 3)
    with pytest.raises(InputError) as error:
        mesh.node("orign")
    assert (error.value.path, error.value.value) == (("node",), "orign")
    assert "origin" in error.value.allowed
    with refused("node", "left"):
        mesh.node("left")


def test_the_mesh_keeps_its_own_copy():
    nodes = torch.tensor(SQUARE, dtype=torch.float64)
    mesh = Mesh(nodes, HALVES)
    nodes[0, 0] = 9.0
    assert mesh.nodes[0, 0] == 0.0


def test_a_mesh_travels_to_another_process():
    mesh = pickle.loads(pickle.dumps(Mesh(SQUARE, HALVES, {"origin": [0]})))
    assert mesh.node("origin") == 0
    assert torch.equal(mesh.triangles, torch.tensor(HALVES))


@pytest.mark.parametrize(
    ("nodes", "triangles", "fault"),
    [
        ([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], [[0, 1, 2]], ("nodes", ANY, "(3, 2)")),
        ([*SQUARE[:3], [0.0, math.nan, 0.0]], HALVES, ("nodes.3",)),
        ([*SQUARE, SQUARE[1]], [[0, 1, 2], [0, 2, 3], [4, 2, 3]], ("nodes.4", ANY, "node 1 and node 4", "one place")),
        (
            [*SQUARE, [1.0, 1e-8, 0.0]],
            [[0, 1, 2], [0, 2, 3], [4, 2, 3]],
            ("nodes.4", ANY, "node 1 and node 4", "one place"),
        ),
        (SQUARE, [[0, 1, 2], [0, 2, 4]], ("cells.1", [0, 2, 4])),
        (SQUARE, [[0, 1, 2, 3]], ("triangles", ANY, "(1, 4)")),
        (SQUARE, [*HALVES, [2, 0, 1]], ("cells.2", ANY, "triangle 0 and triangle 2", "duplicates")),
        (SQUARE, [[0, 1, 2], [0, 2, 2]], ("cells.1", [0, 2, 2])),
        ([*SQUARE, [0.5, 1e-9, 0.0]], [*HALVES, [0, 1, 4]], ("cells.2", [0, 1, 4])),
        (SQUARE, [[0, 1, 2]], ("nodes", ANY, "node 3")),
        (SQUARE, [[0, 1, 2], [0, 3, 2]], ("cells.1", ANY, "triangle 0", "triangle 1", "opposite")),
        (
            [*SQUARE, [5.0, 0, 0], [6.0, 0, 0], [5.0, 1, 0]],
            [*HALVES, [4, 5, 6]],
            ("elements", ANY, "2 disconnected", "node 4"),
        ),
    ],
)
def test_bad_mesh_is_refused_by_name(nodes, triangles, fault):
    with refused(*fault):
        Mesh(nodes, triangles)


def test_node_set_outside_of_the_mesh():
    with refused("node_sets.tip", 4):
        Mesh(SQUARE, HALVES, {"tip": [4]})


def test_three_plates_may_meet_at_an_edge():
    """A stiffener: no winding is right for all three neighbours of the common edge."""
    mesh = Mesh([*SQUARE, [0.5, 0.5, 1.0]], [*HALVES, [0, 2, 4]])
    assert len(mesh.triangles) == 3


def test_lines_connect_and_are_checked():
    """A node that only a line reaches is no orphan; a line may be all there is."""
    mesh = Mesh([*SQUARE, [2.0, 2.0, 0.0]], HALVES, lines=[[2, 4]])
    assert mesh.lines.tolist() == [[2, 4]]
    assert len(Mesh(SQUARE[:2], torch.empty(0, 3), lines=[[0, 1]]).triangles) == 0
    with refused("lines.0"):
        Mesh(SQUARE, HALVES, lines=[[2, 9]])
    twin = Mesh([*SQUARE, SQUARE[1]], HALVES, lines=[[1, 4]])  # a rigid link between two nodes of one place
    assert len(twin.nodes) == 5


def test_messages_use_the_labels():
    labels = {"node_labels": [f"GRID {k}" for k in (7, 8, 9, 10)], "cell_labels": ["CTRIA3 1", "CTRIA3 2"]}
    with refused("cells.1", ANY, "CTRIA3 1", "CTRIA3 2", "opposite"):
        Mesh(SQUARE, [[0, 1, 2], [0, 3, 2]], **labels)
    with refused("nodes"):
        Mesh(SQUARE, [[0, 1, 2]], **labels)


def test_of_many_names_the_nearest_are_shown():
    many = {f"grid_{k}": [k % 4] for k in range(500)}
    with refused("node", "gird_77", meant="grid_77") as error:
        Mesh(SQUARE, HALVES, many).node("gird_77")
    assert len(str(error.value)) < 300


def test_a_patch_of_nodes():
    mesh = rectangle(0.4, 0.2, (8, 4))
    patch = mesh.within(0.051)
    assert sorted(patch) == sorted(k for k, x in enumerate(mesh.nodes.tolist()) if x[0] ** 2 + x[1] ** 2 < 0.0026)
    assert len(patch) == 5
    assert mesh.within(0.01, (0.2, 0.1, 0.0)) == mesh.node_set("corner_right_top")
    with refused("radius", 0.0):
        mesh.within(0.0)
    with refused("radius", 0.01):
        mesh.within(0.01, [1.0, 0.0, 0.0])


def test_quadrilaterals_are_counted_after_the_triangles():
    """Area and normal of a warped one are those of its mean plane; its pieces cover it twice, each by half."""
    nodes = torch.tensor([[0, 0, 0.1], [1, 0, -0.1], [1, 1, 0.1], [0, 1, -0.1], [2, 0, 0.1]], dtype=torch.float64)
    mesh = Mesh(nodes, [[1, 4, 2]], quads=[[0, 1, 2, 3]])
    assert (mesh.cell_count, mesh.cell_name(0), mesh.cell_name(1)) == (2, "triangle 0", "quad 0")
    assert repr(mesh) == "Mesh(5 nodes, 1 triangles, 1 quadrilaterals, 0 lines)"
    assert_close(mesh.directed_areas[1], torch.tensor([0.0, 0, 1], dtype=torch.float64))
    assert mesh.areas[1].item() == pytest.approx(1.0)
    nodes, share, cell = mesh.covering_triangles
    assert_close(share, torch.tensor([1.0, 0.5, 0.5, 0.5, 0.5], dtype=torch.float64))
    assert cell.tolist() == [0, 1, 1, 1, 1]
    covered = (share[:, None] * directed_area(mesh.nodes[nodes]))[1:].sum(0)
    assert_close(covered, mesh.directed_areas[1])
    assert len(pickle.loads(pickle.dumps(mesh)).quads) == 1


@pytest.mark.parametrize(
    ("nodes", "quads", "fault"),
    [
        (SQUARE, [[0, 1, 2, 4]], ("cells.0", [0, 1, 2, 4])),
        (SQUARE, [[0, 1, 2]], ("quads", ANY, "(1, 3)")),
        (SQUARE, [[0, 1, 2, 3], [1, 2, 3, 0]], ("cells.1", ANY, "quad 0 and quad 1", "duplicates")),
        (SQUARE, [[0, 1, 3, 2]], ("cells.0", [0, 1, 3, 2], "collapsed")),
        (
            [*SQUARE[:2], [0.3, 0.3, 0.0], SQUARE[3]],
            [[0, 1, 2, 3]],
            ("cells.0", ANY, "collapsed"),
        ),
        ([*SQUARE[:3], [0.5, 0.0, 0.0]], [[3, 1, 2, 0]], ("cells.0", ANY, "collapsed")),
        ([*SQUARE[:3], [0.0, 1.0, 2.0]], [[0, 1, 2, 3]], ("cells.0", ANY, "40 degrees")),
        (
            [*SQUARE, [2.0, 0, 0], [2.0, 1, 0]],
            [[0, 1, 2, 3], [1, 2, 5, 4]],
            ("cells.1", ANY, "quad 0", "quad 1", "opposite"),
        ),
    ],
)
def test_bad_quadrilaterals_are_refused_by_name(nodes, quads, fault):
    with refused(*fault):
        Mesh(nodes, quads=quads)


def test_a_mesh_of_nothing_is_refused():
    with refused("triangles"):
        Mesh(SQUARE)
