"""Positions along the contour where layers and webs start and end.

Both classes answer `layer(name, side, position, profile)` and `web(name, side, position, profile)`: the position along the
contour at a part of the span, for a side ("start" or "end"). Positions are parts of the contour with its trailing edge. They
start in the middle of the edge, run over the suction side, and are 1 in the middle of the edge again. A width is laid off along
the contour, so beside the trailing edge it starts at the edge's end.
`LayerArcs` has the rules of windIO 1, where layers say themselves what they lie beside; `AnchorArcs` those of windIO 2, where
layers and webs refer to anchors.
Checked in tests/extensions/test_windio.py, tests/extensions/test_windio_versions.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torchmbd.errors import InputError, Path, unknown
from torchmbd.extensions.windio.profile import Profile
from torchmbd.extensions.windio.span_values import span_values

TRAILING_EDGE = {"start": 0.0, "end": 1.0}
_OTHER = {"start": "end", "end": "start"}
_SIGN = {"start": -1.0, "end": 1.0}
_ROUNDING = 1e-6  # of a web: a layer with an end as near to the web's reaches it
_HANDLES = ("start_nd_arc", "end_nd_arc", "midpoint_nd_arc")
_LENGTHS = ("offset_nd_arc", "offset_arc", "width")


class LayerArcs:
    """Rules of windIO 1: a layer has `start_nd_arc` and `end_nd_arc`, or one and `width`; `fixed` names a neighboring layer."""

    def __init__(self, layers: Mapping[str, Any], webs: Mapping[str, Any]) -> None:
        self._layers, self._webs = layers, webs

    def web(self, name: str, side: str, position: float, profile: Profile) -> float:
        """Return the position along the contour where a web starts or ends."""
        return span_values(("webs", name, f"{side}_nd_arc"), self._webs[name][f"{side}_nd_arc"])(position)

    def layer(self, name: str, side: str, position: float, profile: Profile, depth: int = 0) -> float:
        """Return the position along the contour where a layer starts or ends; `fixed` names an edge, or a neighboring layer."""
        layer, other = self._layers[name], _OTHER[side]
        arc = layer.get(f"{side}_nd_arc")
        if arc is not None:
            fixed = arc.get("fixed")
            if fixed == "TE":
                return TRAILING_EDGE[side]
            if fixed in self._layers and depth < len(self._layers):
                return self.layer(fixed, other, position, profile, depth + 1)
            if fixed is not None:
                raise InputError(("layers", name, f"{side}_nd_arc", "fixed"), fixed, "TE, or the name of a layer")
            return span_values(("layers", name, f"{side}_nd_arc"), arc)(position)
        if "width" not in layer or depth > len(self._layers):
            raise InputError(
                ("layers", name),
                allowed="must have start_nd_arc and end_nd_arc, or one of them and width",
                noun=f"layer {name!r}",
                state=f"has no {side}_nd_arc",
            )
        width = span_values(("layers", name, "width"), layer["width"])(position, 0.0) / profile.around
        beside = self.layer(name, other, position, profile, len(self._layers) + 1)
        return profile.off_edge(beside) + _SIGN[side] * width

    def whole_web(self, name: str, position: float) -> None:
        """Layers of webs cover them from end to end in windIO 1."""


class AnchorArcs:
    """Rules of windIO 2: `start_nd_arc` and `end_nd_arc` of layers and webs refer to handles of anchors.

    A handle has numbers along the span, refers to another handle, or follows from `width`, `offset_arc` or `offset_nd_arc`.
    `plane_intersection` is not computed: InputError names an anchor that has nothing else.
    """

    def __init__(self, layers: Mapping[str, Any], webs: Mapping[str, Any], anchors: Mapping[str, Any]) -> None:
        self._layers, self._webs, self._anchors = layers, webs, anchors
        self._of_webs = {name: {x["name"]: x for x in web.get("anchors") or []} for name, web in webs.items()}
        for name, anchor in (*anchors.items(), *(x for known in self._of_webs.values() for x in known.items())):
            for key in (*_HANDLES, *_LENGTHS):
                if key in anchor and not isinstance(anchor[key], Mapping):
                    raise InputError(("anchors", name, key), anchor[key], "must have grid and values, or an anchor")
            defines = anchor.get("width", {}).get("defines", [])
            if not isinstance(defines, list):
                path = ("anchors", name, "width", "defines")
                raise InputError(path, defines, f"a list of {', '.join(_HANDLES)}")

    def web(self, name: str, side: str, position: float, profile: Profile) -> float:
        """Return the position along the contour where a web starts or ends."""
        return self._end(("webs", name), self._webs[name], side, position, profile)

    def layer(self, name: str, side: str, position: float, profile: Profile) -> float:
        """Return the position along the contour where a layer starts or ends."""
        return self._end(("layers", name), self._layers[name], side, position, profile)

    def _end(self, owner: Path, entry: Mapping[str, Any], side: str, position: float, profile: Profile) -> float:
        key = f"{side}_nd_arc"
        path = (*owner, key)
        if key not in entry:
            raise InputError(path, allowed="must refer to an anchor", state="is missing")
        anchor, handle = _reference(path, entry[key])
        return self._handle(path, anchor, handle, position, profile, ())

    def whole_web(self, name: str, position: float) -> None:
        """InputError if a layer covers a part of its web."""
        layer = self._layers[name]
        anchors = self._of_webs[layer["web"]]
        for side, expected in TRAILING_EDGE.items():
            entry = ("layers", name, f"{side}_nd_arc")
            if f"{side}_nd_arc" not in layer:
                raise InputError(entry, allowed=f"must refer to an anchor of web {layer['web']!r}", state="is missing")
            anchor, handle = _reference(entry, layer[f"{side}_nd_arc"])
            if anchor not in anchors:
                raise unknown((*entry, "anchor"), anchor, anchors)
            if handle not in anchors[anchor]:
                raise InputError(("webs", layer["web"], "anchors", anchor, handle), allowed="given", state="is missing")
            at = span_values(("webs", layer["web"], "anchors", anchor, handle), anchors[anchor][handle])(position)
            if abs(at - expected) > _ROUNDING:
                raise InputError(
                    entry,
                    at,
                    f"{expected:g} at {position:g}, because a layer covers its whole web",
                    shown=f"{at:g}",
                    hint="a web for each part",
                )

    def _handle(
        self,
        owner: Path,
        name: str,
        handle: str,
        position: float,
        profile: Profile,
        through: tuple[tuple[str, str], ...],
    ) -> float:
        """Return the position of an anchor's handle; `through` has the handles whose positions need it."""
        if name not in self._anchors:
            raise unknown((*owner, "anchor"), name, self._anchors)
        if handle not in _HANDLES:
            raise InputError((*owner, "handle"), handle, f"one of {', '.join(_HANDLES)}")
        entry = ("anchors", name, handle)
        if (name, handle) in through:
            raise InputError(entry, allowed="must have numbers along the span", state="refers to itself")
        anchor, through = self._anchors[name], (*through, (name, handle))

        def other(reference: Any) -> float:
            return self._handle(entry, *_reference(entry, reference), position, profile, through)

        if handle in anchor:
            arc = anchor[handle]
            return other(arc) if "anchor" in arc else span_values(entry, arc)(position)
        for key, unit in (("offset_nd_arc", 1.0), ("offset_arc", profile.around)):
            offset = anchor.get(key)
            if offset is not None and offset.get("defines") == handle:
                return other(offset) + span_values(("anchors", name, key), offset)(position) / unit
        width = anchor.get("width")
        if width is not None and handle in width.get("defines", []):
            side = handle.partition("_")[0]
            share = span_values(("anchors", name, "width"), width)(position, 0.0) / profile.around
            if "midpoint_nd_arc" in anchor:
                share, beside = 0.5 * share, "midpoint_nd_arc"
            else:
                beside = f"{_OTHER[side]}_nd_arc"
            return profile.off_edge(self._handle(entry, name, beside, position, profile, through)) + _SIGN[side] * share
        raise InputError(
            entry,
            hint="the converter or the optimization tool that writes them",
            allowed="must have numbers along the span, or width, offset_arc or offset_nd_arc, because "
            "plane_intersection is not computed",
            state="is missing",
        )


def _reference(owner: Path, entry: Any) -> tuple[str, str]:
    """Return name and handle of a reference to an anchor."""
    anchor = entry.get("anchor") if isinstance(entry, Mapping) else None
    name, handle = (anchor.get(key) if isinstance(anchor, Mapping) else None for key in ("name", "handle"))
    if not isinstance(name, str) or not isinstance(handle, str):
        raise InputError(owner, entry, "an anchor, with name and handle")
    return name, handle
