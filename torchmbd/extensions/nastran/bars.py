"""Lines of the bars of a Nastran model: ends, planes, offsets, pins.

A bar with the same offset at both ends, across it, has its grids as nodes, and its section is moved. For other offsets and pins
new nodes are made: one at the end of the offset, which follows the grid as one rigid body, and one that follows in the
components that no pin releases, along the axes of the bar.
OFFT says in which axes the vector of plane 1 (G: system CD of the first grid, B: basic) and the offsets (G: systems CD, O:
those of the bar) are.
Source: MSC Nastran Quick Reference Guide, CBAR, CBEAM. Checked in tests/extensions/nastran/test_bars.py.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from torchmbd.errors import InputError, wrong_entry
from torchmbd.extensions.nastran.data import Bar, BulkData
from torchmbd.fem.elements import Combination, Follower, RigidLink


@dataclass(eq=False)
class BarLines:
    """Lines of bars, in the order of the model, in units of the file.

    nodes        two for each bar; those of grids, then nodes of their own
    orientation  vectors of plane 1, basic axes
    offset       from the nodes to the bar, the same at both ends
    places       positions of the own nodes, with their names and the node that each follows
    links        how they follow
    """

    nodes: list[tuple[int, int]] = field(default_factory=list)
    orientation: list[np.ndarray] = field(default_factory=list)
    offset: list[np.ndarray] = field(default_factory=list)
    places: list[np.ndarray] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    followed: list[tuple[int, int]] = field(default_factory=list)
    links: list[Follower] = field(default_factory=list)


def bar_lines(data: BulkData, index: dict[int, int]) -> BarLines:
    """Place the bars; `index`: node of each grid. InputError names the card."""
    lines = BarLines()
    for bar in data.bars:
        grids = [np.array(data.grids[grid]) for grid in bar.grids]
        vector, offsets = _vector(data, bar), _offsets(data, bar, grids)
        pins = [_pins(bar, position) for position in (9, 10)]
        ends = [grid + offset for grid, offset in zip(grids, offsets, strict=True)]
        axes = _axes(bar, ends, vector)
        moved = (
            not any(pins)
            and np.array_equal(offsets[0], offsets[1])
            and abs(axes[0] @ offsets[0]) <= 1e-6 * _size(offsets[0])
        )
        nodes = [index[grid] for grid in bar.grids]
        if not moved:
            for k, (offset, released) in enumerate(zip(offsets, pins, strict=True)):
                if offset.any():
                    nodes[k] = _add_node(lines, len(index), bar, ends[k], nodes[k])
                    lines.links.append(RigidLink(nodes[k], lines.followed[-1][1]))
                if released:
                    nodes[k] = _add_node(lines, len(index), bar, ends[k], nodes[k])
                    lines.links += _pinned(*lines.followed[-1], axes, released)
        lines.nodes.append((nodes[0], nodes[1]))
        lines.orientation.append(vector)
        lines.offset.append(offsets[0] if moved else np.zeros(3))
    return lines


def _add_node(lines: BarLines, grids: int, bar: Bar, place: np.ndarray, followed: int) -> int:
    """Add a node at the end of a bar that follows the node `followed`; return its number."""
    node = grids + len(lines.places)
    lines.places.append(place)
    lines.names.append(f"end of {bar.card}")
    lines.followed.append((node, followed))
    return node


def _size(x: np.ndarray) -> float:
    return float(np.linalg.norm(x))


def _offset_flags(bar: Bar) -> str:
    word = bar.card.text(8).upper() or "GGG"
    if len(word) != 3 or word[0] not in "GB" or not set(word[1:]) <= set("GO"):
        raise InputError(
            (str(bar.card), "OFFT"), word, "G or B, then twice G or O, such as GGG", noun=f"{bar.card}: OFFT"
        )
    return word


def _vector(data: BulkData, bar: Bar) -> np.ndarray:
    """The vector of plane 1: from the grid GA to the grid G0, or X1 X2 X3."""
    card = bar.card
    if card.text(5).isdigit():
        grid = card.integer(5, "G0")
        if grid not in data.grids:
            raise wrong_entry(card, f"GRID {grid} does not exist", "the number of a GRID", key="G0")
        return np.array(data.grids[grid]) - np.array(data.grids[bar.grids[0]])
    x = np.array([card.real(k, f"X{k - 4}", 0.0) for k in (5, 6, 7)])
    return x if _offset_flags(bar)[0] == "B" else x @ data.displacement_axes(bar.grids[0])


def _offsets(data: BulkData, bar: Bar, grids: list[np.ndarray]) -> list[np.ndarray]:
    """From the grids to the ends of the bar, in basic axes."""
    offsets = []
    for k, (start, end) in enumerate(((11, "A"), (14, "B"))):
        w = np.array([bar.card.real(start + i, f"W{i + 1}{end}", 0.0) for i in range(3)])
        if w.any():
            local = _offset_flags(bar)[1 + k] == "O"
            w = w @ (_axes(bar, grids, _vector(data, bar)) if local else data.displacement_axes(bar.grids[k]))
        offsets.append(w)
    return offsets


def _axes(bar: Bar, ends: list[np.ndarray], vector: np.ndarray) -> np.ndarray:
    """Rows x, y, z of the bar."""
    along = ends[1] - ends[0]
    z = np.cross(along, vector)
    if _size(z) <= 1e-9 * _size(along) * _size(vector):
        raise wrong_entry(
            bar.card,
            f"its ends are {ends[0].tolist()} and {ends[1].tolist()}, its vector is {vector.tolist()}",
            "must have two different ends, and an orientation vector that is not parallel to the bar",
            key="X",
        )
    x, z = along / _size(along), z / _size(z)
    return np.array([x, np.cross(z, x), z])


def _pins(bar: Bar, position: int) -> tuple[int, ...]:
    """Released components 0 to 5 of an end."""
    text = bar.card.text(position)
    if not set(text) <= set("123456") or len(set(text)) < len(text):
        raise wrong_entry(bar.card, f"pins {text!r}", "components 1 to 6, each once", key="PA")
    return tuple(sorted(int(word) - 1 for word in text))


def _pinned(node: int, followed: int, axes: np.ndarray, released: tuple[int, ...]) -> list[Follower]:
    """Return the links by which a node follows another one at the same position, but for released components along `axes`."""
    links: list[Follower] = []
    for start in (0, 3):
        free = [axes[i - start] for i in released if start <= i < start + 3]
        if not free:
            links.append(RigidLink(node, followed, tuple(range(start, start + 3))))
        elif len(free) == 1:  # u = u_followed + s free: the largest component of `free` gives s
            p = int(np.abs(free[0]).argmax())
            for j in {0, 1, 2} - {p}:
                slope = float(free[0][j] / free[0][p])
                terms = ((followed, start + j, 1.0), (node, start + p, slope), (followed, start + p, -slope))
                links.append(Combination(node, start + j, terms if slope else terms[:1]))
        elif len(free) == 2:  # e . u = e . u_followed
            e = np.cross(*free)
            p = int(np.abs(e).argmax())
            terms = [(followed, start + j, float(e[j] / e[p])) for j in range(3) if e[j]]
            terms += [(node, start + j, float(-e[j] / e[p])) for j in range(3) if j != p and e[j]]
            links.append(Combination(node, start + p, tuple(terms)))
    return links
