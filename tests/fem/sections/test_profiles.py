"""C, L, Z, hat and T profiles against closed forms of thin walls; each wall with its own laminate; bad input.

Sources: Timoshenko, Strength of Materials; Vlasov, Thin-walled elastic beams (torsion, shear center of a channel).
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.refused import refused
from torchmbd.errors import InputError

E, NU = 70e9, 0.3
G = E / (2.0 + 2.0 * NU)
STEEL = mbd.Ply.isotropic(E=E, nu=NU, density=2700.0)
B, H, T = 0.04, 0.06, 1e-3
LINES = {  # middles of the walls: points (y, z) of each
    "c_section": [(B / 2, -(H - T) / 2), ((T - B) / 2, -(H - T) / 2), ((T - B) / 2, (H - T) / 2), (B / 2, (H - T) / 2)],
    "l_section": [(B / 2, (T - H) / 2), ((T - B) / 2, (T - H) / 2), ((T - B) / 2, H / 2)],
    "z_section": [(B - T / 2, -(H - T) / 2), (0.0, -(H - T) / 2), (0.0, (H - T) / 2), (T / 2 - B, (H - T) / 2)],
}


def profile(name: str, **options: Any) -> Any:
    options = {"ply": STEEL, "angles": [0.0], "thickness": T} | options
    sizes = {"width": B, "height": H} | ({"crown": B / 2} if name == "hat_section" else {})
    return getattr(mbd.sections, name)(**sizes | options)


def lines(name: str, radius: float = 0.0) -> list[tuple[tuple, tuple]]:
    """Middles of the walls; of arcs of an inner radius: many chords."""
    if name == "t_section":
        z = (H - T) / 2
        return [((-B / 2, z), (B / 2, z)), ((0.0, z - T / 2), (0.0, -H / 2))]
    points = LINES.get(name)
    if points is None:
        y, z = (B / 2 - T) / 2, (H - T) / 2
        points = [(-B / 2, -z), (-y, -z), (-y, z), (y, z), (y, -z), (B / 2, -z)]
    if radius:
        points = rounded(np.array(points), radius + T / 2)
    return list(itertools.pairwise(points))


def rounded(points: np.ndarray, radius: float) -> list[np.ndarray]:
    """A path of right angles whose corners are arcs."""
    result = [points[0]]
    for before, corner, after in zip(points, points[1:], points[2:], strict=False):
        a, b = ((p - corner) / np.linalg.norm(p - corner) for p in (before, after))
        for angle in np.linspace(0.0, np.pi / 2, 200):
            result.append(corner + radius * (a + b - np.cos(angle) * b - np.sin(angle) * a))
    return [*result, points[-1]]


def thin_walls(name: str, radius: float = 0.0) -> tuple[float, torch.Tensor, torch.Tensor, float]:
    """Area, center [2], second moments about it [2, 2], and sum of b t^3 / 3."""
    ends = torch.tensor(np.array(lines(name, radius)), dtype=torch.float64)
    along = ends[:, 1] - ends[:, 0]
    b, middle = along.norm(dim=1), ends.mean(1)
    area = T * b.sum()
    center = T * (b[:, None] * middle).sum(0) / area
    arm = middle - center
    outer = arm[:, :, None] * arm[:, None] + along[:, :, None] * along[:, None] / 12.0
    across = torch.stack([-along[:, 1], along[:, 0]], 1) / b[:, None]
    outer = outer + T**2 / 12.0 * across[:, :, None] * across[:, None]
    return float(area), center, (T * b[:, None, None] * outer).sum(0), float((b * T**3).sum() / 3.0)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "radius"),
    [("t_section", 0.0), *itertools.product(["c_section", "l_section", "z_section", "hat_section"], [0.0, 4e-3])],
)
def test_stiffness_is_that_of_thin_walls(name, radius):
    section = profile(name, cells=(6, 1), **({"radius": radius} if radius else {}))
    area, center, moments, torsion = thin_walls(name, radius)
    flexibility = torch.linalg.inv(section.stiffness().detach())
    stretch = torch.linalg.inv(flexibility[[0, 4, 5]][:, [0, 4, 5]])  # of strain and curvatures without shear and twist
    assert section.mass()[0, 0].item() == pytest.approx(2700.0 * area, rel=1e-5 if radius else 1e-9)
    assert stretch[0, 0].item() == pytest.approx(E * area, rel=1e-5 if radius else 1e-6)
    y, z = center.tolist()
    assert stretch[0, 1].item() / (E * area) == pytest.approx(z, abs=2e-3 * T)  # corners
    assert stretch[0, 2].item() / (E * area) == pytest.approx(-y, abs=2e-3 * T)  # corners
    about_center = stretch[1:, 1:] - torch.outer(stretch[0, 1:], stretch[0, 1:]) / stretch[0, 0]
    (yy, yz), (_, zz) = moments.tolist()
    expected = E * torch.tensor([[zz, -yz], [-yz, yy]], dtype=torch.float64)
    torch.testing.assert_close(about_center, expected, rtol=0, atol=2e-3 * float(expected.abs().max()))
    assert 1.0 / flexibility[3, 3].item() == pytest.approx(G * torsion, rel=0.03)


@pytest.mark.thorough
def test_the_shear_center_of_a_channel_lies_behind_its_web():
    """e = 3 b^2 / (h + 6 b) from the middle of the web, b and h of the middles of flanges and web."""
    flexibility = torch.linalg.inv(profile("c_section", cells=(8, 1)).stiffness().detach())
    b, h = B - T / 2, H - T
    place = -flexibility[3, 2] / flexibility[3, 3]  # of a force along z that does not twist, from y = 0
    assert abs(place.item()) == pytest.approx((B - T) / 2 + 3.0 * b**2 / (h + 6.0 * b), rel=0.02)


@pytest.mark.thorough
def test_each_wall_has_its_laminate():
    """Angles of one wall at a time change the section; equal ones are the shared laminate."""
    names = ("bottom", "web", "top")
    same = profile("c_section", angles={name: [0.3, -0.2] for name in names}, cells=(3, 1), ply=mbd.examples.carbon())
    shared = profile("c_section", angles=[0.3, -0.2], cells=(3, 1), ply=mbd.examples.carbon())
    torch.testing.assert_close(same.stiffness(), shared.stiffness(), rtol=1e-9, atol=1e-6)
    assert same.angles.shape == (6,)


@pytest.mark.parametrize(
    ("name", "sizes", "text"),
    [
        ("c_section", {"width": 0.9e-3}, "c_section: width = 0.0009 m: must be more than the thickness 0.001 m"),
        ("c_section", {"height": 2e-3}, "c_section: height = 0.002 m: must be more than 2 times the thickness"),
        ("hat_section", {"crown": B}, "hat_section: crown = 0.04 m: must be less than the width 0.04 m"),
        ("t_section", {"width": 1e-3}, "t_section: width = 0.001 m: must be more than the thickness"),
        ("z_section", {"thickness": 0.05}, "z_section: width = 0.04 m: must be more than the thickness 0.05 m"),
    ],
)
def test_walls_that_do_not_fit_are_refused(name, sizes, text):
    with pytest.raises(InputError) as error:
        profile(name, **sizes)
    assert text in str(error.value)


@pytest.mark.parametrize("name", ["c_section", "l_section", "z_section", "hat_section"])
def test_a_radius_is_a_design_variable(name):
    """Each corner of a right angle has 2 R - pi R / 2 less of the middle of a wall."""
    corners = {"c_section": 2, "l_section": 1, "z_section": 2, "hat_section": 4}[name]
    radius = mbd.variable(4e-3)
    section = profile(name, radius=radius, cells=(4, 1))
    section.mass()[0, 0].backward()
    assert radius.grad is not None
    assert radius.grad.item() == pytest.approx(
        -2700.0 * T * corners * (2.0 - np.pi / 2), rel=3e-4
    )  # arcs are parabolas


def test_a_laminate_goes_half_way_round_a_corner():
    """The masses of plies of two densities differ by half of an arc."""
    heavy = mbd.Ply.isotropic(E=E, nu=NU, density=5400.0)
    angles = {"bottom": [0.0], "left": [0.0]}
    light, mixed = (
        profile("l_section", ply=ply, angles=angles, radius=4e-3) for ply in ([STEEL, STEEL], [STEEL, heavy])
    )
    R = 4e-3 + T / 2
    length = H - T / 2 - R + np.pi * R / 4
    assert (mixed.mass() - light.mass())[0, 0].item() == pytest.approx(2700.0 * T * length, rel=1e-5)


@pytest.mark.parametrize(
    ("name", "argument", "sizes"),
    [
        ("c_section", "c_section.height", {"radius": 0.03}),
        ("l_section", "l_section.width", {"radius": 0.04}),
        ("hat_section", "crown", {"crown": 0.03, "radius": 0.006}),
        ("z_section", "radius", {"radius": -1e-3}),
        ("z_section", "radius", {"radius": float("nan")}),
        ("hat_section", "radius", {"radius": float("nan")}),
    ],
)
def test_radii_that_do_not_fit(name, argument, sizes):
    with refused(argument):
        profile(name, **sizes)


def test_a_variable_radius_of_zero_is_refused():
    with refused("radius"):
        profile("c_section", radius=mbd.variable(0.0))


@pytest.mark.parametrize("name", ["c_section", "l_section", "z_section", "hat_section", "t_section"])
def test_angles_may_be_shared_by_sections(name):
    """As of `tube`: one Parameter in several sections of a tapered body."""
    angles = torch.nn.Parameter(mbd.deg([30.0, -45.0]))
    sections = [
        profile(name, ply=mbd.examples.carbon(), angles=angles, thickness=t, cells=(2, 1)) for t in (T / 2, T / 3)
    ]
    for section in sections:
        assert section.angles is angles
        [slope] = torch.autograd.grad(section.stiffness()[0, 0], angles)
        assert bool((slope != 0.0).all())
