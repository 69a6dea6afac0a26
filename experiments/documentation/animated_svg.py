"""A moving mechanism as an SVG file that plays by itself: lines of bodies, seen along an axis, one path for each frame.

    drawing(motion)               points of each line over time, and how it is drawn
    animated_svg(columns, path)   one picture of one or more motions, side by side

Flexible bodies are drawn by their deformed nodes (edges of plates, lines of beams), enlarged as wanted; rigid bodies by lines
between the points where joints hold them. Nothing but numbers of the motion enters; browsers show the file without a script.
Checked in tests/experiments/test_documentation.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchmbd.fem.mesh import Mesh
from torchmbd.viz.animation import through_joints

WIDTH = 720.0  # of the picture; its height follows from the motion
INK, FLEXIBLE, GROUND = "#455a64", "#d84315", "#90a4ae"
KINDS = {FLEXIBLE: "flexible", INK: "rigid", GROUND: "fixed"}
FONT = 18  # [px]; pages show a picture at half its size


class Line(NamedTuple):
    """Points [frames, n, 2] of a line, its color and width [px]."""

    points: np.ndarray
    color: str
    width: float


def _array(x: Any) -> np.ndarray:
    return x.detach().numpy()


def _edges(mesh: Any) -> list[list[int]]:
    """Lines of nodes that show a mesh: both long sides and both ends of a plate, the line of a beam."""
    if not isinstance(mesh, Mesh):
        return [[int(a), int(b)] for a, b in mesh.elements]
    cells = [*mesh.quads.tolist(), *mesh.triangles.tolist()]
    sides = [tuple(sorted(pair)) for cell in cells for pair in zip(cell, [*cell[1:], cell[0]], strict=True)]
    return [list(side) for side in sorted({s for s in sides if sides.count(s) == 1})]


def _chained(edges: list[list[int]]) -> list[list[int]]:
    """Edges that follow each other as one line."""
    left, chains = [list(edge) for edge in edges], []
    while left:
        chain = left.pop(0)
        grown = True
        while grown:
            grown = False
            for k, (a, b) in enumerate(left):
                if chain[-1] in (a, b) and len(chain) < 1000:
                    chain.append(b if chain[-1] == a else a)
                    del left[k]
                    grown = True
                    break
        chains.append(chain)
    return chains


def drawing(
    motion: Any,
    frames: int = 60,
    view: str = "xy",
    scale: float = 1.0,
    lane: int = 0,
    along: Mapping[str, Any] | None = None,
) -> list[Line]:
    """Lines of all bodies of a motion.

    frames   how many, from the first to the last time
    view     the two ground axes of the picture, right and up; "iso": from the side and above
    scale    of elastic displacements relative to the joints
    along    mechanisms of rigid bodies alone that joints do not show: body name -> points in body axes [m]
    """
    number = np.unique(np.linspace(0, len(motion.t) - 1, frames).round().astype(int))
    shown, lines = dict(along or {}), []
    sides = [side for joint in motion.system.joints for side in (joint.a, joint.b)]
    for body in motion.system.bodies:
        state = motion.body(body.name)
        r, A = _array(state.r)[lane][number], _array(state.A)[lane][number]
        if state.mesh is None:
            held = [_array(side.point) for side in sides if side.body.name == body.name]
            local = np.unique(np.array(shown.get(body.name, held)).reshape(-1, 3).round(9), axis=0)
            local = _around(local) if len(local) > 3 else local
            width = 4.0 if len(local) > 1 else 14.0
            lines.append(Line(_seen(r[:, None] + np.einsum("tij,nj->tni", A, local), view), INK, width))
            continue
        u = _array(state.displacements)[lane][number]
        x = _array(body.mesh.nodes - body.origin)
        nodes = sorted({node for side in sides if side.body.name == body.name for node in side.interpolation.nodes})
        bent = u - through_joints(x, u, nodes)  # what is enlarged: the parts stay joined
        places = _seen(r[:, None] + np.einsum("tij,tnj->tni", A, x + u + (scale - 1.0) * bent), view)
        lines += [Line(places[:, chain], FLEXIBLE, 3.0) for chain in _chained(_edges(state.mesh))]
    fixed = [_array(side.point) for side in sides if side.body.name not in {b.name for b in motion.system.bodies}]
    for point in np.unique(np.array(fixed).reshape(-1, 3).round(9), axis=0):
        lines.append(Line(np.repeat(_seen(point[None, None], view), len(number), 0), GROUND, 9.0))
    return lines


def _around(points: np.ndarray) -> np.ndarray:
    """Points [n, 3] near a plane in their order around its middle, the first again at the end."""
    centered = points - points.mean(0)
    plane = np.linalg.svd(centered, full_matrices=False)[2][:2]
    x, y = plane @ centered.T
    order = np.argsort(np.arctan2(y, x))
    return points[[*order, order[0]]]


def _seen(x: np.ndarray, view: str) -> np.ndarray:
    """Points [..., 3] as the picture has them [..., 2]."""
    if view == "iso":
        right, up = np.array([0.87, 0.5, 0.0]), np.array([-0.25, 0.43, 0.87])
        return np.stack([x @ right, x @ up], -1)
    return x[..., ["xyz".index(axis) for axis in view]]


def animated_svg(
    columns: Sequence[tuple[str, list[Line]]],
    path: str | Path,
    seconds: float = 4.0,
    duration: float | None = None,
    scale: float = 1.0,
) -> Path:
    """Write motions side by side, a line of text above each and a legend below; they take so many seconds and begin again.

    duration   of the motion [s], for the legend
    scale      of its deflections, for the legend
    """
    points = np.concatenate([line.points.reshape(-1, 2) for _, lines in columns for line in lines])
    low, high = points.min(0), points.max(0)
    wide = WIDTH / len(columns)
    factor = (wide - 40.0) / max(high[0] - low[0], (high[1] - low[1]) / 0.75, 1e-9)
    floor = factor * (high[1] - low[1]) + 45.0  # the lowest point
    height = floor + 70.0
    parts = [f'<rect width="{WIDTH:.0f}" height="{height:.0f}" fill="white"/>']
    for k, (text, lines) in enumerate(columns):
        left = k * wide + (wide - factor * (high[0] - low[0])) / 2
        parts += [_text(k * wide + 14.0, 24.0, text)] if text else []
        for line in lines:
            x, y = left + factor * (line.points[..., 0] - low[0]), floor - factor * (line.points[..., 1] - low[1])
            parts.append(_path(np.stack([x, y], -1), line, seconds))
    words = [] if duration is None else [f"{duration:.2g} s"]
    words += [] if scale == 1.0 else [f"deflections \u00d7 {scale:g}"]
    parts += _legend({line.color for _, lines in columns for line in lines}, factor, height - 18.0, ", ".join(words))
    body = "\n".join(parts)
    view = f'viewBox="0 0 {WIDTH:.0f} {height:.0f}"'
    text = (
        f'<svg xmlns="http://www.w3.org/2000/svg" {view} width="{WIDTH:.0f}" height="{height:.0f}">\n{body}\n</svg>\n'
    )
    Path(path).write_text(text, encoding="utf-8")
    return Path(path)


def _text(x: float, y: float, text: str) -> str:
    return f'<text x="{x:.0f}" y="{y:.0f}" font-family="sans-serif" font-size="{FONT}" fill="#37474f">{text}</text>'


def _legend(colors: set[str], factor: float, y: float, words: str) -> list[str]:
    """Names of the colors, a bar of a round length (factor: px/m), and words, in one row at the height y."""
    parts, x = [], 14.0
    for color, name in KINDS.items():
        if color in colors:
            bar = 0.0 if color == GROUND else 22.0
            parts.append(
                _bar(x + (11.0 if color == GROUND else 0.0), y - 6.0, bar, color, 9.0 if color == GROUND else 4.0)
            )
            parts.append(_text(x + 30.0, y, name))
            x += 30.0 + 0.55 * FONT * len(name) + 18.0
    longest = 120.0 / factor
    power = 10.0 ** np.floor(np.log10(longest))
    length = max(n * power for n in (1, 2, 5) if n * power <= longest)
    parts.append(_bar(x, y - 6.0, factor * length, "black", 2.0))
    parts.append(_text(x + factor * length + 8.0, y, f"{length:g} m"))
    parts.append(_text(x + factor * length + 75.0, y, words))
    return parts


def _bar(x: float, y: float, length: float, color: str, width: float) -> str:
    """A horizontal line; a point where its length is zero."""
    return _path(np.array([[[x, y], [x + max(length, 0.1), y]]]), Line(np.zeros((1, 2, 2)), color, width), 1.0)


def _path(xy: np.ndarray, line: Line, seconds: float) -> str:
    if xy.shape[1] == 1:  # a point: a short line with round ends
        xy = np.concatenate([xy, xy + np.array([0.1, 0.0])], 1)
    frames = [f"M{' '.join(f'{x:.1f},{y:.1f}' for x, y in frame)}" for frame in xy]
    still = bool(np.ptp(xy, axis=0).max() < 0.05)
    head = f'<path fill="none" stroke="{line.color}" stroke-width="{line.width}" stroke-linecap="round" stroke-linejoin="round"'
    if still:
        return f'{head} d="{frames[0]}"/>'
    values = ";".join(frames)
    moves = f'<animate attributeName="d" dur="{seconds:g}s" repeatCount="indefinite" values="{values}"/>'
    return f'{head} d="{frames[0]}">{moves}</path>'
