"""The mesh of a hollow profile: layers inside its contour, and webs between the sides.

Columns of the wall lie between stations s along the contour; through the wall there are as many elements in every column as
the largest stack has layers, where there are fewer the thickest layer counts for several. At a station the layers' faces lie
at the mean of the depths beside, so that stacks change within one narrow element. A wall is at most SHARE as thick as the
profile there is wide inside, and as far thinner as its columns need to stay apart, round a nose or beside an edge (a warning
says where). A web is straight from wall to wall, its faces at stations of both. Where the contour is open at
the trailing edge, a short wall of the layers that reach it closes it.
Checked in tests/extensions/test_windio.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchmbd.errors import InputError, warn
from torchmbd.fem.sections.mesh import SectionMesh
from torchmbd.fem.sections.patches import Patch, patch_mesh

SHARE = 0.45  # of the inner width
_STEP = 2e-3  # of the contour: columns in which a stack changes
NARROWEST = 2e-4  # of the contour: no column is narrower, and no layer
_EDGE = 2.5 * _STEP  # ends of layers as near to the trailing edge lie at the edge: no room for columns beside them
_THINNER, _THINNEST = 0.9, 0.05  # a wall whose columns cross becomes thinner by this factor, down to this share
_TOLD = 0.5  # share of its thickness below which a wall is told
_BESIDE = 1e-3  # of the contour: neighbors that give the tangent
_CORNER = 0.3  # of a side of a sharp corner: how deep its inner edge may lie
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Layer:
    """A layer of the wall: its number, thickness [m], and where it starts and ends along the contour."""

    number: int
    thickness: float
    start: float
    end: float


@dataclass(frozen=True)
class Web:
    """(number, thickness) of its layers from the leading edge to the trailing one, and its ends on both sides.

    The ends are positions from the middle of the trailing edge.
    """

    name: str
    layers: tuple[tuple[int, float], ...]
    start: float
    end: float

    @property
    def thickness(self) -> float:
        return sum(t for _, t in self.layers)

    def has_height(self, length: float) -> bool:
        """True if its ends are farther apart along a contour of some length [m] than the web is thick."""
        apart = abs(self.end - self.start)
        return min(apart, 1.0 - apart) > max(NARROWEST, self.thickness / length)


class Profile:
    """A contour from the trailing edge over the suction side, points [n, 2] [m]; beyond s = 1 a straight line closes it."""

    def __init__(self, points: Array) -> None:
        gap = np.linalg.norm(points[-1] - points[0])
        self.points = points if gap < 1e-9 else np.concatenate([points, points[:1]])
        steps = np.linalg.norm(np.diff(self.points, axis=0), axis=1)
        self.length = float(steps[: len(points) - 1].sum())
        self.arc = np.concatenate([[0.0], np.cumsum(steps)]) / self.length
        self.closed = float(self.arc[-1])  # at least 1
        self.around = self.length * self.closed  # m, with the trailing edge

    def on_contour(self, at: float) -> float:
        """Return the position along the contour of one from the middle of the trailing edge, whose points are at its ends."""
        position = 0.5 + (at - 0.5) * self.closed
        return min(max(position, 0.0), 1.0) if 0.0 <= at <= 1.0 else position

    def from_middle(self, s: Any) -> Any:
        """Return the position from the middle of the trailing edge of one along the contour: parts of it with the edge."""
        return 0.5 + (s - 0.5) / self.closed

    def off_edge(self, at: float) -> float:
        """Return a position from the middle of the trailing edge; the end of the edge if it lies on the edge."""
        return self.from_middle(self.on_contour(at))

    def at(self, s: Array) -> Array:
        """Points at positions."""
        s = np.mod(s, self.closed)
        return np.stack([np.interp(s, self.arc, self.points[:, k]) for k in range(2)], -1)

    def inward(self, s: Array) -> Array:
        """Unit normals into the profile."""
        d = self.at(s + _BESIDE) - self.at(s - _BESIDE)
        n = np.stack([d[:, 1], -d[:, 0]], -1)
        size = np.linalg.norm(n, axis=1, keepdims=True)
        return -n / size * np.sign(self.area)

    @property
    def area(self) -> float:
        """Enclosed area [m2], positive counterclockwise."""
        x, y = self.points.T
        return 0.5 * float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum())

    def inner_width(self, s: Array) -> Array:
        """Distance to the opposite wall along the inward normals."""
        p, d = self.at(s), self.inward(s)
        a, e = self.points[:-1], np.diff(self.points, axis=0)
        cross = d[:, None, 0] * e[None, :, 1] - d[:, None, 1] * e[None, :, 0]
        r = a[None] - p[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (r[..., 0] * e[None, :, 1] - r[..., 1] * e[None, :, 0]) / cross
            u = (r[..., 0] * d[:, None, 1] - r[..., 1] * d[:, None, 0]) / cross
        hit = (np.abs(cross) > 1e-14) & (t > 1e-6) & (u >= 0.0) & (u <= 1.0)
        return np.where(hit, t, np.inf).min(1)


def profile_section(
    profile: Profile, layers: list[Layer], webs: list[Web], cells: int = 60, order: int = 2
) -> SectionMesh:
    """The mesh; layers from outside to inside. InputError if walls cannot be meshed; it names a web without room."""
    feet = [(_feet(web, profile, +1), _feet(web, profile, -1)) for web in webs]
    for web, pair in zip(webs, feet, strict=True):
        low, high = min(x.min() for x in pair), max(x.max() for x in pair)
        if low < 0.0 or high > 1.0:
            low, high = profile.from_middle(low), profile.from_middle(high)
            raise InputError(
                ("webs", web.name),
                allowed="must lie from 0 to 1, with its thickness",
                noun=f"web {web.name!r}",
                state=f"reaches from {low:.4f} to {high:.4f} of the contour",
            )
    s = _stations(profile, layers, [foot for pair in feet for foot in pair], cells)
    middles = 0.5 * (s[:-1] + s[1:])
    stacks = [_stack(layers, x, profile.closed) for x in middles]
    count = max(len(stack) for stack in stacks)
    if not all(stacks):
        x = float(middles[[len(stack) for stack in stacks].index(0)])
        raise InputError(
            "layers",
            allowed="must have a wall all around",
            noun="the contour",
            state=f"has no layer at {x:.4f} of its length",
        )
    stacks = [_divided(stack, count) for stack in stacks]
    depth = np.array([np.cumsum([0.0, *(t for _, t in stack)]) for stack in stacks])  # [columns, count + 1]
    inner = _faces(profile, s, depth, order)
    patches = [
        Patch(np.stack([inner[k][:, j + 1], inner[k][:, j]], 1) if order == 1 else _thick(inner[k], j), stack[j][0])
        for k, stack in enumerate(stacks)
        for j in range(count)
    ]
    of_webs = [_web_patches(web, pair, s, inner, order) for web, pair in zip(webs, feet, strict=True)]
    try:
        return patch_mesh([*patches, *(patch for group in of_webs for patch in group)], order)[0]
    except InputError:
        for web, group in zip(webs, of_webs, strict=True):
            _require_room(web, patches, group, order)
        raise


def _require_room(web: Web, wall: list[Patch], group: list[Patch], order: int) -> None:
    """InputError names a web that cannot be meshed within the wall."""
    patch_mesh(wall, order)
    try:
        patch_mesh([*wall, *group], order)
    except InputError as error:
        raise InputError(
            ("webs", web.name),
            allowed="a web from the suction side to the pressure side with a positive height",
            noun=f"web {web.name!r}",
            state=f"from {web.start:.4f} to {web.end:.4f} of the contour has no room between the walls ({error})",
        ) from None


def _thick(faces: Array, j: int) -> Array:
    """Points [3, 3, 2] of the layer between faces j and j + 1, from inside to outside."""
    low, high = faces[:, j + 1], faces[:, j]
    return np.stack([low, 0.5 * (low + high), high], 1)


def _feet(web: Web, profile: Profile, sign: int) -> Array:
    """Positions of the faces of a web's layers, from the trailing edge: rising on the suction side, falling on the other."""
    widths = np.cumsum([0.0, *(t for _, t in reversed(web.layers))]) - 0.5 * web.thickness
    return profile.on_contour(web.start if sign > 0 else web.end) + sign * widths / profile.length


def _stations(profile: Profile, layers: list[Layer], feet: list[Array], cells: int) -> Array:
    """Positions of the columns' ends, from 0 to the end of the closed contour."""
    fixed = {0.0, 1.0, profile.closed} if profile.closed > 1.0 + 1e-9 else {0.0, 1.0}
    webs = sorted(float(x) for foot in feet for x in foot)
    spans = [(foot.min() - 1e-4, foot.max() + 1e-4) for foot in feet]

    def free(x: float) -> bool:
        return not any(a <= x <= b for a, b in spans)

    for layer in layers:
        for x in (layer.start, layer.end):
            if _EDGE < x < 1.0 - _EDGE and free(x):
                fixed |= {y for y in (x - _STEP, x, x + _STEP) if free(y)}
    fixed |= set(webs)
    nose = float(profile.arc[int(np.argmin(profile.points[:, 1]))])
    even = np.linspace(0.0, 1.0, cells + 1)
    even = np.concatenate([even, nose + 0.03 * np.linspace(-1.0, 1.0, 9)])
    close = np.array(sorted(fixed))
    more = [
        x for x in even if np.abs(close - x).min() > 0.4 / cells * (0.2 if abs(x - nose) < 0.03 else 1.0) and free(x)
    ]
    s = np.unique(np.round([*fixed, *more], 9))
    keep = [s[0]]
    exact = np.round([*webs, 0.0, 1.0, profile.closed], 9)
    for x in s[1:]:
        if x - keep[-1] > NARROWEST or x in exact:
            if x - keep[-1] <= NARROWEST and keep[-1] not in exact:
                keep.pop()
            keep.append(x)
    return np.array(keep)


def _stack(layers: list[Layer], s: float, closed: float) -> list[tuple[int, float]]:
    """(number, thickness) of the layers at a position; beyond 1, at the trailing edge, those that reach it."""
    if s > 1.0:
        reaching = {layer.number: layer for layer in layers if layer.start <= 1e-6 or layer.end >= 1.0 - 1e-6}
        return [(layer.number, layer.thickness) for layer in (list(reaching.values()) or layers[:1])]
    return [(layer.number, layer.thickness) for layer in layers if layer.start <= s <= layer.end]


def _divided(stack: list[tuple[int, float]], count: int) -> list[tuple[int, float]]:
    """Return a stack as `count` layers: the thickest ones are divided."""
    stack = list(stack)
    while len(stack) < count:
        k = max(range(len(stack)), key=lambda i: stack[i][1])
        number, t = stack[k]
        stack[k : k + 1] = [(number, 0.5 * t), (number, 0.5 * t)]
    return stack


def _faces(profile: Profile, s: Array, depth: Array, order: int) -> list[Array]:
    """Points [order + 1, count + 1, 2] of the faces of every column."""
    closed = len(s) - 1
    at_station = 0.5 * (depth + np.roll(depth, 1, axis=0))  # between a column and the one before it, around
    inner_width = profile.inner_width(s[:-1])
    corner = _corners(profile, s)
    limit = np.minimum(SHARE * inner_width, corner)
    total = at_station[:, -1]
    at_station = at_station * np.minimum(1.0, limit / total)[:, None]
    at_station = np.concatenate([at_station, at_station[:1]])
    normal = profile.inward(s)
    normal[-1] = normal[0]
    p = profile.at(s)
    p[-1] = p[0]
    ends = _untangled(profile.from_middle(s), p, at_station, normal)
    faces = []
    for k in range(closed):
        low, high = ends[k], ends[k + 1]
        middle = 0.5 * (low + high)
        faces.append(np.stack([low, high] if order == 1 else [low, middle, high]))
    return faces


def _untangled(s: Array, p: Array, depth: Array, normal: Array) -> Array:
    """Points [stations, faces, 2] at depths below the contour; walls whose columns cross are made thinner, and told."""
    share = np.ones(len(p))
    while True:
        ends = p[:, None] + (share[:, None] * depth)[..., None] * normal[:, None]
        crossed = _crossed(ends)
        if not crossed.any():
            break
        if share.min() < _THINNEST:
            at = float(s[int(share.argmin())])
            raise InputError(
                "layers",
                allowed="must have thinner layers, or fewer cells",
                noun=f"the wall at {at:.4f} of the contour",
                state="crosses itself",
            )
        wrong = np.zeros(len(p), dtype=bool)
        wrong[:-1] |= crossed
        wrong[1:] |= crossed
        wrong[[0, -1]] = wrong[0] | wrong[-1]  # the same station
        share[wrong] *= _THINNER
    if share.min() < _TOLD:
        k = int(share.argmin())
        warn(
            f"the wall at {s[k]:.4f} of the contour is reduced to {share[k]:.2f} of its thickness, because the airfoil is too "
            "thin there"
        )
    return ends


def _crossed(ends: Array) -> Array:
    """True if a column has a corner that is not convex, or turned as the others are not, in any of its layers."""
    a, b = ends[:-1, :-1], ends[1:, :-1]
    d, c = ends[:-1, 1:], ends[1:, 1:]
    corners = [a, b, c, d]
    turns = []
    for k in range(4):
        before, after = corners[k] - corners[k - 1], corners[(k + 1) % 4] - corners[k]
        turns.append(before[..., 0] * after[..., 1] - before[..., 1] * after[..., 0])
    turn = np.stack(turns)
    return (turn * np.sign(np.median(turn)) <= 0.0).any((0, 2))


def _corners(profile: Profile, s: Array) -> Array:
    """Return the largest thickness of a wall where the contour turns sharply: a part of the shorter adjacent column."""
    p = profile.at(s[:-1])
    before, after = p - np.roll(p, 1, axis=0), np.roll(p, -1, axis=0) - p
    a, b = np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1)
    cosine = (before * after).sum(1) / (a * b)
    return np.where(cosine < 0.7, _CORNER * np.minimum(a, b), np.inf)


def _web_patches(web: Web, feet: tuple[Array, Array], s: Array, faces: list[Array], order: int) -> list[Patch]:
    """Patches of a web's layers from the trailing edge on: along it from the suction side, across it to the leading edge."""
    columns = {round(float(x), 9): k for k, x in enumerate(s)}
    try:
        up = [columns[round(float(x), 9)] for x in feet[0]]
        down = [columns[round(float(x), 9)] for x in feet[1]]
    except KeyError:
        raise InputError(
            ("webs", web.name),
            allowed="must not meet another web",
            noun=f"web {web.name!r}",
            state=f"at {web.start:.4f} and {web.end:.4f} of the contour meets other webs there",
        ) from None
    patches = []
    for j, (number, _) in enumerate(reversed(web.layers)):
        top, bottom = faces[up[j]][:, -1], faces[down[j + 1]][::-1, -1]
        steps = np.linspace(0.0, 1.0, order * 12 + 1)[:, None, None]
        patches.append(Patch(top * (1.0 - steps) + bottom * steps, number))
    return patches
