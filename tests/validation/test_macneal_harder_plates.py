"""MacNeal and Harder's standard problems for shells, with triangles.

Source: R. H. MacNeal and R. L. Harder, A proposed standard set of problems to test finite element accuracy, Finite
Elem. Anal. Des. 1 (1985) 3-20. Meshes are theirs, every quadrilateral cut in two. Where the printed reference is a beam
formula that no plate theory meets exactly, the tolerance says so.
"""

import math

import numpy as np
import pytest

from tests.fem.elements.plate_cases import freedoms, mapped, solved, stiffness
from torchmbd.fem.elements import PlateMatrices
from torchmbd.fem.materials import Laminate, Ply

U, V, W = 0, 1, 2


def tip_displacement(place, cells, laminate, direction):
    """Mean end displacement of a cantilever under a unit end force, both in freedom `direction`."""
    mesh = mapped(cells, place)
    tip = mesh.node_set("right_edge")
    share = np.ones(len(tip))
    share[[0, -1]] = 0.5
    share /= share.sum()
    load = np.zeros(6 * len(mesh.nodes))
    load[freedoms(tip, [direction])] = share
    K = stiffness(PlateMatrices(mesh, laminate), laminate)
    return share @ solved(K, load, freedoms(mesh.node_set("left_edge")))[freedoms(tip, [direction])]


def straight(s, t):
    return 6 * s, 0.2 * t, 0.0


def curved(s, t):
    r, angle = 4.32 - 0.2 * t, math.pi / 2 * s
    return -r * math.cos(angle), r * math.sin(angle), 0.0


def twisted(s, t):
    y, angle = 1.1 * (t - 0.5), math.pi / 2 * s
    return 12 * s, y * math.cos(angle), y * math.sin(angle)


STRAIGHT = Laminate(Ply.isotropic(1e7, 0.3, 1.0), [0.0], 0.1)
CURVED = Laminate(Ply.isotropic(1e7, 0.25, 1.0), [0.0], 0.1)
TWISTED = Laminate(Ply.isotropic(29e6, 0.22, 1.0), [0.0], 0.32)


@pytest.mark.thorough("curved-laminate8-cells8-2-0.5022-0.02")
@pytest.mark.parametrize(
    ("place", "laminate", "cells", "direction", "reference", "tolerance"),
    [
        (straight, STRAIGHT, (6, 1), U, 3e-5, 0.01),
        (straight, STRAIGHT, (6, 1), V, 0.1081, 0.07),
        (straight, STRAIGHT, (12, 2), V, 0.1081, 0.005),
        (straight, STRAIGHT, (6, 1), W, 0.4321, 0.025),
        (straight, STRAIGHT, (12, 2), W, 0.4321, 0.015),
        (curved, CURVED, (6, 1), V, 0.08734, 0.04),
        (curved, CURVED, (12, 2), V, 0.08734, 0.005),
        (curved, CURVED, (6, 1), W, 0.5022, 0.12),  # torsion of a section 2 : 1: its edge layers need a fine mesh
        (curved, CURVED, (96, 16), W, 0.5022, 0.02),  # 0.993 of it at the limit, see test_twisted_strip.py
        (twisted, TWISTED, (12, 2), W, 0.005424, 0.01),
        (twisted, TWISTED, (12, 2), V, 0.001754, 0.01),
    ],
)
def test_beams(place, laminate, cells, direction, reference, tolerance):
    assert tip_displacement(place, cells, laminate, direction) == pytest.approx(reference, rel=tolerance)


@pytest.mark.thorough
@pytest.mark.parametrize(("lean", "in_plane"), [((1, 1), (0.53, 0.80, 0.96)), ((1, -1), (0.70, 0.91, 0.99))])
def test_slanted_cells(lean, in_plane):
    """The straight beam with parallelograms and trapezoids of 45 degrees: only bending in the plane feels them.

    Slender slanted triangles are stiff there at 6 x 1 cells (the set's own QUAD4: 0.63 and 0.05); 24 x 4 cells are not.
    """
    for cells, least in zip(((6, 1), (12, 2), (24, 4)), in_plane, strict=True):

        def slanted(s, t, n=cells[0]):
            k = round(s * n)
            shift = 0.0 if k in (0, n) else lean[k % 2] * 0.6 / n * (2 * t - 1)
            return 6 * s + shift, 0.2 * t, 0.0

        assert least < tip_displacement(slanted, cells, STRAIGHT, V) / 0.1081 < 1.0
        assert tip_displacement(slanted, cells, STRAIGHT, W) == pytest.approx(0.4321, rel=0.025)
        assert tip_displacement(slanted, cells, STRAIGHT, U) == pytest.approx(3e-5, rel=0.01)


def test_scordelis_lo_roof():
    """A quarter of the roof with 8 x 8 cells: 0.3024 down at the middle of the free edge."""
    laminate = Laminate(Ply.isotropic(4.32e8, 0.0, 1.0), [0.0], 0.25)

    def roof(s, t):
        angle = math.radians(40) * t
        return 25 * s, 25 * math.sin(angle), 25 * math.cos(angle)

    mesh = mapped((8, 8), roof)
    plate = PlateMatrices(mesh, laminate)
    load = np.zeros(6 * len(mesh.nodes))
    load[2::6] = -90 * plate.area.numpy()
    held = [
        freedoms(mesh.node_set("left_edge"), [0, 4, 5]),  # symmetry, middle of the length
        freedoms(mesh.node_set("bottom_edge"), [1, 3, 5]),  # symmetry, crown
        freedoms(mesh.node_set("right_edge"), [1, 2]),  # diaphragm
    ]
    u = solved(stiffness(plate, laminate), load, np.unique(np.concatenate(held)))
    assert -u[6 * mesh.node("corner_left_top") + 2] == pytest.approx(0.3024, rel=0.01)


def quarter_plate(b, clamped, point_load, n):
    """Center deflection of a 2 x b plate, t = 1e-4, q = 1e-4 or P = 4e-4: a quarter with n x n cells."""
    laminate = Laminate(Ply.isotropic(1.7472e7, 0.3, 1.0), [0.0], 1e-4)
    mesh = mapped((n, n), lambda s, t: (s, t * b / 2, 0.0))
    plate = PlateMatrices(mesh, laminate)
    held = [
        freedoms(range(len(mesh.nodes)), [0, 1, 5]),
        freedoms(mesh.node_set("left_edge"), [4]),  # symmetry
        freedoms(mesh.node_set("bottom_edge"), [3]),
        freedoms(mesh.node_set("right_edge"), [2, 3, 4] if clamped else [2, 3]),
        freedoms(mesh.node_set("top_edge"), [2, 3, 4] if clamped else [2, 4]),
    ]
    load = np.zeros(6 * len(mesh.nodes))
    center = 6 * mesh.node("corner_left_bottom") + 2
    if point_load:
        load[center] = 1e-4
    else:
        load[2::6] = 1e-4 * plate.area.numpy()
    return solved(stiffness(plate, laminate), load, np.unique(np.concatenate(held)))[center]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("b", "clamped", "point_load", "reference", "errors"),
    [
        (2.0, False, False, 4.062, (0.02, 0.005)),
        (2.0, False, True, 11.60, (0.02, 0.005)),
        (2.0, True, False, 1.2653, (0.03, 0.01)),
        (2.0, True, True, 5.60, (0.03, 0.01)),
        (10.0, False, False, 12.97, (0.01, 0.002)),
        (10.0, False, True, 16.96, (0.03, 0.015)),
        (10.0, True, False, 2.604, (0.06, 0.015)),
        (10.0, True, True, 7.23, (0.06, 0.016)),
    ],
)
def test_plates(b, clamped, point_load, reference, errors):
    """Quarter meshes 4 x 4 and 8 x 8, cells up to 5 : 1. Clamped and uniform: more digits than the set's 1.26 and 2.56.

    They are 0.0012653 and 0.002604 q a^4 / D (S. P. Timoshenko, Theory of Plates and Shells, article 44).
    """
    for n, error in zip((4, 8), errors, strict=True):
        assert quarter_plate(b, clamped, point_load, n) == pytest.approx(reference, rel=error)
