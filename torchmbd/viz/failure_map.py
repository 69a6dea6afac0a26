"""Figure of the largest failure index of a motion over the cells and beams of a laminated body.

Plates and shells: colors on the mesh, seen along the axis in which it spreads least. Beams: the index along their axes.
Checked in tests/viz/test_criteria.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.fem.materials import CRITERIA, FailureForms
from torchmbd.results.ply_history import PlyHistory
from torchmbd.results.section_history import SectionHistory, laminated
from torchmbd.viz.animation import lane_labels
from torchmbd.viz.figures import BAD, CYCLE, LINE, figure_of, titled, wrapped

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from torchmbd.integrate import Trajectory

_CHUNK = 500_000  # indices in memory at once
_BESIDE = 75  # characters of the smallest letters beside the label of an axis and the handle of a legend
_ROW, _TEXT = 2.1, 0.17  # heights of a row without its legend, and of a line of that [in]
_FACES = ("bottom", "top")


def failure_map(
    motion: Trajectory,
    body: str,
    labels: Sequence[str] | None = None,
    criterion: str = "tsai_wu",
    title: str = "",
) -> Figure:
    """The largest failure index that every cell of a laminated body sees during a motion, and where and when it is largest.

    motion     a lane for each design
    body       name of the body; its plies have a Strength
    labels     a name for each lane; None: "design 1", "design 2", ...
    criterion  as in `PlyFailure`
    title      of the figure

    >>> motion = mbd.simulate(mbd.examples.arm(), 0.1, steps=40)
    >>> figure = mbd.viz.failure_map(motion, "arm", ["start"])
    >>> figure.axes[0].get_title(loc="left").startswith("start:")
    True
    """
    labels = lane_labels(motion, labels)
    owner: Any = motion.system.body(body)
    if getattr(owner, "plates", None):
        indices = _of_plates(motion, body, criterion)
        return titled(_on_mesh(owner, indices, labels, criterion), title)
    if laminated(owner):
        return titled(_along_beams(motion, body, labels, criterion), title)
    raise InputError(
        str(body), allowed="a plate or a beam of laminated sections", noun=f"body {body!r}", state="has no plies"
    )


def _of_plates(motion: Trajectory, body: str, criterion: str) -> list[tuple[np.ndarray, str]]:
    """Return for each lane the largest index of each cell, and a text about the largest of all."""
    plies = PlyHistory(motion, body)
    if plies.strength is None or criterion not in CRITERIA:
        plies.failure(criterion)  # raises InputError
    assert plies.strength is not None
    cells = int(plies.points[:, 0].max()) + 1
    indices = []
    for basis, w, strength in zip(plies.basis.stress.detach(), plies.w.detach(), plies.strength.detach(), strict=True):
        largest, when = _largest(FailureForms(criterion, basis, strength), w, len(basis))
        most = torch.full((cells,), -torch.inf, dtype=largest.dtype).scatter_reduce(
            0, plies.points[:, 0], largest, "amax"
        )
        point = int(largest.argmax())
        cell, layer, face = plies.points[point].tolist()
        place = f"{float(largest[point]):.3g} at t = {float(motion.t[when[point]]):.4g} s"
        place += f", cell {cell}, layer {layer + 1}, {_FACES[face]}"
        indices.append((most.numpy(), place))
    return indices


def _largest(index: Any, w: Tensor, points: int) -> tuple[Tensor, Tensor]:
    """Return the largest index of each point over the times, and the index of its time."""
    largest = torch.full((points,), -torch.inf, dtype=w.dtype)
    when = torch.zeros(points, dtype=torch.long)
    size = max(1, _CHUNK // points)
    for k, chunk in enumerate(w.split(size)):
        value, time = index(chunk.nan_to_num()).reshape(len(chunk), points).max(0)
        when = torch.where(value > largest, time + k * size, when)
        largest = torch.maximum(largest, value)
    return largest, when


def _on_mesh(owner: Any, indices: list[tuple[np.ndarray, str]], labels: Sequence[str], criterion: str) -> Figure:
    from matplotlib.collections import PolyCollection

    mesh = owner.mesh
    flat, names = _flat(mesh.nodes.detach().numpy())
    corners = [flat[cell] for cells in (mesh.triangles, mesh.quads) for cell in cells.numpy()]
    shown = [values for values, _ in indices]
    low, high = min(0.0, *(float(v.min()) for v in shown)), max(float(v.max()) for v in shown)
    width, height = np.ptp(flat, axis=0)
    figure, rows = figure_of(1.7 + len(indices) * min(3.2, 0.8 + 5.0 * height / width), rows=len(indices))
    for axes, (values, place), label in zip(rows, indices, labels, strict=True):
        parts = PolyCollection(corners, array=values[: len(corners)], cmap="viridis", edgecolors="face", linewidths=0.2)
        parts.set_clim(low, high)
        axes.add_collection(parts)
        worst = np.mean(corners[int(values.argmax())], axis=0)
        axes.plot(*worst, "o", ms=9, mfc="none", mec=BAD, mew=1.6)
        axes.set_title(wrapped(f"{label}:\nlargest index {place}", _BESIDE), loc="left", fontsize=8)
        axes.set_aspect("equal")
        axes.autoscale_view()
        axes.set_ylabel(f"{names[1]} [m]", fontsize=8)
        axes.grid(False)
    rows[-1].set_xlabel(f"{names[0]} of {owner.name} [m]", fontsize=8)
    scale = f"failure index of {owner.name} ({criterion.replace('_', ' ')}), largest of all times, layers and faces"
    colors = rows[-1].collections[0]
    figure.colorbar(colors, ax=rows, label=wrapped(scale, LINE), location="bottom", aspect=50, shrink=0.9)
    return figure


def _flat(nodes: np.ndarray) -> tuple[np.ndarray, Sequence[str]]:
    """Return the nodes [n, 3] seen along the axis in which they spread least [n, 2], and what its axes are.

    In body axes if the nodes are flat in one.
    """
    spread = np.ptp(nodes, axis=0)
    axes = np.sort(np.argsort(-spread)[:2])
    if spread.min() <= 1e-9 * spread.max():
        return nodes[:, axes], ["xyz"[k] for k in axes]
    _, _, directions = np.linalg.svd(nodes - nodes.mean(0), full_matrices=False)
    return (nodes - nodes.mean(0)) @ directions[:2].T, ("longest way", "across")


def _along_beams(motion: Trajectory, body: str, labels: Sequence[str], criterion: str) -> Figure:
    owner: Any = motion.system.body(body)
    beams = SectionHistory(motion, body)
    parts = tuple(laminated(owner))
    curves = {key: [_curve(motion, beams, key, lane, criterion) for lane in range(motion.lanes)] for key in parts}
    legends = {
        key: [wrapped(f"{label}: {curve.text}", _BESIDE) for label, curve in zip(labels, curves[key], strict=True)]
        for key in parts
    }
    lines = {key: sum(1 + text.count("\n") for text in texts) + (len(parts) > 1) for key, texts in legends.items()}
    heights = [_ROW + _TEXT * lines[key] for key in parts]
    figure, rows = figure_of(0.9 + sum(heights), rows=len(parts), ratios=heights)
    for axes, key in zip(rows, parts, strict=True):
        for curve, legend, color in zip(curves[key], legends[key], CYCLE * len(labels), strict=False):
            axes.plot(curve.places, curve.indices, color=color, lw=1.3, label=legend)
            axes.plot(*curve.largest, "o", ms=7, mfc="none", mec=BAD, mew=1.4)
        axes.set_ylabel(wrapped(f"failure index of {body} ({criterion.replace('_', ' ')})", 30), fontsize=8)
        axes.set_ylim(bottom=0.0)
        title: dict[str, Any] = {"title": key, "title_fontsize": 8} if len(parts) > 1 else {}
        axes.legend(frameon=False, fontsize=8, loc="lower left", bbox_to_anchor=(0.0, 1.0), alignment="left", **title)
    rows[-1].set_xlabel(f"length along {body} [m]")
    return figure


class _Curve(NamedTuple):
    """The index at both ends of the elements of a part [2 m and gaps]; where it is largest, and a text about that."""

    places: np.ndarray
    indices: np.ndarray
    largest: tuple[float, float]
    text: str


def _curve(motion: Trajectory, beams: SectionHistory, key: str, lane: int, criterion: str) -> _Curve:
    basis, strength = beams.basis(key)
    if strength is None:
        beams.failure(criterion)  # raises InputError
    assert strength is not None
    index = FailureForms(criterion, basis[lane].detach(), strength[lane].detach())
    places = _places(motion.system.body(beams.name), beams, key, lane)
    largest, when = _largest(index, beams.w[lane].detach(), basis.shape[1])
    indices = largest.unflatten(0, (places.size, -1)).amax(1).numpy()
    point, worst = int(largest.argmax()), int(indices.argmax())
    text = f"{indices[worst]:.3g} at t = {float(motion.t[when[point]]):.4g} s"
    gaps = 2 * (1 + np.flatnonzero(np.abs(places[1:, 0] - places[:-1, 1]) > 1e-9 * places.max()))
    x, y = (np.insert(values, gaps, np.nan) for values in (places.ravel(), indices))
    return _Curve(x, y, (places.ravel()[worst], indices[worst]), text)


def _places(owner: Any, beams: SectionHistory, key: str, lane: int) -> np.ndarray:
    """Return where the elements of a part start and end [m, 2]: along the beam, or along the part if elements branch [m]."""
    elements = owner.mesh.elements
    members = {part: owner.beams[part].matrices.members for part in beams.parts}
    covered = sorted(k for indices in members.values() for k in indices.tolist()) == list(range(len(elements)))
    if not covered or not torch.equal(elements[1:, 0], elements[:-1, 1]):
        ends = beams.lengths(key)[lane].detach().cumsum(0)
        return torch.stack([ends - beams.lengths(key)[lane].detach(), ends], 1).numpy()
    lengths = torch.zeros(len(elements), dtype=torch.float64)
    for part, indices in members.items():
        lengths[indices] = beams.lengths(part)[lane].detach()
    ends = lengths.cumsum(0)
    return torch.stack([ends - lengths, ends], 1)[members[key]].numpy()
