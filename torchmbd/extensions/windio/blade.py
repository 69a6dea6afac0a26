"""A blade as windIO describes it: airfoils, chord and twist along the span, webs, layers and the orientation of their fibers.

Numbers are given along the span, linear between; positions s along a contour run from the trailing edge over the suction side
and the leading edge to the trailing edge, as parts of its length. Contours are linear in the relative thickness between the
airfoils that are placed beside, and this is monotone cubic along the span. Between two airfoils of one thickness they are
linear along the span.
A layer that starts behind its end goes round the trailing edge if that way is the shorter one. Otherwise there is no room for
it, as for a filler between two layers that overlap, or for a layer that tapers to nothing: it is left out.
Source: windIO 1.x (IEA Wind Task 37). Checked in tests/extensions/test_windio.py, experiments/peers/iea_blade.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from torchmbd.errors import InputError, checked_signature, unknown, warn
from torchmbd.extensions.windio.profile import NARROWEST, Layer, Profile, Web, profile_section
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
_POINTS = 200  # of a contour
Array = NDArray[np.float64]


@dataclass(frozen=True)
class _SpanValues:
    """Numbers along the span, linear between the points of a grid."""

    grid: Array
    values: Array

    def __call__(self, at: float, outside: float | None = None) -> float:
        return float(np.interp(at, self.grid, self.values, left=outside, right=outside))


@checked_signature
def read_windio(path: str | Path) -> WindIOBlade:
    """The blade of a windIO file (.yaml): `section(position)` makes a section, `station(position)` says where it lies.

    path   the file
    Raises InputError that names file and entry.

    >>> blade = mbd.read_windio("IEA-15-240-RWT.yaml")  # doctest: +SKIP
    >>> blade.section(0.5).stiffness()[0, 0]  # E A in the middle  # doctest: +SKIP
    """
    if not isinstance(path, (str, Path)):
        raise InputError(f"path is {path!r}; allowed: a windIO file")
    return WindIOBlade(Path(path))


class WindIOBlade:
    """A blade: sections, stations and contours at parts of the span."""

    def __init__(self, path: Path) -> None:
        self._file = path.name
        if not path.is_file():
            raise InputError(f"path is {str(path)!r}; allowed: a windIO file that exists")
        if path.stat().st_size > LARGEST:
            raise InputError(f"path is {str(path)!r}; allowed: a windIO file of at most {LARGEST} bytes")
        try:
            data = _loaded(path.read_text(encoding="utf-8"))
            blade = data["components"]["blade"]
            self._inner, shape = blade["internal_structure_2d_fem"], blade["outer_shape_bem"]
            self._shape = {name: _span_values(name, shape[name]) for name in ("chord", "twist", "pitch_axis")}
            axis = shape["reference_axis"]
            self._axis = [_span_values(f"reference_axis {name}", axis[name]) for name in "xyz"]
            self._materials = _named("material", data["materials"])
            self._airfoils(shape["airfoil_position"], _named("airfoil", data["airfoils"]))
            self._webs = _named("web", self._inner.get("webs") or [], "start_nd_arc", "end_nd_arc")
            self._layers = _named("layer", self._inner["layers"], "material", "thickness")
            for name, layer in self._layers.items():
                if "web" in layer and layer["web"] not in self._webs:
                    raise unknown(f"web of layer {name!r}:", layer["web"], self._webs)
        except InputError as error:
            raise InputError(f"{path.name}: {error}") from None
        except (yaml.YAMLError, KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
            raise InputError(
                f"{path.name} is no windIO blade: {_error_text(error)}; allowed: components, airfoils, materials"
            ) from None

    def _airfoils(self, placement: Mapping[str, Any], airfoils: Mapping[str, Any]) -> None:
        labels = list(placement["labels"])
        thicknesses = [float(airfoils[name]["relative_thickness"]) for name in labels]
        along = _span_values("airfoil_position", {"grid": placement["grid"], "values": thicknesses})
        shapes = {name: _resampled(name, airfoils[name]["coordinates"]) for name in dict.fromkeys(labels)}
        self._places, self._profiles = along, [shapes[name] for name in labels]
        self._relative = along if len(labels) == 1 else PchipInterpolator(along.grid, along.values)

    def contour(self, position: float) -> Array:
        """Points [n, 2] of the contour over the chord: x from the leading edge, y to the suction side."""
        grid, t = self._places.grid, self._places.values
        if len(grid) == 1:
            return self._profiles[0]
        position = float(np.clip(position, grid[0], grid[-1]))
        k = int(np.clip(np.searchsorted(grid, position), 1, len(grid) - 1))
        if t[k] == t[k - 1]:
            share = (position - grid[k - 1]) / (grid[k] - grid[k - 1])
        else:
            share = float(np.clip((self._relative(position) - t[k - 1]) / (t[k] - t[k - 1]), 0.0, 1.0))
        return self._profiles[k - 1] + share * (self._profiles[k] - self._profiles[k - 1])

    def station(self, position: float) -> dict[str, float]:
        """Chord [m], twist [rad], share of the chord at the reference axis, and its place x, y, z [m]."""
        section = {name: values(position) for name, values in self._shape.items()}
        return section | {name: values(position) for name, values in zip("xyz", self._axis, strict=True)}

    def section(self, position: float, cells: int = 60, order: int = 2) -> Section:
        """The section at a part of the span: y to the suction side, z to the trailing edge, from the reference axis.

        Its angles are those of the layers in the order of the file, those of webs from the leading edge to the trailing one;
        layers that are not there have no elements. x points to the tip.
        cells    along the contour, more at the ends of layers
        order    of the elements: 2, or 1, which is too stiff in shear where walls are thin
        """
        if not isinstance(position, (int, float)) or not 0.0 <= position <= 1.0:
            raise InputError(f"position = {position!r}; allowed: 0 to 1, a part of the span")
        if not is_whole(cells) or cells < 1:
            raise InputError(f"cells = {cells!r}; allowed: an integer >= 1")
        check_order(order)
        try:
            return self._section(position, cells, order)
        except InputError as error:
            raise InputError(f"{self._file}: {error}") from None

    def _section(self, position: float, cells: int, order: int) -> Section:
        chord, axis = self._shape["chord"](position), self._shape["pitch_axis"](position)
        if not chord > 0.0:
            raise InputError(f"chord at {position:g} is {chord:g} m; allowed: above 0")
        x, y = self.contour(position).T
        places = chord * np.stack([y, x - axis], 1)
        length = float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
        layers, webs = [], {name: [] for name in self._webs}
        for number, (name, layer) in enumerate(self._layers.items()):
            thickness = _span_values(f"thickness of {name}", layer["thickness"])(position, 0.0)
            if thickness < 0.0:
                raise InputError(f"thickness of {name} at {position:g} is {thickness:g} m; allowed: zero or above")
            if thickness < THIN:
                continue
            if "web" in layer:
                webs[layer["web"]].append((number, thickness))
            else:
                start, end = (self._layer_end(name, side, position, length) for side in ("start", "end"))
                layers += [Layer(number, thickness, *part) for part in _parts(name, position, start, end)]
        made = []
        for name, stack in webs.items():
            if stack:
                web = self._webs[name]
                places_of = [
                    _span_values(f"{side} of {name}", web[f"{side}_nd_arc"])(position) for side in ("start", "end")
                ]
                part = Web(name, tuple(stack), *places_of)
                if part.has_height(length):
                    made.append(part)
                else:
                    warn(
                        f"web {name!r} at {position:g} runs from {part.start:g} to {part.end:g} of the contour, and is "
                        f"{part.thickness:g} m thick; there is no room for it, and it is left out"
                    )
        plies = [self._solid(layer["material"]) for layer in self._layers.values()]
        angles = [
            _span_values(f"fiber_orientation of {name}", layer.get("fiber_orientation", ALONG))(position)
            for name, layer in self._layers.items()
        ]
        mesh = profile_section(Profile(places), layers, made, cells, order)
        return Section(mesh, plies, angles)

    def _layer_end(self, name: str, side: str, position: float, length: float, depth: int = 0) -> float:
        """Return the position along the contour where a layer starts or ends; `fixed` names an edge, or a neighboring layer."""
        layer, other = self._layers[name], "end" if side == "start" else "start"
        arc = layer.get(f"{side}_nd_arc")
        if arc is not None:
            fixed = arc.get("fixed")
            if fixed == "TE":
                return 0.0 if side == "start" else 1.0
            if fixed in self._layers and depth < len(self._layers):
                return self._layer_end(fixed, other, position, length, depth + 1)
            if fixed is not None:
                raise InputError(
                    f"{side}_nd_arc of layer {name!r} is fixed at {fixed!r}; allowed: TE, or the name of a layer"
                )
            return _span_values(f"{side}_nd_arc of {name}", arc)(position)
        if "width" not in layer or depth > len(self._layers):
            raise InputError(
                f"layer {name!r} has no {side}_nd_arc; allowed: start_nd_arc and end_nd_arc, or one and width"
            )
        width = _span_values(f"width of {name}", layer["width"])(position, 0.0) / length
        beside = self._layer_end(name, other, position, length, len(self._layers) + 1)
        return beside + width if side == "end" else beside - width

    def _solid(self, name: str) -> Orthotropic | IsotropicPly:
        try:
            material = self._materials[name]
            if not material.get("orth"):
                return Orthotropic.isotropic(float(material["E"]), float(material["nu"]), float(material["rho"]))
            return Orthotropic(
                *map(float, (*material["E"], *material["G"], *material["nu"])), density=float(material["rho"])
            )
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"material {name!r}: {error!r}; allowed: E, G, nu, rho") from None


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
        raise InputError(f"its data have more than {BRACKETS} brackets that are open at once")
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
    raise InputError(f"its data have more than {NESTED} levels or {ENTRIES} entries")


def _parts(name: str, position: float, start: float, end: float) -> list[tuple[float, float]]:
    """Return the parts of the contour that a layer covers: two round the trailing edge, none where there is no room for it."""
    if start - end > SHORTER and end >= 0.0 and start <= 1.0:
        return [part for part in ((0.0, end), (start, 1.0)) if part[1] - part[0] >= NARROWEST]
    if start - end > BEYOND:
        warn(
            f"layer {name!r} at {position:g} starts at {start:g} of the contour, behind its end at {end:g}; there is no room "
            "for it, and it is left out"
        )
    return [_clipped(name, position, start, end)] if end - start >= NARROWEST else []


def _clipped(name: str, position: float, start: float, end: float) -> tuple[float, float]:
    """Return the part of the contour that a layer covers, cut off at 0 and 1 with a warning."""
    if min(start, 1.0 - end) < -BEYOND:
        warn(
            f"layer {name!r} at {position:g} reaches from {start:g} to {end:g} of the contour; it is cut off at 0 and 1"
        )
    start, end = max(start, 0.0), min(end, 1.0)
    if not start < end:
        raise InputError(
            f"layer {name!r} at {position:g} lies from {start:g} to {end:g}, beyond the contour; allowed: 0 to 1"
        )
    return start, end


def _named(kind: str, items: Any, *keys: str) -> dict[str, Any]:
    """Return entries by name; InputError where a name is repeated or a key is missing."""
    entries: dict[str, Any] = {}
    for entry in items:
        name = entry["name"]
        if name in entries:
            raise InputError(f"{kind} {name!r} stands twice")
        for key in keys:
            if key not in entry:
                raise InputError(f"{kind} {name!r} has no {key}")
        entries[name] = entry
    return entries


def _span_values(name: str, table: Mapping[str, Any]) -> _SpanValues:
    """Read numbers along the span; InputError where grid and values are not as many rising and finite numbers."""
    try:
        grid, values = (np.array(table[key], dtype=float) for key in ("grid", "values"))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{name}: {error!r}; allowed: grid and values, numbers") from None
    if grid.ndim != 1 or grid.shape != values.shape or len(grid) < 1 or not (np.diff(grid) >= 0.0).all():
        raise InputError(f"{name} has grid {grid.tolist()[:5]} and {values.size} values; allowed: as many, rising")
    if not (np.isfinite(grid).all() and np.isfinite(values).all()):
        raise InputError(f"{name} has numbers that are not finite; allowed: finite ones")
    return _SpanValues(grid, values)


def _resampled(name: str, coordinates: Mapping[str, Any]) -> Array:
    """Return a contour at _POINTS positions from the trailing edge over the suction side, at the same x on both sides."""
    rows = [np.array(coordinates[axis], dtype=float) for axis in "xy"]
    if rows[0].ndim != 1 or rows[0].shape != rows[1].shape or not np.isfinite(rows).all():
        raise InputError(
            f"coordinates of airfoil {name!r} are {[row.shape for row in rows]} numbers; allowed: as many, finite"
        )
    points = np.stack(rows, 1)
    if len(np.unique(points[:, 0])) < 3 or points[:, 0].argmin() in (0, len(points) - 1):
        raise InputError(
            f"coordinates of airfoil {name!r} do not run around it; allowed: from the trailing edge and back"
        )
    nose = int(points[:, 0].argmin())
    halves = [points[: nose + 1], points[nose:][::-1]]
    if halves[0][:, 1].mean() < halves[1][:, 1].mean():
        halves = halves[::-1]
    x = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, _POINTS // 2))
    sides = []
    for half in halves:
        side = half[np.argsort(half[:, 0], kind="stable")]
        keep = np.concatenate([[True], np.diff(side[:, 0]) > 1e-9])
        sides.append(PchipInterpolator(side[keep, 0], side[keep, 1])(np.clip(x, side[keep, 0][0], side[keep, 0][-1])))
    suction, pressure = sides
    return np.concatenate([np.stack([x, suction], 1)[::-1], np.stack([x, pressure], 1)[1:]])
