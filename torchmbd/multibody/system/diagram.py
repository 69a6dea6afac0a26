"""A diagram of a system for notebooks: bodies on a circle, the ground a square, a line for each joint and force element.

Checked in tests/test_summary.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import Any

from torchmbd.summary import table

SIZE, RADIUS, NODE = 420, 150, 30  # pixels


def html(system: Any) -> str:
    """Tables of bodies, joints and forces, and the diagram."""
    bodies = [(body.name, type(body).__name__) for body in system.bodies]
    joints = [(joint.name, type(joint).__name__, joint.frames[0], joint.frames[-1]) for joint in system.joints]
    forces = [(force.name, type(force).__name__, ", ".join(map(str, force.frames))) for force in system.forces]
    parts = [table(bodies, ("body", "kind")), table(joints, ("joint", "kind", "on", "holds"))]
    parts += [table(forces, ("force", "kind", "on"))] if forces else []
    return svg(system) + "".join(parts)


def svg(system: Any) -> str:
    """The diagram."""
    names = ["ground", *(body.name for body in system.bodies)]
    turns = [math.pi / 2.0 + 2.0 * math.pi * k / len(names) for k in range(len(names))]
    at = {
        name: (SIZE / 2 + RADIUS * math.cos(t), SIZE / 2 + RADIUS * math.sin(t))
        for name, t in zip(names, turns, strict=True)
    }
    lines = [(joint.name, list(joint.frames), "") for joint in system.joints]
    lines += [(force.name, list(force.frames), ' stroke-dasharray="4"') for force in system.forces]
    drawn: dict[frozenset[str], int] = {}
    parts = [part for name, frames, dash in lines for part in _line(name, frames, dash, at, drawn)]
    for name, (x, y) in at.items():
        shape = (
            f'<rect x="{x - NODE:.0f}" y="{y - 12:.0f}" width="{2 * NODE}" height="24"'
            if name == "ground"
            else f'<ellipse cx="{x:.0f}" cy="{y:.0f}" rx="{NODE + 8}" ry="14"'
        )
        parts.append(f'{shape} fill="#fff" stroke="#444"/>{_text(name, x, y + 4)}')
    return f'<svg width="{SIZE}" height="{SIZE}" font-size="11" font-family="sans-serif">{"".join(parts)}</svg>'


def _line(
    name: str, frames: Sequence[Any], dash: str, at: dict[str, tuple[float, float]], drawn: dict[frozenset[str], int]
) -> list[str]:
    """A line between two bodies; several between the same two are set apart."""
    ends = [at[frame.body.name if frame.body.name in at else "ground"] for frame in (frames[0], frames[-1])]
    key = frozenset(map(str, ends))
    apart, drawn[key] = 14 * drawn.get(key, 0), drawn.get(key, 0) + 1
    (x1, y1), (x2, y2) = ends
    path = f'<line x1="{x1:.0f}" y1="{y1 + apart:.0f}" x2="{x2:.0f}" y2="{y2 + apart:.0f}" stroke="#0072b2"{dash}/>'
    return [path, _text(name, (x1 + x2) / 2, (y1 + y2) / 2 + apart - 3, "#0072b2")]


def _text(text: str, x: float, y: float, color: str = "#000") -> str:
    return f'<text x="{x:.0f}" y="{y:.0f}" text-anchor="middle" fill="{color}">{escape(text)}</text>'
