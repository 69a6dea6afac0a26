"""Plates without and with awkward supports: Leissa's free square, Morley's acute skew plate.

Sources: K. M. Liew, Y. Xiang, S. Kitipornchai, J. Sound Vib. 168 (1993) 39-69 (free square, nu = 0.3, thin: 13.468,
19.596, 24.270, 34.801; A. W. Leissa, J. Sound Vib. 31 (1973), prints upper bounds 13.489, 19.789, 24.432, 35.024).
L. S. D. Morley, Skew Plates and Structures (1963): w D / (q L^4) = 0.408e-3 at the center of the 30 degree rhombus
(Kirchhoff); with the shear of L / h = 100 and soft supports 0.423e-3 (I. Babuska and T. Scapolla, Int. J. Numer.
Methods Eng. 28 (1989)).
"""

import math

import numpy as np
import pytest

from tests.fem.elements.plate_cases import (
    boundary,
    freedoms,
    frequencies,
    irregular,
    mapped,
    rotation,
    solved,
    stiffness,
    turned,
)
from torchmbd.fem.elements import PlateMatrices
from torchmbd.fem.materials import Laminate, Ply


@pytest.mark.thorough
def test_free_square_plate_out_of_plane():
    """omega a^2 sqrt(rho h / D) of an irregular mesh, turned in space: six rigid modes, then five in print."""
    h, E = 0.005, 70e9
    laminate = Laminate(Ply.isotropic(E, 0.3, 2700.0), [0.0], h)
    R = rotation(11)
    mesh = turned(irregular(1.0, 1.0, (24, 24), amount=0.2), R)
    f, _ = frequencies(PlateMatrices(mesh, laminate, R[:, 0]), laminate, np.array([], dtype=int), 11)
    D = E * h**3 / 12 / (1 - 0.09)
    assert f[5] < 1e-3 * f[6]
    factors = 2 * math.pi * f[6:] * math.sqrt(2700 * h / D)
    assert factors == pytest.approx([13.468, 19.596, 24.271, 34.801, 34.801], rel=0.01)


def skew_center(n):
    """w D / (q L^4) 1000 of the 30 degree rhombus on soft supports, L / h = 100."""
    laminate = Laminate(Ply.isotropic(10.92, 0.3, 1.0), [0.0], 0.01)
    mesh = mapped((n, n), lambda s, t: (s + t * math.cos(math.pi / 6), t * math.sin(math.pi / 6), 0.0))
    plate = PlateMatrices(mesh, laminate)
    load = np.zeros(6 * len(mesh.nodes))
    load[2::6] = plate.area.numpy()
    held = np.union1d(freedoms(boundary(mesh), [2]), freedoms(range(len(mesh.nodes)), [0, 1, 5]))
    w = solved(stiffness(plate, laminate), load, held)[6 * mesh.node("center") + 2]
    return w * 10.92e-6 / 12 / 0.91 * 1000


@pytest.mark.thorough
def test_morley_skew_plate():
    """The obtuse corners make this slow for every element: 16 x 16 cells are within 2 %, 32 x 32 within 1 %."""
    result = [skew_center(n) for n in (8, 16, 32)]
    assert result[1] == pytest.approx(0.423, rel=0.02)
    assert result[2] == pytest.approx(0.423, rel=0.01)
    assert result[0] > result[1] > result[2]


def clamped_center(n, kind):
    """Deflection of the center of a thin clamped rhombus of 40 degrees under uniform load."""
    angle = math.radians(40)
    laminate = Laminate(Ply.isotropic(1.0, 0.3, 1.0), [0.0], 1e-3)
    mesh = mapped((n, n), lambda s, t: (s + t * math.cos(angle), t * math.sin(angle), 0.0), kind)
    plate = PlateMatrices(mesh, laminate)
    load = np.zeros(6 * len(mesh.nodes))
    load[2::6] = plate.area.numpy()
    held = np.union1d(freedoms(boundary(mesh)), freedoms(range(len(mesh.nodes)), [0, 1, 5]))
    return solved(stiffness(plate, laminate), load, held)[6 * mesh.node("center") + 2]


@pytest.mark.thorough
def test_slanted_quadrilaterals_bend_as_fine_triangles_say():
    """Errors fall as the square of the size: triangles at 24 and 36 cells tell the limit. Published DKMQ with 8 x 8: 1.38."""
    coarse, fine = clamped_center(24, "triangle"), clamped_center(36, "triangle")
    limit = (36**2 * fine - 24**2 * coarse) / (36**2 - 24**2)
    result = [clamped_center(n, "quad") / limit for n in (8, 16, 32)]
    assert result == pytest.approx([1.0, 1.0, 1.0], abs=0.06)
    assert result[1:] == pytest.approx([1.0, 1.0], abs=0.02)
    assert result[2] == pytest.approx(1.0, abs=0.006)
