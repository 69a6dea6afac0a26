"""Normals of the smooth shell: exact on a plate, of second order on a sphere, and not across a fold."""

import math

import torch
from torch.testing import assert_close

from tests.fem.elements.plate_cases import irregular, mapped, rotation, turned
from torchmbd.fem.elements.shell_normals import corner_normals
from torchmbd.fem.mesh import Mesh


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
        found = corner_normals(mesh)["triangle"]
        assert (float((found[0, 0] - mesh.normals[0]).norm()) > 0.1) == shared
        assert_close(found[0, 2], mesh.normals[0])
        if shared:
            assert_close(found[0, 0], found[1, 1])


def test_a_wall_on_a_bent_plate_does_not_count():
    """Where three facets meet at an edge, the normal of the smooth two is their mean, as without the wall."""
    bend, wall = math.radians(20.0), math.radians(100.0)
    nodes = [[0, 0, 0], [0, 1, 0], [-1, 0, 0], *([math.cos(a), 0, math.sin(a)] for a in (bend, wall))]
    mesh = Mesh(torch.tensor(nodes, dtype=torch.float64), [[0, 1, 2], [1, 0, 3], [1, 0, 4]])
    found, mean = corner_normals(mesh)["triangle"], mesh.normals[0] + mesh.normals[1]
    for facet, corner in ((0, 0), (1, 1)):
        assert_close(found[facet, corner], mean / mean.norm(), rtol=0, atol=1e-14)
    assert_close(found[2], mesh.normals[2].expand(3, 3), rtol=0, atol=1e-14)
