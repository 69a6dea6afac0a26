"""Lines of the picture of fibers: in the cells, along the directions of the rule, at the angles of the plies."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

import torchmbd as mbd
from tests.refused import refused
from torchmbd.errors import InputError
from torchmbd.viz.fibers import fiber_lines

RADIUS, AROUND, UP, LENGTH = 0.05, 12, 3, 0.1


def shell(direction: object) -> mbd.FlexibleBody:
    """A tube about z with a hoop layer and one of 30 degrees."""
    angle = 2.0 * math.pi * torch.arange(AROUND, dtype=torch.float64) / AROUND
    heights = torch.linspace(0.0, LENGTH, UP + 1, dtype=torch.float64).tolist()
    nodes = [torch.stack([RADIUS * angle.cos(), RADIUS * angle.sin(), torch.full_like(angle, z)], 1) for z in heights]
    quads = [
        [r * AROUND + k, r * AROUND + (k + 1) % AROUND, (r + 1) * AROUND + (k + 1) % AROUND, (r + 1) * AROUND + k]
        for r in range(UP)
        for k in range(AROUND)
    ]
    mesh = mbd.Mesh(torch.cat(nodes), quads=torch.tensor(quads))
    laminate = mbd.Laminate(mbd.examples.carbon(), mbd.deg([0, 30]), thickness=5e-4)
    return mbd.FlexibleBody.plate("shell", mesh, laminate, modes=1, direction=direction)  # type: ignore[arg-type]


def test_lines_follow_the_rule_and_the_plies() -> None:
    body = shell({"around": {"axis": [0, 0, 1]}})
    figure = mbd.viz.fibers(body)
    assert [axes.get_title() for axes in figure.axes] == ["layer 1", "layer 2"]
    assert body.mesh is not None
    cells = body.mesh.nodes[body.mesh.quads].mean(1).numpy()
    hoop = np.stack([-cells[:, 1], cells[:, 0], 0.0 * cells[:, 0]], 1)
    hoop /= np.linalg.norm(hoop, axis=1, keepdims=True)
    part, corners = body.plates["plate"], list(body.mesh.nodes[body.mesh.quads].numpy())
    for directions, slope in zip(part.fibers(), (0.0, math.radians(30.0)), strict=True):
        lines = np.array(fiber_lines(part, corners, directions.numpy(), np.array([0.0, 0.0, 1.0])))
        first, last = lines[:, [0, 3]].mean(1), lines[:, [1, 2]].mean(1)
        along = (last - first) / np.linalg.norm(last - first, axis=1, keepdims=True)
        assert_allclose((along * hoop).sum(1), math.cos(slope), rtol=0, atol=1e-9)
        assert_allclose(along[:, 2], math.sin(slope), rtol=0, atol=1e-9)
        size = float(body.mesh.areas[0]) ** 0.5
        assert np.linalg.norm((first + last) / 2.0 - cells, axis=1).max() < 0.06 * size


def test_a_mapping_is_the_rule_that_it_names() -> None:
    for mapping, rule in (
        ({"around": {"axis": [0, 0, 1], "point": [0.0, 0.0, 1.0]}}, mbd.mesh.around((0, 0, 1), (0.0, 0.0, 1.0))),
        ({"along": {"points": [[0, 0, 0], [0.1, 0, 1]]}}, mbd.mesh.along([[0.0, 0.0, 0.0], [0.1, 0.0, 1.0]])),
        (
            {"in_system": {"axes": np.eye(3).tolist(), "kind": "cylindrical", "axis": "z"}},
            mbd.mesh.in_system(np.eye(3).tolist(), kind="cylindrical", axis="z"),
        ),
    ):
        of_mapping, of_rule = (shell(d).plates["plate"].matrices.axes for d in (mapping, rule))
        assert torch.equal(of_mapping, of_rule)


@pytest.mark.parametrize(
    ("direction", "text"),
    [
        ({"about": {"axis": [0, 0, 1]}}, "direction = 'about': must be one of around"),
        ({"around": [0, 0, 1]}, "must be one rule with its arguments"),
        ({}, "must be one rule"),
        ({"around": {"axes": [0, 0, 1]}}, "argument of around = 'axes': must be one of axis, point"),
        ({"along": {}}, "direction.along.points is missing"),
    ],
)
def test_bad_mappings_are_refused(direction: object, text: str) -> None:
    with pytest.raises(InputError) as error:
        shell(direction)
    assert text in str(error.value)


def test_bad_pictures_are_refused() -> None:
    with refused("body", 3):
        mbd.viz.fibers(3)
    with refused("layers", [3]):
        mbd.viz.fibers(mbd.examples.arm().body("arm"), layers=[3])
