"""A blade as windIO describes it: airfoils, chord and twist along the span, webs, layers and the orientation of their fibers.

Numbers are given along the span, linear between. Positions along a contour run from the middle of the trailing edge over the
suction side and the leading edge to the middle of the trailing edge, as parts of its length.
A layer that starts behind its end goes round the trailing edge if that way is the shorter one. Otherwise there is no room for
it, as for a filler between two layers that overlap, or for a layer that tapers to nothing: it is left out.
Source: windIO 1.x and 2.x (IEA Wind Task 37).
Checked in tests/extensions/test_windio.py, tests/extensions/test_windio_versions.py, experiments/peers/iea_blade.py.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from torchmbd.errors import InputError, unknown, warn, within
from torchmbd.extensions.windio.contours import Contours
from torchmbd.extensions.windio.profile import NARROWEST, Layer, Profile, Web, profile_section
from torchmbd.extensions.windio.span_values import span_values
from torchmbd.extensions.windio.versions import entries
from torchmbd.fem.materials.ply import IsotropicPly
from torchmbd.fem.sections.generators import check_order
from torchmbd.fem.sections.orthotropic import Orthotropic
from torchmbd.fem.sections.section import Section
from torchmbd.math.checked_numbers import is_whole

LARGEST = 20_000_000  # bytes of a file
ENTRIES = 5_000_000  # of the data, those behind aliases counted each time
NESTED = 50  # levels of the data
BEYOND = 1e-3  # share of the contour that layers may reach beyond it without a warning
BRACKETS = 1000  # open at once, those in comments and texts counted too
ALONG = {"grid": [0.0, 1.0], "values": [0.0, 0.0]}  # the schema's default of fiber_orientation [rad]
THIN = 2e-5  # m: layers below are left out
SHORTER = 0.5  # of the contour: a layer goes round the trailing edge if its start is farther behind its end
Array = NDArray[np.float64]


def read_windio(path: str | Path) -> WindIOBlade:
    """The blade of a windIO file (.yaml): `section(position)` makes a section, `station(position)` says where it lies.

    path   the file
    Raises InputError that names file and entry.

    >>> blade = mbd.io.read_windio("IEA-15-240-RWT.yaml")  # doctest: +SKIP
    >>> blade.section(0.5).stiffness()[0, 0]  # E A in the middle  # doctest: +SKIP
    """
    if not isinstance(path, (str, Path)):
        raise InputError("path", path, "a windIO file")
    return WindIOBlade(Path(path))


class WindIOBlade:
    """A blade: sections, stations and contours at parts of the span."""

    def __init__(self, path: Path) -> None:
        self._file = path.name
        if not path.is_file():
            raise InputError("path", str(path), "a windIO file that exists")
        if path.stat().st_size > LARGEST:
            raise InputError("path", str(path), f"a windIO file of at most {LARGEST} bytes")
        try:
            read = entries(_loaded(path.read_text(encoding="utf-8")))
            self._shape = {
                "chord": span_values(("chord",), read.chord),
                "twist": span_values(("twist",), read.twist, read.angle),
            }
            self._offsets = {name: span_values((name,), table) for name, table in read.offsets.items()}
            self._axis = [span_values(("reference_axis", name), read.axis[name]) for name in "xyz"]
            self._contours = Contours(read.labels, read.positions, read.airfoils, read.thickness)
            self._materials, self._webs, self._layers = read.materials, read.webs, read.layers
            self._arcs, self._angle = read.arcs, read.angle
            for name, layer in self._layers.items():
                if "web" in layer and layer["web"] not in self._webs:
                    raise unknown(("layers", name, "web"), layer["web"], self._webs)
        except InputError as error:
            raise within(path.name, error) from None
        except (yaml.YAMLError, KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
            raise InputError(
                path.name,
                allowed="must have components, airfoils and materials",
                state=f"is not a windIO blade ({_error_text(error)})",
            ) from None

    def contour(self, position: float) -> Array:
        """Points [n, 2] of the contour over the chord: x from the leading edge, y to the suction side."""
        return self._contours(position)

    def station(self, position: float) -> dict[str, float]:
        """Chord [m], twist [rad], share of the chord at the reference axis, and its place x, y, z [m].

        The share is nan in a file of version 2 where the chord is 0, because the file has a length.
        """
        section = {name: values(position) for name, values in self._shape.items()}
        if "pitch_axis" in self._offsets:
            section["pitch_axis"] = self._offsets["pitch_axis"](position)
        else:
            chord = section["chord"]
            section["pitch_axis"] = self._offsets["section_offset_y"](position) / chord if chord else math.nan
        return section | {name: values(position) for name, values in zip("xyz", self._axis, strict=True)}

    def section(self, position: float, cells: int = 60, order: int = 2) -> Section:
        """The section at a part of the span: y to the suction side, z to the trailing edge, from the reference axis.

        Its angles are those of the layers in the order of the file, those of webs from the leading edge to the trailing one;
        layers that are not there have no elements. x points to the tip.
        cells    along the contour, more at the ends of layers
        order    of the elements: 2, or 1, which is too stiff in shear where walls are thin
        """
        if not isinstance(position, (int, float)) or not 0.0 <= position <= 1.0:
            raise InputError("position", position, "0 to 1, a part of the span")
        if not is_whole(cells) or cells < 1:
            raise InputError("cells", cells, "an integer >= 1")
        check_order(order)
        try:
            return self._section(position, cells, order)
        except InputError as error:
            raise within(self._file, error) from None

    def _section(self, position: float, cells: int, order: int) -> Section:
        profile = self._profile(position)
        layers, webs = [], {name: [] for name in self._webs}
        for number, (name, layer) in enumerate(self._layers.items()):
            thickness = span_values(("layers", name, "thickness"), layer["thickness"])(position, 0.0)
            if thickness < 0.0:
                raise InputError(
                    ("layers", name, "thickness"),
                    thickness,
                    "zero or positive",
                    state=f"is {thickness:g} m",
                    noun=f"thickness of {name} at {position:g}",
                )
            if thickness < THIN:
                continue
            if "web" in layer:
                self._arcs.whole_web(name, position)
                webs[layer["web"]].append((number, thickness))
            else:
                start, end = (self._arcs.layer(name, side, position, profile) for side in ("start", "end"))
                parts = _parts(name, position, start, end, profile)
                layers += [Layer(number, thickness, *part) for part in parts]
        made = []
        for name, stack in webs.items():
            if stack:
                start, end = (self._arcs.web(name, side, position, profile) for side in ("start", "end"))
                part = Web(name, tuple(stack), start, end)
                if part.has_height(profile.around):
                    made.append(part)
                else:
                    warn(
                        f"web {name!r} at {position:g} of the span, from {part.start:g} to {part.end:g} of the contour, does "
                        f"not have room for its thickness of {part.thickness:g} m; the reader leaves this web out"
                    )
        plies = [self._solid(layer["material"]) for layer in self._layers.values()]
        angles = [
            span_values(("layers", name, "fiber_orientation"), layer.get("fiber_orientation", ALONG), self._angle)(
                position
            )
            for name, layer in self._layers.items()
        ]
        mesh = profile_section(profile, layers, made, cells, order)
        return Section(mesh, plies, angles)

    def _profile(self, position: float) -> Profile:
        """Return the contour [m] about the reference axis."""
        chord = self._shape["chord"](position)
        if not chord > 0.0:
            raise InputError("chord", chord, "above 0", state=f"is {chord:g} m", noun=f"chord at {position:g}")
        x, y = self.contour(position).T
        return Profile(chord * np.stack([y, x], 1) + self._offset(position, chord))

    def _offset(self, position: float, chord: float) -> Array:
        """Place [2] of the leading edge [m]: to the suction side, and to the trailing edge."""
        at = {name: values(position) for name, values in self._offsets.items()}
        if "pitch_axis" in at:
            return np.array([0.0, -chord * at["pitch_axis"]])
        return np.array([at.get("section_offset_x", 0.0), -at["section_offset_y"]])

    def _solid(self, name: str) -> Orthotropic | IsotropicPly:
        try:
            material = self._materials[name]
            if not material.get("orth"):
                return Orthotropic.isotropic(float(material["E"]), float(material["nu"]), float(material["rho"]))
            return Orthotropic(
                *map(float, (*material["E"], *material["G"], *material["nu"])), density=float(material["rho"])
            )
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                ("materials", name), allowed="must have E, G, nu and rho", state=f"has other entries ({error!r})"
            ) from None


def _error_text(error: Exception) -> str:
    """Return the text of a parser's error, or the repr of any other: the text of a KeyError is the key alone."""
    return " ".join(str(error).split()) if isinstance(error, yaml.YAMLError) else repr(error)


class _Redefining(yaml.SafeLoader):
    """The loader in Python, in which an anchor may be defined again, as YAML 1.2 allows: aliases name the last one."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if not self.check_event(yaml.AliasEvent):
            self.anchors.pop(self.peek_event().anchor, None)
        return super().compose_node(parent, index)


def _loaded(text: str) -> Any:
    """Return the data of a text; their size is checked first, because aliases multiply them and the parser recurses."""
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    letters = np.frombuffer(text.encode(), dtype=np.uint8)
    flow = np.cumsum(np.isin(letters, list(b"[{")).astype(int) - np.isin(letters, list(b"]}")))
    sizes: dict[str, int] = {}
    anchors: list[str] = []
    opened: list[tuple[str | None, int]] = [(None, 0)]  # (anchor, entries) of the collections around
    if flow.max(initial=0) > BRACKETS:  # the parser's time grows with their square
        raise InputError(
            "data",
            allowed="must have fewer",
            noun="its data",
            state=f"have more than {BRACKETS} brackets that are open at once",
        )
    for event in yaml.parse(text, loader):
        size = 0
        if isinstance(event, yaml.CollectionStartEvent):
            opened.append((event.anchor, 1))
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, size = opened.pop()
            if anchor is not None:
                sizes[anchor] = size
        elif isinstance(event, yaml.NodeEvent):
            size = sizes.get(event.anchor or "", 1) if isinstance(event, yaml.AliasEvent) else 1
        if isinstance(event, yaml.NodeEvent) and not isinstance(event, yaml.AliasEvent) and event.anchor:
            anchors.append(event.anchor)
        opened[-1] = opened[-1][0], opened[-1][1] + size
        if len(opened) > NESTED or opened[-1][1] > ENTRIES:
            break
    else:
        return yaml.load(text, loader if len(set(anchors)) == len(anchors) else _Redefining)
    raise InputError(
        "data", allowed="must have fewer", noun="its data", state=f"have more than {NESTED} levels or {ENTRIES} entries"
    )


def _parts(name: str, position: float, start: float, end: float, profile: Profile) -> list[tuple[float, float]]:
    """Return the parts of the contour that a layer covers: two round the trailing edge, none where there is no room for it."""
    if start - end > SHORTER and end >= 0.0 and start <= 1.0:
        parts = [(0.0, profile.on_contour(end)), (profile.on_contour(start), 1.0)]
        return [part for part in parts if part[1] - part[0] >= NARROWEST]
    if start - end > BEYOND:
        warn(
            f"layer {name!r} at {position:g} of the span starts at {start:g} of the contour, after its end at {end:g}; the "
            "reader leaves this layer out"
        )
    if end - start < NARROWEST:
        return []
    low, high = _clipped(name, position, start, end)
    low, high = profile.on_contour(low), profile.on_contour(high)
    if high - low >= NARROWEST:
        return [(low, high)]
    if end - start > BEYOND:
        warn(
            f"layer {name!r} at {position:g} of the span lies on the flat trailing edge; the reader leaves this layer out"
        )
    return []


def _clipped(name: str, position: float, start: float, end: float) -> tuple[float, float]:
    """Return the part of the contour that a layer covers, cut off at 0 and 1 with a warning."""
    if min(start, 1.0 - end) < -BEYOND:
        warn(
            f"layer {name!r} at {position:g} of the span reaches from {start:g} to {end:g} of the contour; the reader cuts it "
            "off at 0 and 1"
        )
    start, end = max(start, 0.0), min(end, 1.0)
    if not start < end:
        raise InputError(
            ("layers", name),
            allowed="must lie from 0 to 1",
            noun=f"layer {name!r}",
            state=f"at {position:g} lies from {start:g} to {end:g}, beyond the contour",
        )
    return start, end
