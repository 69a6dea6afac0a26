"""Generated sections: areas, inertia, wall axes, order of the plies, and what is refused."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.fem.sections.section_cases import ANBA, AS4, scaled
from torchmbd.errors import InputError
from torchmbd.fem import sections

WALLS = ("top", "right", "bottom", "left")
I_WALLS: dict[str, Sequence[float]] = dict.fromkeys(("top", "web", "bottom"), (0.0,))


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize(
    ("make", "area", "iyy"),
    [
        (lambda o: sections.rectangle(0.3, 0.2, AS4, cells=(3, 2), order=o), 0.06, 0.3 * 0.2**3 / 12),
        (
            lambda o: sections.strip(0.3, AS4, [0.1, 0.2], (0.01, 0.03), cells=(3, 2), order=o),
            0.012,
            0.3 * 0.04**3 / 12,
        ),
        (
            lambda o: sections.box(0.3, 0.2, AS4, [0.1, 0.2], (0.01, 0.02), cells=(4, 3, 2), order=o),
            0.3 * 0.2 - 0.24 * 0.14,
            (0.3 * 0.2**3 - 0.24 * 0.14**3) / 12,
        ),
        (
            lambda o: sections.i_section(0.3, 0.2, AS4, I_WALLS, 0.02, cells=(3, 4, 2), order=o),
            2 * 0.3 * 0.02 + 0.16 * 0.02,
            (0.3 * 0.2**3 - 0.28 * 0.16**3) / 12,
        ),
    ],
)
def test_area_and_inertia(make, area, iyy, order):
    M = make(order).mass()
    assert float(M[0, 0]) == pytest.approx(area, rel=1e-12)
    assert float(M[4, 4]) == pytest.approx(iyy, rel=1e-12 if order == 2 else 0.2)


def test_round_sections_converge_to_theirs():
    for order, error in ((1, 6e-3), (2, 3e-5)):
        tube = sections.tube(0.1, AS4, [0.1, 0.2], 0.01, cells=(40, 1), order=order).mass()
        solid = sections.circle(0.1, AS4, cells=(8, 4), order=order).mass()
        assert float(tube[0, 0]) == pytest.approx(math.pi * (0.1**2 - 0.08**2), rel=error)
        assert float(solid[4, 4]) == pytest.approx(math.pi * 0.1**4 / 4, rel=4 * error)


@pytest.mark.parametrize("wall", range(4))
def test_walls_of_a_box_stack_outwards(wall):
    """Plies from inside to outside; normals point out, tangents run clockwise."""
    result = sections.box(0.3, 0.2, AS4, {w: [0.1, 0.2] for w in WALLS}, 0.01, cells=(4, 3, 1))
    out = torch.tensor([(0, 1), (1, 0), (0, -1), (-1, 0)], dtype=torch.float64)[wall]
    g = result.geometry
    inner, outer = (g.layer == 2 * wall), (g.layer == 2 * wall + 1)
    half = 0.1 if wall % 2 == 0 else 0.15
    for elements, low in ((inner, half - 0.02), (outer, half - 0.01)):
        depth = g.points[elements] @ out
        assert low < float(depth.min())
        assert float(depth.max()) < low + 0.01
        normal = g.rotation[elements][..., 2, 1:]
        assert torch.allclose(normal, out.expand_as(normal), atol=1e-12)


def test_normals_of_a_tube_point_out():
    g = sections.tube(0.1, AS4, [0.1, 0.2], 0.01, cells=(16, 1)).geometry
    radial = g.points / g.points.norm(dim=-1, keepdim=True)
    assert float((g.rotation[..., 2, 1:] * radial).sum(-1).min()) > 0.999
    assert float(g.points[g.layer == 0].norm(dim=-1).max()) < 0.09


def test_web_and_flanges_of_an_i():
    g = sections.i_section(
        0.3, 0.2, AS4, {"top": [0.1, 0.2], "web": [0.3, 0.4], "bottom": [0.5, 0.6]}, 0.01, cells=(3, 4, 1)
    ).geometry
    y, z = (torch.stack([g.points[g.layer == k].mean((0, 1))[i] for k in range(6)]) for i in (0, 1))
    assert z[:2].tolist() == pytest.approx([0.085, 0.095])
    assert y[2:4].tolist() == pytest.approx([-0.005, 0.005])
    assert z[4:].tolist() == pytest.approx([-0.095, -0.085])
    web = g.rotation[(g.layer == 2) | (g.layer == 3)]
    assert torch.allclose(web[..., 2, :], torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64).expand_as(web[..., 2, :]))


def test_a_tube_knows_no_direction():
    """A helical tube: both bendings alike, extension coupled with twist, shear with bending about the same axis."""
    K = scaled(sections.tube(0.05, ANBA, mbd.deg([30.0, 60.0]), 2e-3, cells=(24, 1)).stiffness().detach())
    assert float((K[[1, 4]][:, [1, 4]] - K[[2, 5]][:, [2, 5]]).abs().max()) < 1e-6
    assert abs(float(K[0, 3])) > 0.1
    assert float(K[[0, 3]][:, [1, 2, 4, 5]].abs().max()) < 1e-9


@pytest.mark.parametrize("ratios", [(0.1, 0.45), (0.45, 0.1)])
def test_torsion_of_two_concentric_materials_is_the_sum(ratios):
    """Equal moduli E and other shear moduli: G J of both tubes, which do not warp."""
    metals = [mbd.Ply.isotropic(70e9, nu, 2700.0) for nu in ratios]
    section = sections.tube(0.02, metals, [0.0, 0.0], [0.009, 0.006], cells=(24, 1))
    radii = (0.005, 0.014, 0.02)
    shear = [70e9 / (2.0 * (1.0 + nu)) for nu in ratios]
    polar = [math.pi / 2.0 * (outer**4 - inner**4) for inner, outer in pairwise(radii)]
    expected = sum(G * J for G, J in zip(shear, polar, strict=True))
    assert float(section.stiffness().detach()[3, 3]) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: sections.rectangle(0.0, 0.1, AS4), ["width = 0.0 m"]),
        (lambda: sections.rectangle(0.1, 0.1, AS4, cells=(2.0, 2)), ["cells = (2.0, 2)", "2 integers"]),  # pyright: ignore[reportArgumentType]
        (lambda: sections.rectangle(0.1, 0.1, AS4, order=3), ["order = 3"]),
        (lambda: sections.rectangle(0.1, 0.1, [0.1], AS4), ["angles = ", "one angle per ply"]),  # pyright: ignore
        (lambda: sections.box(0.1, 0.1, [0.1], AS4, 0.01), ["angles = ", "one angle per ply"]),  # pyright: ignore
        (lambda: sections.strip(0.1, AS4, [0.1, 0.2], [1e-3]), ["1 thicknesses for 2 plies"]),
        (lambda: sections.strip(0.1, AS4, [0.1], -1e-3), ["thickness = -0.001"]),
        (lambda: sections.box(0.1, 0.02, AS4, [0.1], 0.01), ["walls of 0.01 m", "less than half"]),
        (lambda: sections.box(0.1, 0.1, AS4, {"tpo": [0.1]}, 0.01), ["wall = 'tpo'", "Try: 'top'"]),
        (
            lambda: sections.box(0.1, 0.1, AS4, {"top": [0.1]}, 0.01),
            ["the same number of plies in top, right, bottom, left"],
        ),
        (lambda: sections.tube(0.01, AS4, [0.1, 0.2], 0.005), ["thickness is 0.01 m of radius 0.01 m"]),
        (lambda: sections.circle(-1.0, AS4), ["radius = -1.0 m"]),
        (lambda: sections.i_section(0.1, 0.02, AS4, I_WALLS, 0.01), ["do not fit"]),
        (lambda: sections.i_section(0.1, 0.1, AS4, [0.1], 0.01), ["a mapping with top, web, bottom"]),  # pyright: ignore[reportArgumentType]
    ],
)
def test_bad_dimensions_are_named(make, words):
    with pytest.raises(InputError) as error:
        make()
    for word in words:
        assert word in str(error.value)


def test_numbers_of_elements_may_be_those_of_numpy():
    section = sections.rectangle(0.3, 0.2, AS4, cells=(np.int64(3), np.int64(2)))
    assert len(section.mesh.layer) == 6
