"""Quadrilaterals cut in two: alternating whatever the numbering, along the shorter diagonal, winding kept."""

import numpy as np
import torch

from torchmbd.fem.mesh import cut_quads, rectangle


def grid(nx, ny, seed=None):
    """Nodes and quadrilaterals of a rectangle; a seed shuffles numbers and first corners."""
    x, y = np.meshgrid(np.arange(nx + 1.0), np.arange(ny + 1.0), indexing="ij")
    nodes = torch.from_numpy(np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1))
    number = np.arange((nx + 1) * (ny + 1)).reshape(nx + 1, ny + 1)
    quads = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], -1).reshape(-1, 4)
    if seed is not None:
        random = np.random.default_rng(seed)
        new = random.permutation(len(nodes))
        nodes = nodes[np.argsort(new)]
        quads = np.stack([np.roll(new[q], k) for q, k in zip(quads, random.integers(0, 4, len(quads)), strict=True)])
    return nodes, torch.from_numpy(quads)


def diagonals(nodes, triangles):
    """Middle and direction of every edge that is no grid line."""
    result = set()
    for a, b in triangles.reshape(-1, 3)[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).tolist():
        p, q = nodes[a].tolist(), nodes[b].tolist()
        if p[0] != q[0] and p[1] != q[1]:
            result.add(((p[0] + q[0]) / 2, (p[1] + q[1]) / 2, (q[0] - p[0]) * (q[1] - p[1])))
    return result


def test_diagonals_of_squares_alternate_whatever_the_numbering():
    for seed in (None, 1, 2):
        nodes, quads = grid(5, 4, seed)
        cut = diagonals(nodes, cut_quads(nodes, quads))
        assert len(cut) == 20
        signs = {(round(x - 0.5), round(y - 0.5)): s for x, y, s in cut}
        assert all(signs[i, j] == -signs[i + 1, j] for i, j in signs if i < 4)
        assert all(signs[i, j] == -signs[i, j + 1] for i, j in signs if j < 3)


def test_the_cut_is_that_of_the_generator():
    mesh = rectangle(4.0, 4.0, (4, 4), "triangle")
    nodes, quads = grid(4, 4)
    ours = diagonals(nodes, cut_quads(nodes, quads))
    theirs = diagonals(mesh.nodes + torch.tensor([2.0, 2.0, 0.0]), mesh.triangles)
    assert ours in (theirs, {(x, y, -s) for x, y, s in theirs})


def test_a_slender_rhombus_is_cut_along_its_shorter_diagonal():
    nodes = torch.tensor([[0, 0, 0], [3, -1, 0], [6, 0, 0], [3, 1, 0]], dtype=torch.float64)
    assert cut_quads(nodes, torch.tensor([[0, 1, 2, 3]])).tolist() == [[[0, 1, 3], [1, 2, 3]]]
    assert cut_quads(nodes, torch.tensor([[1, 2, 3, 0]])).tolist() == [[[1, 2, 3], [1, 3, 0]]]


def test_winding_and_area_are_kept():
    nodes, quads = grid(3, 2, 4)
    p = nodes[cut_quads(nodes, quads)]
    cross = torch.linalg.cross(p[:, :, 1] - p[:, :, 0], p[:, :, 2] - p[:, :, 0])[..., 2]
    assert bool((cross > 0).all())
    assert float(cross.sum()) / 2 == 6.0
