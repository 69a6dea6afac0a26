"""One blade in windIO 1 and 2 has equal sections; anchors, airfoils, units; an open trailing edge; refusals."""

from __future__ import annotations

import copy
import math
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

import torchmbd as mbd
from tests.extensions.test_windio import MATERIALS, along, layer, skin, wing
from tests.refused import ANY, refused, warned
from torchmbd.errors import InputError

CHORD, OFFSET, TWIST, FIBERS = (3.0, 1.0), (0.4, 0.4), (0.27, -0.02), 0.3
AIRFOILS = {"root": (wing(0.4, 0.06, 40), 0.4), "tip": (wing(0.2, 0.02, 40), 0.2)}
AXIS = {axis: along(0.0, 50.0 if axis == "z" else 0.0) for axis in "xyz"}


def version_1() -> dict:
    """A blade with an open trailing edge, caps, reinforcements of a width, fillers and a web."""
    layers = [
        skin("outer", "carbon", 2e-3, FIBERS),
        layer("cap", "carbon", 0.01, start_nd_arc=along(0.25, 0.27), end_nd_arc=along(0.35, 0.33)),
        layer("cap_below", "carbon", 0.01, start_nd_arc=along(0.65, 0.66), end_nd_arc=along(0.75, 0.74)),
        layer("edge", "carbon", 4e-3, start_nd_arc={"fixed": "TE"}, width=along(0.3, 0.1)),
        layer("filler", "foam", 0.01, start_nd_arc={"fixed": "edge"}, end_nd_arc={"fixed": "cap"}),
        skin("inner", "carbon", 2e-3),
        layer("web_skin", "carbon", 2e-3, -FIBERS, web="web"),
        layer("web_core", "foam", 0.01, web="web"),
    ]
    shape = {
        "airfoil_position": {"grid": [0.0, 1.0], "labels": list(AIRFOILS)},
        "chord": along(*CHORD),
        "twist": along(*TWIST),
        "pitch_axis": along(*OFFSET),
        "reference_axis": AXIS,
        "rthick": along(0.4, 0.2),
    }
    web = {"name": "web", "start_nd_arc": along(0.3, 0.3), "end_nd_arc": along(0.7, 0.7)}
    return {
        "components": {
            "blade": {"outer_shape_bem": shape, "internal_structure_2d_fem": {"layers": layers, "webs": [web]}}
        },
        "airfoils": [{"name": k, "coordinates": x, "relative_thickness": t} for k, (x, t) in AIRFOILS.items()],
        "materials": MATERIALS,
    }


def at(name: str, side: str) -> dict:
    return {"anchor": {"name": name, "handle": f"{side}_nd_arc"}}


def version_2() -> dict:
    """The blade of `version_1` by the schema of version 2."""
    ends = {
        "outer": (("TE", "start"), ("TE", "end")),
        "cap": (("cap", "start"), ("cap", "end")),
        "cap_below": (("cap_below", "start"), ("cap_below", "end")),
        "edge": (("TE", "start"), ("edge", "end")),
        "filler": (("edge", "end"), ("cap", "start")),
        "inner": (("TE", "start"), ("TE", "end")),
        "web_skin": (("whole", "start"), ("whole", "end")),
        "web_core": (("whole", "start"), ("whole", "end")),
    }
    layers = []
    for entry in version_1()["components"]["blade"]["internal_structure_2d_fem"]["layers"]:
        kept = {key: x for key, x in entry.items() if key in ("name", "material", "thickness", "web")}
        degrees = [math.degrees(x) for x in entry["fiber_orientation"]["values"]]
        start, end = ends[entry["name"]]
        layers.append(kept | {"fiber_orientation": along(*degrees), "start_nd_arc": at(*start), "end_nd_arc": at(*end)})
    anchors = [
        {"name": "TE", "start_nd_arc": along(0.0, 0.0), "end_nd_arc": along(1.0, 1.0)},
        {"name": "cap", "start_nd_arc": along(0.25, 0.27), "end_nd_arc": along(0.35, 0.33)},
        {"name": "cap_below", "start_nd_arc": along(0.65, 0.66), "end_nd_arc": along(0.75, 0.74)},
        {"name": "edge", "start_nd_arc": at("TE", "start"), "width": along(0.3, 0.1) | {"defines": ["end_nd_arc"]}},
        {"name": "shear", "start_nd_arc": along(0.3, 0.3), "end_nd_arc": along(0.7, 0.7)},
    ]
    whole = {"name": "whole", "start_nd_arc": along(0.0, 0.0), "end_nd_arc": along(1.0, 1.0)}
    web = {"name": "web", "start_nd_arc": at("shear", "start"), "end_nd_arc": at("shear", "end"), "anchors": [whole]}
    s = np.linspace(0.0, 1.0, 201)
    chord = np.interp(s, [0.0, 1.0], CHORD)
    shape = {
        "chord": along(*CHORD),
        "twist": along(*(math.degrees(x) for x in TWIST)),
        "section_offset_y": along(*(chord * np.interp(s, [0.0, 1.0], OFFSET)).tolist()),
        "rthick": along(0.4, 0.2),
        "airfoils": [{"name": k, "spanwise_position": x} for k, x in zip(AIRFOILS, (0.0, 1.0), strict=True)],
    }
    return {
        "windIO_version": "2.0",
        "components": {
            "blade": {
                "reference_axis": AXIS,
                "outer_shape": shape,
                "structure": {"layers": layers, "webs": [web], "anchors": anchors},
            }
        },
        "airfoils": [{"name": k, "coordinates": x, "rthick": t} for k, (x, t) in AIRFOILS.items()],
        "materials": MATERIALS,
    }


def read(folder: Path, data: dict):
    path = folder / "blade.yaml"
    path.write_text(yaml.safe_dump(data))
    return mbd.io.read_windio(path)


def parts(data: dict) -> tuple[dict, dict]:
    """Outer shape and structure of version 2."""
    blade = data["components"]["blade"]
    return blade["outer_shape"], blade["structure"]


def named(entries: list, name: str) -> dict:
    return next(entry for entry in entries if entry["name"] == name)


@pytest.mark.thorough
@pytest.mark.parametrize("position", [0.0, 0.37, 1.0])
def test_a_blade_in_both_versions_has_equal_sections(position, tmp_path):
    """Degrees become radians, meters parts of the chord, and anchors ends of layers."""
    first, second = (read(tmp_path, data) for data in (version_1(), version_2()))
    assert second.station(position) == pytest.approx(first.station(position), rel=1e-12)
    sections = [blade.section(position, cells=24, order=1) for blade in (first, second)]
    assert sections[1].angles.tolist() == pytest.approx(sections[0].angles.tolist(), abs=1e-15)
    with torch.no_grad():
        for matrices in ([x.stiffness() for x in sections], [x.mass() for x in sections]):
            torch.testing.assert_close(matrices[1], matrices[0], rtol=1e-9, atol=1e-9 * float(matrices[0].abs().max()))


def test_angles_are_in_degrees(tmp_path):
    blade = read(tmp_path, version_2())
    assert blade.station(0.0)["twist"] == pytest.approx(TWIST[0], rel=1e-14)
    assert blade.section(0.5, cells=12, order=1).angles.tolist()[0] == pytest.approx(FIBERS, rel=1e-14)


def test_version_1_may_be_stated(tmp_path):
    assert read(tmp_path, version_1() | {"windIO_version": 1.0}).station(0.0)["twist"] == TWIST[0]


@pytest.mark.parametrize("version", [3, 3.0, "3.0", "0.9", "20", "v2", "", True, float("nan"), [2], "2.x"])
def test_other_versions_are_refused(version, tmp_path):
    with refused("blade.yaml.windIO_version", version):
        read(tmp_path, version_2() | {"windIO_version": version})


@pytest.mark.parametrize("version", [2, 2.0, "2.0", "2.1", "2.1.1"])
def test_versions_that_are_read(version, tmp_path):
    assert read(tmp_path, version_2() | {"windIO_version": version}).station(0.0)["twist"] == pytest.approx(TWIST[0])


def test_a_later_version_2_is_read_with_a_warning(tmp_path):
    with warned("windIO_version 2.7", "2.1"):
        read(tmp_path, version_2() | {"windIO_version": "2.7"})


def test_a_version_that_is_missing_or_wrong_is_named(tmp_path):
    data = version_2()
    del data["windIO_version"]
    with refused("blade.yaml.windIO_version", ANY, "outer_shape"):
        read(tmp_path, data)
    with refused("blade.yaml.blade.reference_axis", ANY, "version 2"):
        read(tmp_path, version_1() | {"windIO_version": "2.0"})


OFFSETS = [
    ("end_nd_arc", {"width": along(0.3, 0.3) | {"defines": ["end_nd_arc"]}, "start_nd_arc": at("cap", "start")}),
    ("end_nd_arc", {"offset_arc": along(0.3, 0.3) | {"defines": "end_nd_arc"} | at("cap", "start")}),
    ("start_nd_arc", {"offset_arc": along(-0.3, -0.3) | {"defines": "start_nd_arc"} | at("cap", "end")}),
    ("start_nd_arc", {"width": along(0.3, 0.3) | {"defines": ["start_nd_arc"]}, "end_nd_arc": at("cap", "end")}),
    (
        "end_nd_arc",
        {"width": along(0.6, 0.6) | {"defines": ["start_nd_arc", "end_nd_arc"]}, "midpoint_nd_arc": at("cap", "start")},
    ),
]


@pytest.mark.parametrize(("handle", "anchor"), OFFSETS)
def test_anchors_by_lengths(handle, anchor, tmp_path):
    """A length [m] over the length of the contour with its trailing edge, from another anchor."""
    data = version_2()
    _, structure = parts(data)
    structure["anchors"].append({"name": "new"} | anchor)
    entry = named(structure["layers"], "cap_below")
    entry["start_nd_arc"], entry["end_nd_arc"] = at("cap", "start"), at("cap", "end")
    entry[handle] = at("new", handle.partition("_")[0])
    blade = read(tmp_path, data)
    p = 2.0 * blade.contour(0.5)
    around = float(np.linalg.norm(np.diff(np.concatenate([p, p[:1]]), axis=0), axis=1).sum())
    expected = 0.26 + 0.3 / around if handle == "end_nd_arc" else 0.34 - 0.3 / around
    profile = blade._profile(0.5)
    assert blade._arcs.layer("cap_below", handle.partition("_")[0], 0.5, profile) == pytest.approx(expected, rel=1e-12)


def test_an_anchor_by_a_part_of_the_contour(tmp_path):
    data = version_2()
    _, structure = parts(data)
    offset = along(0.05, 0.07) | {"defines": "end_nd_arc"} | at("cap", "start")
    structure["anchors"].append({"name": "new", "offset_nd_arc": offset})
    named(structure["layers"], "cap")["end_nd_arc"] = at("new", "end")
    blade = read(tmp_path, data)
    assert blade._arcs.layer("cap", "end", 0.5, blade._profile(0.5)) == pytest.approx(0.26 + 0.06, rel=1e-12)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda s: s["anchors"].pop(1), ("layers.cap.start_nd_arc.anchor", "cap")),
        (
            lambda s: named(s["layers"], "cap").pop("end_nd_arc"),
            ("layers.cap.end_nd_arc",),
        ),
        (
            lambda s: named(s["layers"], "cap").update(start_nd_arc=along(0.2, 0.2)),
            ("layers.cap.start_nd_arc", ANY, "must be an anchor"),
        ),
        (
            lambda s: named(s["layers"], "cap").update(start_nd_arc=at("cap", "middle")),
            ("layers.cap.start_nd_arc.handle", "middle_nd_arc"),
        ),
        (
            lambda s: named(s["anchors"], "cap").update(start_nd_arc=at("cap", "start")),
            ("anchors.cap.start_nd_arc", ANY, "itself"),
        ),
        (
            lambda s: named(s["anchors"], "edge").pop("width"),
            ("anchors.edge.end_nd_arc", ANY, "plane_intersection"),
        ),
        (
            lambda s: s["webs"][0]["anchors"][0].update(end_nd_arc=along(0.6, 0.6)),
            ("layers.web_skin.end_nd_arc", 0.6, "must be 1 at 0.5"),
        ),
        (lambda s: s["webs"][0].pop("anchors"), ("layers.web_skin.start_nd_arc.anchor", "whole")),
        (
            lambda s: named(s["layers"], "cap").update(thickness={"grid": [[0.0, 1.0]], "values": [[0.1, 0.1]]}),
            ("layers.cap.thickness", ANY, "rising"),
        ),
    ],
)
def test_structures_that_are_refused(change, fault, tmp_path):
    data = copy.deepcopy(version_2())
    change(parts(data)[1])
    argument, *facts = fault
    with refused(f"blade.yaml.{argument}", *facts):
        read(tmp_path, data).section(0.5, cells=12, order=1)


@pytest.mark.thorough
def test_entries_of_a_wrong_kind_are_named(tmp_path):
    """Each entry of an anchor, and of what refers to one, as None and as a number."""
    data = version_2()
    structure = parts(data)[1]
    cases = [(anchor, key) for anchor in structure["anchors"][1::2] for key in anchor]
    cases += [(structure["webs"][0], "anchors"), (named(structure["anchors"], "edge")["width"], "defines")]
    cases += [(structure["layers"][1]["start_nd_arc"]["anchor"], key) for key in ("name", "handle")]
    cases += [(structure["layers"][1]["thickness"], "grid")]
    for entry, key in cases:
        kept = entry[key]
        for wrong in (None, 3):
            if (key, wrong) == ("anchors", None):
                continue
            entry[key] = wrong
            with pytest.raises(InputError, match=r"blade\.yaml"):
                read(tmp_path, data).section(0.5, cells=6, order=1)
        entry[key] = kept
    read(tmp_path, data).section(0.5, cells=6, order=1)


@pytest.mark.thorough
def test_parts_that_are_not_made_are_warned_of(tmp_path):
    data = version_2()
    parts(data)[1]["trailing_edge_adhesive"] = {"material": "foam"}
    with warned("trailing_edge_adhesive"):
        read(tmp_path, data)
    data = version_2()
    parts(data)[1]["webs"][0]["flanges"] = [{"type": "L", "side": "both"}]
    with warned("flanges", "web 'web'"):
        read(tmp_path, data)


@pytest.mark.thorough
def test_airfoils_are_placed_by_their_relative_thickness(tmp_path):
    """`rthick` dominates where airfoils have positions, and places them where they have none."""
    data = version_2()
    shape, _ = parts(data)
    shape["rthick"] = along(0.4, 0.35, 0.2)
    placed = read(tmp_path, data).contour(0.5)
    root, tip = (read(tmp_path, data).contour(x) for x in (0.0, 1.0))
    np.testing.assert_allclose(placed, 0.75 * root + 0.25 * tip, atol=1e-12)
    shape["airfoils"] = [{"name": name} for name in AIRFOILS]
    np.testing.assert_allclose(read(tmp_path, data).contour(0.5), placed, atol=1e-15)
    shape["airfoils"] = [{"name": name} for name in ("root", "tip", "root")]
    with refused("blade.yaml.airfoils", ANY, "spanwise_position", "rise and fall"):
        read(tmp_path, data)
    shape["airfoils"] = [{"name": name} for name in AIRFOILS]
    shape["rthick"] = along(0.5, 0.2)
    with refused("rthick", 0.5):
        read(tmp_path, data).contour(0.0)
    del shape["rthick"]
    with refused("blade.yaml.airfoils", ANY, "spanwise_position", "rthick"):
        read(tmp_path, data)


@pytest.mark.thorough
def test_an_offset_of_the_chord_line_moves_the_section(tmp_path):
    """Positive: to the suction side. The mass center moves with it, and the section is the one moved."""
    data = version_2()
    plain = read(tmp_path, data).section(0.5, cells=12, order=1).mass().detach()
    parts(data)[0]["section_offset_x"] = along(0.1, 0.3)
    moved = read(tmp_path, data).section(0.5, cells=12, order=1).mass().detach()
    assert float(moved[0, 0]) == pytest.approx(float(plain[0, 0]), rel=1e-12)
    # u_x = -y theta_z: the element (u_x, theta_z) of the matrix is -m y
    assert float(plain[0, 5] - moved[0, 5]) == pytest.approx(0.2 * float(plain[0, 0]), rel=1e-9)


@pytest.mark.thorough
@pytest.mark.parametrize("version", [version_1, version_2])
def test_positions_start_in_the_middle_of_an_open_trailing_edge(version, tmp_path):
    """The mass center of a short thin cap, beside the point at its position from the middle of the edge."""

    def mass(thickness: float) -> torch.Tensor:
        data = version()
        blade = data["components"]["blade"]
        structure = blade.get("structure") or blade["internal_structure_2d_fem"]
        structure["layers"] = structure["layers"][:2]
        structure["webs"] = []
        structure["layers"][1]["thickness"] = along(thickness, thickness)
        owner = structure["layers"][1] if version is version_1 else named(structure["anchors"], "cap")
        owner["start_nd_arc"], owner["end_nd_arc"] = along(0.09, 0.09), along(0.11, 0.11)
        return read(tmp_path, data).section(0.0, cells=24, order=1).mass().detach()

    added = mass(1e-3) - mass(0.0)
    p = read(tmp_path, version()).contour(0.0) * CHORD[0] - np.array([OFFSET[0] * CHORD[0], 0.0])
    middle = 0.5 * (p[0] + p[-1])
    around = np.concatenate([[middle], p, [middle]])
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(around, axis=0), axis=1))])
    z = float(np.interp(0.1 * arc[-1], arc, around[:, 0]))
    assert float(added[0, 4] / added[0, 0]) == pytest.approx(z, abs=4e-3)  # u_x = z theta_y; the edge is 0.18 m wide
