"""Finer meshes: those that the generator makes with twice the cells."""

from __future__ import annotations

import pytest
import torch

import torchmbd as mbd
from torchmbd.fem.mesh.refinement import refined


def places(x: torch.Tensor) -> list[tuple[float, ...]]:
    return sorted(tuple(row) for row in (x + 0.0).round(decimals=9).tolist())


@pytest.mark.parametrize("kind", ["quad", "triangle"])
def test_cells_and_nodes_are_those_of_twice_the_cells(kind):
    mesh = mbd.mesh.rectangle(0.5, 0.2, cells=(3, 2), kind=kind)
    finer, parents, _ = refined(mesh)
    expected = mbd.mesh.rectangle(0.5, 0.2, cells=(6, 4), kind=kind)
    assert torch.equal(finer.nodes[: len(mesh.nodes)], mesh.nodes)
    assert places(finer.nodes) == places(expected.nodes)
    assert finer.cell_count == 4 * mesh.cell_count
    torch.testing.assert_close(finer.areas, mesh.areas[parents] / 4.0)
    torch.testing.assert_close(finer.normals, mesh.normals[parents])
    assert finer.node_sets == mesh.node_sets
    if kind == "quad":
        middles = [x.nodes[x.quads].mean(1) for x in (finer, expected)]
        assert places(middles[0]) == places(middles[1])


def test_middles_of_a_set():
    mesh = mbd.mesh.rectangle(0.5, 0.2, cells=(3, 2))
    finer, _, middles = refined(mesh)
    edge = middles.with_middles(mesh.node_set("left_edge"))
    assert len(edge) == 5
    assert finer.nodes[edge][:, 0].tolist() == [-0.25] * 5
    assert middles.with_middles([0]) == [0]
    assert len(middles.with_middles(range(len(mesh.nodes)))) == len(finer.nodes)


def test_triangles_beside_quadrilaterals():
    x = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0.5, 0]], dtype=torch.float64)
    mesh = mbd.Mesh(x, torch.tensor([[1, 4, 2]]), quads=torch.tensor([[0, 1, 2, 3]]))
    finer, parents, _ = refined(mesh)
    assert (len(finer.triangles), len(finer.quads)) == (4, 4)
    assert parents.tolist() == [0] * 4 + [1] * 4
    assert float(finer.areas.sum()) == pytest.approx(float(mesh.areas.sum()))
    assert len(finer.nodes) == 5 + 6 + 1  # six sides: that between the cells has one middle
