"""Sections of windIO blades: a round tube in closed form, a profile with caps and webs, and what is refused."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
import torch
import yaml

import torchmbd as mbd
from tests.refused import ANY, refused, warned
from torchmbd.extensions.windio.blade import WindIOBlade, _loaded
from torchmbd.extensions.windio.contours import Contours

FLAT = [0.0, 1.0]


def along(*values: float) -> dict:
    return {"grid": np.linspace(0.0, 1.0, len(values)).tolist(), "values": list(values)}


def circle(n: int = 101) -> dict:
    t = np.linspace(0.0, 2.0 * np.pi, n)
    return {"x": (0.5 + 0.5 * np.cos(t)).tolist(), "y": (0.5 * np.sin(t)).tolist()}


def wing(thickness: float = 0.3, gap: float = 0.01, n: int = 80) -> dict:
    """A symmetric four-digit profile with a blunt trailing edge."""
    x = 0.5 + 0.5 * np.cos(np.linspace(0.0, np.pi, n))
    y = 5 * thickness * (0.2969 * np.sqrt(x) - 0.126 * x - 0.3516 * x**2 + 0.2843 * x**3 - 0.1036 * x**4) + gap * x / 2
    return {"x": [*x.tolist(), *x[::-1][1:].tolist()], "y": [*y.tolist(), *(-y[::-1][1:]).tolist()]}


def layer(name: str, material: str, thickness: float, angle: float = 0.0, **more) -> dict:
    own = {"name": name, "material": material, "thickness": along(thickness, thickness)}
    return own | {"fiber_orientation": along(angle, angle)} | more


def skin(name: str, material: str, thickness: float, angle: float = 0.0) -> dict:
    return layer(name, material, thickness, angle, start_nd_arc=along(0.0, 0.0), end_nd_arc=along(1.0, 1.0))


MATERIALS = [
    {"name": "steel", "orth": 0, "E": 2e11, "nu": 0.3, "rho": 7850.0},
    {"name": "foam", "orth": 0, "E": 1.3e8, "nu": 0.32, "rho": 130.0},
    {
        "name": "carbon",
        "orth": 1,
        "E": [1.1e11, 8e9, 8e9],
        "G": [6e9, 6e9, 6e9],
        "nu": [0.27, 0.27, 0.27],
        "rho": 1220.0,
    },
]
FULL = [
    skin("outer", "carbon", 2e-3, 0.3),
    layer("cap", "carbon", 0.02, start_nd_arc=along(0.25, 0.25), width=along(0.4, 0.4), end_nd_arc=along(0.35, 0.35)),
    layer("cap_below", "carbon", 0.02, start_nd_arc=along(0.65, 0.65), end_nd_arc=along(0.75, 0.75)),
    layer("edge", "carbon", 4e-3, start_nd_arc={"fixed": "TE"}, width=along(0.3, 0.3)),
    layer("filler", "foam", 0.01, start_nd_arc={"fixed": "edge"}, end_nd_arc={"fixed": "cap"}),
    skin("inner", "carbon", 2e-3),
    layer("web_skin", "carbon", 2e-3, 0.7, web="web"),
    layer("web_core", "foam", 0.02, web="web"),
]
WEBS = [{"name": "web", "start_nd_arc": along(0.3, 0.3), "end_nd_arc": along(0.7, 0.7)}]


@pytest.fixture
def blade(tmp_path):
    """A blade of one airfoil, its chord, layers and webs."""

    def made(airfoil: dict, layers: list, webs: list, chord: float = 2.0, **changed) -> WindIOBlade:
        shape = {
            "airfoil_position": {"grid": FLAT, "labels": ["root", "tip"]},
            "chord": along(chord, chord),
            "twist": along(0.2, 0.0),
            "pitch_axis": along(0.5, 0.5),
            "reference_axis": {axis: along(0.0, 50.0 if axis == "z" else 0.0) for axis in "xyz"},
        }
        names = {"root": 0.31, "tip": 0.3}
        data = {
            "components": {
                "blade": {
                    "outer_shape_bem": shape,
                    "internal_structure_2d_fem": {"layers": layers, "webs": webs},
                }
            },
            "airfoils": [{"name": k, "coordinates": airfoil, "relative_thickness": t} for k, t in names.items()],
            "materials": MATERIALS,
        } | changed
        path = tmp_path / "blade.yaml"
        path.write_text(yaml.safe_dump(data))
        return mbd.io.read_windio(path)

    return made


def test_a_round_tube(blade):
    """Stretch, bending, torsion and mass of a thick tube; two layers of one material are one."""
    layers = [skin("outer", "steel", 0.02), skin("inner", "steel", 0.03)]
    section = blade(circle(), layers, []).section(0.4, cells=80)
    K, M = section.stiffness(), section.mass()
    r, R = 0.95, 1.0
    area, second = math.pi * (R**2 - r**2), math.pi / 4.0 * (R**4 - r**4)
    expected = {0: 2e11 * area, 3: 2e11 / 2.6 * 2.0 * second, 4: 2e11 * second, 5: 2e11 * second}
    for k, x in expected.items():
        assert float(K[k, k]) == pytest.approx(x, rel=4e-3), k
    assert float(M[0, 0]) == pytest.approx(7850.0 * area, rel=3e-3)
    assert float(K[0, 4].abs() + K[0, 5].abs()) < 1e-3 * float(K[0, 0])


@pytest.mark.thorough
def test_a_profile_with_caps_and_a_web(blade):
    """Area of every layer, and the derivative of the torsional stiffness by the fibers' orientations."""
    section = blade(wing(), FULL, WEBS).section(0.5)
    geometry = section.geometry
    area = [float(geometry.weight[geometry.layer == k].sum()) for k in range(len(FULL))]
    points = blade(wing(), FULL, WEBS).contour(0.5) * 2.0
    length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
    assert area[1] == pytest.approx(area[2], rel=1e-2)
    assert area[1] == pytest.approx(0.02 * 0.1 * length, rel=4e-2)  # inside of the curved contour it is shorter
    assert area[0] == pytest.approx(2e-3 * length, rel=2e-2)
    assert 0.93 < area[3] / (4e-3 * 0.3) < 1.0  # walls are cut where the trailing edge is thinner than both
    height = float(np.interp(0.3, np.linspace(0, 1, 3), [0.0, 0.3, 0.6])) * 2.0  # 30 % of the chord or less
    assert 0.5 * height * 2e-3 < area[6] < height * 4e-3
    J = section.stiffness()[3, 3]
    (slope,) = torch.autograd.grad(J, section.angles)
    with torch.no_grad():
        section.angles[0] += 1e-5
        up = section.stiffness()[3, 3]
        section.angles[0] -= 2e-5
        down = section.stiffness()[3, 3]
    assert float(slope[0]) == pytest.approx(float(up - down) / 2e-5, rel=1e-5)
    assert float(slope[0]) > 0.0


@pytest.mark.thorough
def test_caps_carry_along_the_span(blade):
    """E A is that of the layers, each by its area and its modulus along the span."""
    section = blade(wing(), [own | {"fiber_orientation": along(0.0, 0.0)} for own in FULL], WEBS).section(0.5)
    geometry, E = section.geometry, [1.1e11 if own["material"] == "carbon" else 1.3e8 for own in FULL]
    area = [float(geometry.weight[geometry.layer == k].sum()) for k in range(len(FULL))]
    assert float(section.stiffness()[0, 0]) == pytest.approx(sum(a * b for a, b in zip(E, area, strict=True)), rel=2e-3)
    station = blade(wing(), FULL, WEBS).station(0.5)
    assert station == {"chord": 2.0, "twist": 0.1, "pitch_axis": 0.5, "x": 0.0, "y": 0.0, "z": 25.0}


@pytest.mark.parametrize(
    ("layers", "webs", "fault"),
    [
        (FULL[1:5], [], ("layers",)),
        ([skin("outer", "glass", 2e-3)], [], ("materials.glass",)),
        (
            [skin("outer", "steel", 2e-3) | {"thickness": {"grid": FLAT, "values": ["a", 1]}}],
            [],
            ("layers.outer.thickness",),
        ),
        ([layer("outer", "steel", 2e-3, start_nd_arc=along(0.0))], [], ("layers.outer", ANY, "end_nd_arc")),
        (
            [skin("outer", "steel", 2e-3), layer("cap", "steel", 2e-3, start_nd_arc=along(1.1), end_nd_arc=along(1.3))],
            [],
            ("layers.cap", ANY, "0.5", "1.1 to 1"),
        ),
        (
            FULL,
            [WEBS[0] | {"start_nd_arc": along(0.3), "end_nd_arc": along(0.32)}],
            ("webs.web", ANY, "0.3000 to 0.3200"),
        ),
        (FULL, [WEBS[0] | {"start_nd_arc": along(0.0)}], ("webs.web", ANY, "from -0.")),
        ([*FULL[:6], *FULL[6:]], [*WEBS, WEBS[0] | {"name": "other"}], None),
    ],
)
def test_what_is_refused(blade, layers, webs, fault):
    result = blade(wing(), layers, webs)
    if fault is None:
        assert result.section(0.5).mesh.layers > 0
        return
    argument, *facts = fault
    with refused(f"blade.yaml.{argument}", *facts):
        result.section(0.5)


@pytest.mark.thorough
def test_what_reaches_beyond_the_contour_is_cut_off_with_a_warning(blade):
    def area(start: float) -> float:
        cap = layer("cap", "steel", 2e-3, start_nd_arc=along(start), end_nd_arc=along(0.2))
        section = blade(wing(), [skin("outer", "steel", 2e-3), cap], []).section(0.5)
        return float(section.stiffness()[0, 0])

    with warned("layer 'cap' at 0.5", "-0.1 to 0.2"):
        assert area(-0.1) == pytest.approx(area(0.0), rel=1e-12)


@pytest.mark.thorough
def test_a_blade_of_one_airfoil(blade):
    """The same airfoil at both ends, or one alone: its own contour everywhere."""
    airfoils = {"root": {"coordinates": wing(), "relative_thickness": 0.3}}
    result = blade(wing(), FULL, WEBS)
    for labels, grid in ((["root", "root"], FLAT), (["root"], [0.0])):
        result._contours = Contours(labels, grid, airfoils)
        x, y = result.contour(0.37).T
        expected = np.interp(x[:100][::-1], wing()["x"][79::-1], wing()["y"][79::-1])
        np.testing.assert_allclose(y[:100][::-1], expected, atol=2e-3)
        assert result.section(0.37).mesh.layers > 0


@pytest.mark.parametrize(
    ("layers", "webs", "changed", "fault"),
    [
        (FULL, [], {}, (".layers.web_skin.web", "web")),
        (FULL, [{"name": "web", "end_nd_arc": along(0.7)}], {}, (".webs.web.start_nd_arc",)),
        ([FULL[0], FULL[0]], [], {}, (".layers.outer", ANY, "once")),
        ([{"name": "outer", "thickness": along(1e-3)}], [], {}, (".layers.outer.material",)),
        (
            FULL,
            WEBS,
            {"airfoils": [{"name": k, "relative_thickness": 0.3} for k in ("root", "tip")]},
            ("", ANY, "'coordinates'"),
        ),
        (
            FULL,
            WEBS,
            {"airfoils": [{"name": k, "relative_thickness": "x"} for k in ("root", "tip")]},
            ("", ANY, "'x'"),
        ),
        (
            FULL,
            WEBS,
            {"airfoils": [{"name": "root", "relative_thickness": float("nan")}] * 2},
            (".airfoils.root", ANY, "once"),
        ),
    ],
)
def test_what_a_blade_lacks_is_named(blade, layers, webs, changed, fault):
    argument, *facts = fault
    with refused(f"blade.yaml{argument}", *facts):
        blade(wing(), layers, webs, **changed)


@pytest.mark.parametrize("key", ["E", "nu", "rho"])
def test_a_number_that_a_material_lacks_has_no_default(blade, key):
    steel = {name: value for name, value in MATERIALS[0].items() if name != key}
    result = blade(wing(), [skin("outer", "steel", 2e-3)], [], materials=[steel])
    with refused("blade.yaml.materials.steel", ANY, key):
        result.section(0.5)


@pytest.mark.parametrize("y", [[0.0], [0.0, float("nan"), 0.0], [0.0, 0.1, 0.0, 0.2]], ids=["one", "nan", "more"])
def test_coordinates_that_are_none(blade, y):
    with refused("blade.yaml.airfoils.root.coordinates"):
        blade({"x": [1.0, 0.0, 1.0][: len(y)], "y": y}, FULL, WEBS)


@pytest.mark.parametrize(
    "text",
    [
        "[" * 200_000,
        "- " * 200_000,
        "a: &a [x,x,x,x,x,x,x,x,x]\n"
        + "".join(f"{b}: &{b} [{','.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)),
    ],
    ids=["brackets", "lists", "aliases"],
)
def test_hostile_files(tmp_path, text):
    """Neither a deep nor a multiplied file is built."""
    path = tmp_path / "x.yaml"
    path.write_text(text)
    with refused("x.yaml.data"):
        mbd.io.read_windio(path)


def test_a_tip_without_chord(blade):
    with refused("blade.yaml.chord", 0.0):
        blade(wing(), FULL, WEBS, chord=0.0).section(1.0)


def test_files_that_are_no_blade(tmp_path, blade):
    for text in ("", "[1, 2", "a: {b: c}", "components: {blade: 3}", "&a [*a]", "\x00"):
        path = tmp_path / "x.yaml"
        path.write_text(text)
        with refused("x.yaml"):
            mbd.io.read_windio(path)
    with refused("path"):
        mbd.io.read_windio(tmp_path / "none.yaml")
    with refused("position"):
        blade(circle(), [skin("outer", "steel", 0.02)], []).section(2.0)


@pytest.mark.parametrize(
    ("options", "path"), [({"cells": 0}, "cells"), ({"cells": "a"}, "cells"), ({"order": 3}, "order")]
)
def test_numbers_of_elements_that_are_refused(blade, options, path):
    with refused(path):
        blade(circle(), [skin("outer", "steel", 0.02)], []).section(0.5, **options)


def test_linear_elements_give_nearly_the_same_section(blade):
    result = blade(circle(), [skin("outer", "steel", 0.02)], [])
    linear, quadratic = (result.section(0.5, order=order).stiffness().diagonal().detach() for order in (1, 2))
    assert float((linear / quadratic - 1.0).abs().max()) < 2e-3


@pytest.mark.thorough
def test_a_layer_round_the_trailing_edge_is_two_layers(blade):
    """Its start is above its end; the wall that closes the edge has it once, of two layers both."""
    outer = skin("outer", "steel", 2e-3)
    whole = layer("edge", "steel", 2e-3, start_nd_arc=along(0.94), end_nd_arc=along(0.06))
    parts = [
        layer(f"edge_{a}", "steel", 2e-3, start_nd_arc=along(a), end_nd_arc=along(b))
        for a, b in ((0.94, 1.0), (0.0, 0.06))
    ]
    result = [blade(wing(), [outer, *own], []).section(0.5) for own in ([whole], parts)]
    masses = [float(section.mass()[0, 0]) for section in result]
    assert masses[0] == pytest.approx(masses[1], rel=1e-2)
    assert masses[0] < masses[1]
    plain = float(blade(wing(), [outer], []).section(0.5).mass()[0, 0])
    points = blade(wing(), [outer], []).contour(0.5) * 2.0
    length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
    extra = 7850.0 * 2e-3 * 0.12 * length
    assert 0.8 * extra < masses[0] - plain < 1.05 * extra  # walls are cut where the edge is thinner than both


def test_layers_without_orientation_lie_along_the_blade(blade):
    """The schema's default of fiber_orientation is zero."""
    bare = {key: x for key, x in skin("outer", "carbon", 2e-3).items() if key != "fiber_orientation"}
    section, expected = (blade(wing(), [own], []).section(0.5) for own in (bare, skin("outer", "carbon", 2e-3)))
    assert section.angles.tolist() == [0.0]
    torch.testing.assert_close(section.stiffness(), expected.stiffness())


@pytest.mark.thorough
def test_an_anchor_may_be_defined_again(tmp_path, blade):
    """As in YAML 1.2: an alias names the definition before it, also where the blade uses them."""
    outer = skin("outer", "steel", 2e-3)
    expected = float(blade(wing(), [outer], []).section(0.5).mass()[0, 0])
    path = tmp_path / "blade.yaml"
    text = path.read_text()
    path.write_text("a: &g [7, 9]\nb: &g [0.0, 1.0]\nc: *g\n" + text)
    assert float(mbd.io.read_windio(path).section(0.5).mass()[0, 0]) == pytest.approx(expected, rel=1e-14)
    assert _loaded(path.read_text())["c"] == [0.0, 1.0]


@pytest.mark.thorough
@pytest.mark.parametrize("gap", [0.002, 0.01])
@pytest.mark.parametrize("end", [0.9955, 0.9971, 0.9976, 0.9983, 0.9992])
@pytest.mark.parametrize("side", ["start", "end"])
def test_a_layer_that_ends_shortly_before_the_trailing_edge(side, end, gap, blade):
    """Its mass is that of one which ends there, within 0.1 % of the section; from both sides."""
    ends = (0.0, end) if side == "end" else (1.0 - end, 1.0)
    inner = layer("inner", "steel", 2e-3, start_nd_arc=along(ends[0]), end_nd_arc=along(ends[1]))
    result = float(blade(wing(0.18, gap), [skin("outer", "steel", 6e-3), inner], []).section(0.5).mass()[0, 0])
    whole = float(
        blade(wing(0.18, gap), [skin("outer", "steel", 6e-3), skin("inner", "steel", 2e-3)], [])
        .section(0.5)
        .mass()[0, 0]
    )
    length = float(np.linalg.norm(np.diff(blade(wing(0.18, gap), [], []).contour(0.5) * 2.0, axis=0), axis=1).sum())
    assert result == pytest.approx(whole - 7850.0 * 2e-3 * (1.0 - end) * length, rel=2e-3)


@pytest.mark.thorough
@pytest.mark.parametrize("core", [0.03, 0.06, 0.09])
@pytest.mark.parametrize("ends", [(0.43, 0.57), (0.43, 0.492), (0.502, 0.58)])
def test_a_core_thicker_than_the_radius_of_the_nose(core, ends, blade):
    """The radius is 4 % of the chord: the mesh stays valid, and the wall is thinner where there is no room."""
    core_layer = layer("core", "foam", core, start_nd_arc=along(ends[0]), end_nd_arc=along(ends[1]))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        section = blade(
            wing(0.18), [skin("outer", "steel", 1.5e-3), core_layer, skin("inner", "steel", 1.5e-3)], []
        ).section(0.5)
    area = float(section.geometry.weight[section.geometry.layer == 1].sum())
    length = float(np.linalg.norm(np.diff(blade(wing(0.18), [], []).contour(0.5) * 2.0, axis=0), axis=1).sum())
    assert 0.1 * core * (ends[1] - ends[0]) * length < area < core * (ends[1] - ends[0]) * length
    assert float(torch.linalg.eigvalsh(section.stiffness())[0]) > 0.0


def wall_mass(points: np.ndarray, layers: list[tuple[float, float, float]]) -> float:
    """Mass per length [kg/m] of thin layers (kg/m2, and the parts of the contour where they start and end)."""
    length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
    return length * sum(area * max(end - start, 0.0) for area, start, end in layers)


@pytest.mark.thorough
@pytest.mark.parametrize(
    "cap", [0.2, 0.155, 0.1505, 0.15, 0.1499, 0.149, 0.12, 0.05], ids=lambda cap: f"room {cap - 0.15:+.4f}"
)
def test_a_filler_between_layers_that_overlap_is_left_out(cap, blade):
    layers = [
        skin("outer", "steel", 2e-3),
        layer("edge", "steel", 1e-3, start_nd_arc={"fixed": "TE"}, end_nd_arc=along(0.15)),
        layer("cap", "steel", 4e-3, start_nd_arc=along(cap), end_nd_arc=along(0.4)),
        layer("filler", "foam", 0.02, start_nd_arc={"fixed": "edge"}, end_nd_arc={"fixed": "cap"}),
    ]
    airfoil = circle()
    result = blade(airfoil, layers, [])
    if cap < 0.149:
        with warned("'filler' at 0.5", "0.15"):
            mass = float(result.section(0.5).mass()[0, 0])
    else:
        mass = float(result.section(0.5).mass()[0, 0])
    steel = [(7850.0 * t, a, b) for t, a, b in ((2e-3, 0.0, 1.0), (1e-3, 0.0, 0.15), (4e-3, cap, 0.4))]
    expected = wall_mass(2.0 * result.contour(0.5), [*steel, (130.0 * 0.02, 0.15, cap)])
    assert mass == pytest.approx(expected, rel=8e-3)


@pytest.mark.thorough
@pytest.mark.parametrize("position", [0.0, 0.5, 0.66, 2 / 3, 0.67, 0.7, 1.0])
def test_a_layer_that_tapers_to_nothing(position, blade):
    cap = layer("cap", "steel", 4e-3, start_nd_arc=along(0.4, 0.55), end_nd_arc=along(0.6, 0.45))
    result = blade(circle(), [skin("outer", "steel", 2e-3), cap], [])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mass = float(result.section(position).mass()[0, 0])
    width = 0.2 - 0.3 * position
    expected = wall_mass(2.0 * result.contour(0.5), [(7850.0 * 2e-3, 0.0, 1.0), (7850.0 * 4e-3, 0.0, width)])
    assert mass == pytest.approx(expected, rel=8e-3)


@pytest.mark.thorough
@pytest.mark.parametrize("width", [0.0, 1e-5, 1e-4, 3e-4, 1e-3, 2e-3, 5e-3])
def test_a_narrow_layer_has_its_mass(width, blade):
    cap = layer("cap", "steel", 4e-3, start_nd_arc=along(0.3), end_nd_arc=along(0.3 + width))
    plain, result = (blade(circle(), layers, []) for layers in ([FULL[0]], [FULL[0], cap]))
    added = float(result.section(0.5).mass()[0, 0] - plain.section(0.5).mass()[0, 0])
    full = wall_mass(2.0 * plain.contour(0.5), [(7850.0 * 4e-3, 0.0, 1.0)])
    assert added == pytest.approx(width * full, abs=1e-3 * full)


@pytest.mark.thorough
@pytest.mark.parametrize("place", [0.3, 0.5, 0.9, 1.0])
def test_a_web_without_height_is_left_out_with_a_warning(place, blade):
    webs = [{"name": "web", "start_nd_arc": along(0.3, place), "end_nd_arc": along(0.7, place)}]
    outer = skin("outer", "steel", 2e-3)
    result = blade(wing(), [outer, *FULL[6:]], webs)
    with warned("web 'web' at 1"):
        mass = float(result.section(1.0).mass()[0, 0])
    assert mass == pytest.approx(float(blade(wing(), [outer], []).section(1.0).mass()[0, 0]), rel=1e-3)


def test_two_airfoils_of_one_thickness_blend_along_the_span():
    """Between them the contour is linear along the span; a third airfoil changes nothing there."""
    upper = wing(0.3)
    lower = {"x": upper["x"], "y": (0.5 * np.array(upper["y"])).tolist()}
    shapes = (("a", upper, 0.3), ("b", lower, 0.3), ("c", wing(0.1), 0.1))
    airfoils = {k: {"coordinates": x, "relative_thickness": t} for k, x, t in shapes}
    contour = Contours(["a", "b", "c"], [0.0, 0.6, 1.0], airfoils)
    first, second, last = (contour(x) for x in (0.0, 0.6, 1.0))
    np.testing.assert_allclose(second[:, 1], 0.5 * first[:, 1], atol=1e-12)
    np.testing.assert_allclose(contour(0.15), 0.75 * first + 0.25 * second, atol=1e-12)
    assert second[:, 1].max() > contour(0.8)[:, 1].max() > last[:, 1].max()
