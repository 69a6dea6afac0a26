"""One warning for a body whose cells are skewed or slender or too coarse for their plies, none for others."""

from __future__ import annotations

import dataclasses
import math
import warnings

import pytest
import torch

import torchmbd as mbd
from tests.fem.elements.plate_cases import CARBON, KINDS, grid, moved, rotation, turned
from tests.refused import warned
from torchmbd.multibody.bodies.mesh_quality import aspects, corner_angles

STIFF = dataclasses.replace(CARBON, E2=128e5, G12=5e7, G13=5e7, G23=5e7, nu12=0.01)


def body(mesh, ply=CARBON, **given):
    return mbd.FlexibleBody.plate("plate", turned(mesh, rotation(3)), mbd.Laminate(ply, [0.3], 2e-3), 2, **given)


def sheared(degrees: float, kind: str = "quad", length: float = 1.0):
    """A plate of parallelograms, whose corners have that angle; of rhombs, unless it is longer."""
    mesh, angle = grid(length, 1.0, (4, 4), kind), math.radians(degrees)
    x, y, z = mesh.nodes.unbind(1)
    return moved(mesh, torch.stack([x + y * math.cos(angle), y * math.sin(angle), z], dim=1))


@pytest.mark.parametrize("kind", KINDS)
def test_good_cells_raise_no_warning(kind):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        body(grid(0.3, 0.1, (6, 2), kind))


@pytest.mark.thorough
def test_cells_within_the_limits_raise_no_warning():
    """Long ones, sheared ones, small ones of a stiff laminate."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        body(grid(1.0, 1.0, (11, 1), "quad"))
        body(sheared(31.0))
        body(grid(1.0, 1.0, (40, 40), "quad"), STIFF)


@pytest.mark.parametrize(
    ("mesh", "words"),
    [
        (grid(12.0, 1.0, (1, 1), "quad"), r"1 slender cells, such as quad 0 of 12\.0 : 1"),
        (grid(1.0, 26.0, (2, 1), "quad"), r"2 slender cells, such as quad \d of 52\.0 : 1"),
        (grid(12.0, 1.0, (1, 1), "triangle"), r"2 slender cells, such as triangle \d of 12\.1 : 1"),
        (sheared(25.0), r"16 skewed cells, such as quad \d+ with a corner of (25|155)\.0 degrees"),
        (sheared(15.0, "triangle"), r"\d+ skewed cells, such as triangle \d+ with a corner of 165\.0 degrees"),
        (sheared(25.0, "mixed"), r"8 skewed cells, such as quad [0-7] with a corner of (25|155)\.0 degrees"),
    ],
)
def test_the_worst_cell_is_named(mesh, words):
    with pytest.warns(UserWarning, match=rf"mesh of body 'plate': .*{words}.*a finer mesh") as result:
        body(mesh)
    assert len(result) == 1


@pytest.mark.parametrize(
    ("change", "ratio"),
    [({"E2": 128e5, "nu12": 0.01}, "1e+04"), ({"G12": 6.4e6}, "2e+04"), ({"G13": 1e6}, "1.28e+05")],
)
def test_stiff_fibers_on_few_cells(change, ratio):
    ply = dataclasses.replace(CARBON, **change)
    with warned("ply 0", f"{ratio} on 32 cells", "1500"):
        body(grid(0.3, 0.1, (8, 4), "quad"), ply)


def test_all_faults_are_in_one_warning():
    with warned("skewed", "slender", "E1 / G") as result:
        body(sheared(20.0, length=20.0), STIFF)
    assert len(result) == 1


def test_angles_and_aspects_of_single_cells():
    """A trapezoid, a kite and a right triangle, turned in space, by school geometry."""
    R = rotation(8)
    quads = torch.tensor([[[0, 0, 0], [4, 0, 0], [3, 1, 0], [1, 1, 0]], [[0, -1, 0], [1, 0, 0], [0, 3, 0], [-1, 0, 0]]])
    p = quads.double() @ R.T
    assert corner_angles(p)[0].tolist() == pytest.approx([45, 45, 135, 135])
    assert corner_angles(p)[1, 0].item() == pytest.approx(90)
    assert aspects(p).tolist() == pytest.approx([3.0, 1.0])
    triangle = torch.tensor([[[0, 0, 0], [4, 0, 0], [0, 3, 0]]]).double() @ R.T
    assert aspects(triangle).item() == pytest.approx(5 / 2.4)
