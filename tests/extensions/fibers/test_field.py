"""Fields of angles and thicknesses over a mesh: interpolation, equality with a laminate for each cell, paths of fibers."""

from __future__ import annotations

import math

import pytest
import torch

import torchmbd as mbd
from torchmbd.fem.elements import Plates

MESH = mbd.mesh.rectangle(0.4, 0.1, cells=(8, 4))
MIDDLES = MESH.nodes[MESH.quads].mean(1)


def fields():
    return {
        "spline": mbd.fibers.FiberField(MESH, (5, 3)),
        "linear": mbd.fibers.FiberField(MESH, (4, 2), degree=1),
        "along": mbd.fibers.FiberField(MESH, (4, 1), degree=3),
        "radial": mbd.fibers.FiberField(MESH, [[-0.2, 0, 0], [0, 0.02, 0], [0.2, 0, 0]], radius=0.3),
        "filter": mbd.fibers.FiberField(MESH, "cells", radius=0.06),
    }


@pytest.mark.parametrize("name", fields())
def test_weights_are_shares(name):
    field = fields()[name]
    assert (field.weights >= 0.0).all()
    torch.testing.assert_close(field.weights.sum(1), torch.ones(32, dtype=torch.float64))
    one = torch.ones(field.controls, 1, dtype=torch.float64)
    assert field.gradients(one).abs().max() < 1e-12


@pytest.mark.parametrize("name", ["radial", "filter"])
def test_gradients_are_those_of_the_values(name):
    """Cells moved a little: the field moves as its gradient says."""
    given = {"radial": [[-0.2, 0, 0], [0, 0.02, 0], [0.2, 0, 0]], "filter": MIDDLES}[name]
    radius = {"radial": 0.3, "filter": 0.06}[name]
    p = torch.linspace(0.3, 1.1, len(given), dtype=torch.float64).sin()[:, None]

    def moved(step: float) -> torch.Tensor:
        nodes = MESH.nodes + torch.tensor([step, 0.5 * step, 0.0])
        return mbd.fibers.FiberField(mbd.Mesh(nodes, quads=MESH.quads), given, radius=radius).values(p)[:, 0]

    slope = (
        mbd.fibers.FiberField(MESH, given, radius=radius).gradients(p)[:, 0] @ torch.tensor([1.0, 0.5, 0.0]).double()
    )
    one, two = ((moved(h) - moved(-h)) / (2.0 * h) for h in (1e-4, 2e-4))
    torch.testing.assert_close(slope, (4.0 * one - two) / 3.0, rtol=1e-7, atol=1e-8)


def test_splines_hold_linear_fields():
    """Controls at the Greville places of a linear function make it, with its slope."""
    field = mbd.fibers.FiberField(MESH, (5, 3), degree=2)
    low, high = MIDDLES.amin(0), MIDDLES.amax(0)
    knots = [torch.tensor([0, 0, 0, 1, 2, 3, 3, 3.0]).double() / 3, torch.tensor([0, 0, 0, 1, 1, 1.0]).double()]
    places = [(t[1:-2] + t[2:-1]) / 2 for t in knots]
    x, y = (low[i] + (high[i] - low[i]) * at for i, at in enumerate(places))
    p = (2.0 * x[:, None] - 3.0 * y).reshape(-1, 1)
    torch.testing.assert_close(field.values(p)[:, 0], 2.0 * MIDDLES[:, 0] - 3.0 * MIDDLES[:, 1])
    slope = torch.tensor([2.0, -3.0, 0.0], dtype=torch.float64).expand(32, 3)
    torch.testing.assert_close(field.gradients(p)[:, 0], slope)


@pytest.fixture(scope="module")
def same():
    """A steered plate, and one with a part of its own for each cell."""
    field = mbd.fibers.FiberField(MESH, (4, 3))
    generator = torch.Generator().manual_seed(3)
    angles = torch.randn(12, 2, generator=generator, dtype=torch.float64)
    thickness = 1e-3 * (1 + 0.3 * torch.rand(12, 2, generator=generator, dtype=torch.float64))
    ply = mbd.examples.carbon()
    steered = mbd.fibers.SteeredLaminate(ply, angles, thickness, field)
    parts = {}
    for k, (a, t) in enumerate(zip(field.values(angles), field.values(thickness), strict=True)):
        parts[f"c{k}"] = Plates(MESH, mbd.Laminate(ply, a, t), cells=[k])
    plates = (Plates(MESH, steered), parts)
    bodies = [
        mbd.FlexibleBody("plate", MESH, {"plate": plates[0]}, 4, reference="left_edge"),
        mbd.FlexibleBody("plate", MESH, parts, 4, reference="left_edge"),
    ]
    return bodies


@pytest.mark.thorough
def test_a_laminate_for_each_cell_is_the_same(same):
    """But for the constants of shape functions, which are of the mean stack here and of the cell's own there."""
    one, other = (body.structure() for body in same)
    torch.testing.assert_close(one["mass"], other["mass"])
    torch.testing.assert_close(one["Kr"].diagonal(), other["Kr"].diagonal(), rtol=2e-3, atol=0)


def motion_of(body):
    ground = mbd.Ground()
    system = mbd.System([body], [mbd.Revolute(ground.at(-0.2, 0, 0), body.at("left"), "y")], gravity=(0, 0, -9.81))
    return mbd.simulate(system, 0.05, steps=40)


@pytest.mark.thorough
def test_ply_stresses_of_cells(same):
    """Points of the steered body are those of its cells, in the same order, with the same stress."""
    result = [mbd.PlyHistory(motion_of(body), "plate") for body in same]
    order = [x.points[:, 0].argsort(stable=True) for x in result]
    one, other = (x.stress(slice(-1, None))[0, 0][k] for x, k in zip(result, order, strict=True))
    assert (one - other).norm() < 5e-3 * other.norm()


def test_paths_of_fibers():
    """Concentric circles about a place turn by 1/r and keep their distance; rays from it the other way round."""
    mesh = mbd.mesh.rectangle(0.4, 0.2, cells=(40, 20))
    middle = mesh.nodes[mesh.quads].mean(1) - torch.tensor([0.0, -0.3, 0.0])
    field = mbd.fibers.FiberField(mesh, (24, 12), degree=3)
    ray, r = torch.atan2(middle[:, 1], middle[:, 0]), middle.norm(dim=1)
    W = torch.zeros(len(r), field.controls, dtype=torch.float64).scatter_(1, field.nearest, field.weights)
    controls = torch.linalg.lstsq(W, torch.stack([ray + math.pi / 2, ray], 1)).solution
    laminate = mbd.fibers.SteeredLaminate(mbd.examples.carbon(), controls, 1e-3, field)
    axes = torch.eye(3, dtype=torch.float64).expand(len(r), 3, 3)
    paths = laminate.paths(axes)
    torch.testing.assert_close(paths.curvature[:, 0], 1 / r, rtol=1e-3, atol=0)
    torch.testing.assert_close(paths.divergence[:, 1], 1 / r, rtol=1e-3, atol=0)
    for zero in (paths.curvature[:, 1], paths.divergence[:, 0]):
        assert zero.abs().max() < 5e-3


PLY, ANGLES = mbd.examples.carbon(), mbd.deg([30, -30])
REFUSED = {
    "controls": (lambda: mbd.fibers.FiberField(MESH, 5), "two whole numbers"),
    "few controls": (lambda: mbd.fibers.FiberField(MESH, (2, 2), degree=3), r"\(2, 2\): must be 1, or at least 4"),
    "degree": (lambda: mbd.fibers.FiberField(MESH, (2, 2), degree=-1), "degree of a FiberField = -1"),
    "radius": (lambda: mbd.fibers.FiberField(MESH, "cells", radius=0.0), "radius of a FiberField = 0.0"),
    "far": (lambda: mbd.fibers.FiberField(MESH, [[9.0, 0, 0]], radius=0.1), "a control point within it: must reach"),
    "places": (lambda: mbd.fibers.FiberField(MESH, [["a", "b", "c"]], radius=0.1), "controls = "),
    "word": (lambda: mbd.fibers.FiberField(MESH, "nodes", radius=0.1), "'nodes': must be 'cells'"),
    "axes": (lambda: mbd.fibers.FiberField(MESH, (3, 3), axes="xx"), "'xx': must be two of x, y, z"),
    "flat": (lambda: mbd.fibers.FiberField(MESH, (3, 3), axes="xz"), "no extent"),
    "cells": (lambda: mbd.fibers.FiberField(MESH, (3, 3), cells=[32]), "0 to 31"),
    "shape": (
        lambda: mbd.fibers.SteeredLaminate(PLY, torch.zeros(4, 2), 1e-3, mbd.fibers.FiberField(MESH, (3, 3))),
        "9 controls",
    ),
    "field": (lambda: mbd.fibers.SteeredLaminate(PLY, ANGLES, 1e-3, MESH), "must be a FiberField"),
    "thin": (
        lambda: mbd.fibers.SteeredLaminate(
            PLY, ANGLES, torch.tensor([[1e-3, -1e-3]] * 9), mbd.fibers.FiberField(MESH, (3, 3))
        ),
        "thickness",
    ),
    "degrees": (
        lambda: mbd.fibers.SteeredLaminate(PLY, [30.0, -30.0], 1e-3, mbd.fibers.FiberField(MESH, (3, 3))),
        "angles",
    ),
    "other mesh": (
        lambda: Plates(mbd.mesh.rectangle(0.4, 0.1, cells=(8, 4)), steered(mbd.fibers.FiberField(MESH, (3, 3)))),
        "must be made with the mesh of the body",
    ),
    "other cells": (
        lambda: Plates(MESH, steered(mbd.fibers.FiberField(MESH, (3, 3), cells=range(16)))),
        "was made for 16 other cells",
    ),
    "parameter": (
        lambda: mbd.fibers.SteeredLaminate(PLY, torch.nn.Parameter(ANGLES), 1e-3, mbd.fibers.FiberField(MESH, (3, 3))),
        "without an axis of controls",
    ),
}


def steered(field):
    return mbd.fibers.SteeredLaminate(PLY, ANGLES, 1e-3, field)


@pytest.mark.parametrize("name", REFUSED)
def test_refused(name):
    make, text = REFUSED[name]
    with pytest.raises(mbd.InputError, match=text):
        make()
