"""The entries of a windIO file under one set of names, by the version that the file states.

    version 1                                       version 2
    no windIO_version, or 1.x                       windIO_version 2.0 or 2.1
    outer_shape_bem                                 outer_shape, reference_axis
    internal_structure_2d_fem                       structure
    angles [rad]                                    angles [deg]
    pitch_axis, a part of the chord                 section_offset_y, section_offset_x [m]
    airfoil_position                                outer_shape.airfoils, rthick
    relative_thickness of an airfoil                rthick of an airfoil
    start_nd_arc, end_nd_arc, width, fixed          anchors
Source: windIO 2.1.1, schemas/turbine/turbine_schema.yaml; windIO 1, IEAontology_schema.yaml (IEA Wind Task 37).
Checked in tests/extensions/test_windio_versions.py.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from torchmbd.errors import InputError, warn
from torchmbd.extensions.windio.arcs import AnchorArcs, LayerArcs

_KEYS = {
    "1": ("outer_shape_bem", "internal_structure_2d_fem"),
    "2": ("reference_axis", "outer_shape", "structure"),
}
_MINORS = ("2", "2.0", "2.1")  # of version 2 that are known


@dataclass(frozen=True)
class Entries:
    """A blade's entries, as they are in the file.

    angle       unit of its angles [rad]
    chord, twist, axis, offsets     tables along the span; offsets by their names in the file
    labels, positions               airfoils along the span, and where they lie, if the file says so
    thickness   table of the relative thickness along the span, if there is one
    airfoils    name -> coordinates and relative_thickness
    materials, webs, layers         name -> entry
    arcs        says where layers and webs start and end
    """

    angle: float
    chord: Mapping[str, Any]
    twist: Mapping[str, Any]
    axis: Mapping[str, Any]
    offsets: dict[str, Any]
    labels: list[str]
    positions: list[float] | None
    thickness: Mapping[str, Any] | None
    airfoils: dict[str, Any]
    materials: dict[str, Any]
    webs: dict[str, Any]
    layers: dict[str, Any]
    arcs: LayerArcs | AnchorArcs


def entries(data: Mapping[str, Any]) -> Entries:
    """Return the entries of a file's data; InputError names a version that is not 1 or 2."""
    blade = data["components"]["blade"]
    stated = data.get("windIO_version")
    version = "1" if stated is None else str(stated).strip()
    number = re.fullmatch(r"(\d+)(?:\.\d+)*", version)
    if isinstance(stated, bool) or number is None or number[1] not in ("1", "2"):
        raise InputError("windIO_version", stated, "1 or 2, such as 2.0")
    if stated is None and "outer_shape_bem" not in blade and "outer_shape" in blade:
        raise InputError(
            "windIO_version",
            hint="windIO_version: 2.0",
            allowed="2 where the blade has an outer_shape",
            state="is missing",
        )
    for key in _KEYS[number[1]]:
        if key not in blade:
            raise InputError(("blade", key), allowed=f"given in version {number[1]} of windIO")
    if number[1] == "1":
        return _version_1(data, blade)
    if ".".join(version.split(".")[:2]) not in _MINORS:
        warn(f"windIO_version {version} is read by the rules of version 2.1")
    return _version_2(data, blade)


def _version_1(data: Mapping[str, Any], blade: Mapping[str, Any]) -> Entries:
    inner, shape = blade["internal_structure_2d_fem"], blade["outer_shape_bem"]
    placement = shape["airfoil_position"]
    webs = named("webs", inner.get("webs") or [], "start_nd_arc", "end_nd_arc")
    layers = named("layers", inner["layers"], "material", "thickness")
    return Entries(
        angle=1.0,
        chord=shape["chord"],
        twist=shape["twist"],
        axis=shape["reference_axis"],
        offsets={"pitch_axis": shape["pitch_axis"]},
        labels=list(placement["labels"]),
        positions=placement["grid"],
        thickness=shape.get("rthick"),
        airfoils=named("airfoils", data["airfoils"]),
        materials=named("materials", data["materials"]),
        webs=webs,
        layers=layers,
        arcs=LayerArcs(layers, webs),
    )


def _version_2(data: Mapping[str, Any], blade: Mapping[str, Any]) -> Entries:
    inner, shape = blade["structure"], blade["outer_shape"]
    placement = list(shape["airfoils"])
    positions = [entry.get("spanwise_position") for entry in placement]
    webs = named("webs", inner.get("webs") or [], "start_nd_arc", "end_nd_arc")
    layers = named("layers", inner["layers"], "material", "thickness")
    _warn_of_parts(inner, webs)
    return Entries(
        angle=math.pi / 180.0,
        chord=shape["chord"],
        twist=shape["twist"],
        axis=blade["reference_axis"],
        offsets={"section_offset_y": shape["section_offset_y"]}
        | {key: shape[key] for key in ("section_offset_x",) if key in shape},
        labels=[entry["name"] for entry in placement],
        positions=None if None in positions else positions,
        thickness=shape.get("rthick"),
        airfoils={
            name: {"coordinates": entry["coordinates"], "relative_thickness": entry["rthick"]}
            for name, entry in named("airfoils", data["airfoils"]).items()
        },
        materials=named("materials", data["materials"]),
        webs=webs,
        layers=layers,
        arcs=AnchorArcs(layers, webs, named("anchors", inner["anchors"])),
    )


def _warn_of_parts(inner: Mapping[str, Any], webs: Mapping[str, Any]) -> None:
    """Warn of parts of a section that are not made."""
    if inner.get("trailing_edge_adhesive"):
        warn("the reader leaves out trailing_edge_adhesive, so the sections do not include its mass and stiffness")
    for name, web in webs.items():
        if web.get("flanges"):
            warn(
                f"the reader leaves out the flanges of web {name!r}. So the sections do not include their mass and stiffness"
            )


def named(kind: str, items: Any, *keys: str) -> dict[str, Any]:
    """Return entries by name; InputError if a name is repeated or a key is missing."""
    by_name: dict[str, Any] = {}
    for entry in items:
        name = entry["name"]
        if name in by_name:
            raise InputError((kind, name), allowed="must appear once")
        for key in keys:
            if key not in entry:
                raise InputError((kind, name, key), allowed="given")
        by_name[name] = entry
    return by_name
