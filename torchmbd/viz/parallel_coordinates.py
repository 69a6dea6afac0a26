"""Parallel coordinates of designs: a line for each, over one axis for each variable and one for the objective.

The plot of MLflow needs a server and knows no feasible designs; this one stands in reports, which need nothing else.
Checked in tests/viz/test_criteria.py.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from torchmbd.errors import InputError
from torchmbd.viz.figures import BEST, OTHER, figure_of, titled, wrapped

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LINES = 3  # of a heading below an axis


def parallel_coordinates(
    designs: Any,
    objectives: Sequence[float] | np.ndarray,
    headings: Sequence[str],
    feasible: Sequence[bool] | None = None,
    bounds: tuple[Any, Any] | None = None,
    objective: str = "objective",
    title: str = "",
    largest: bool = False,
) -> Figure:
    """A line for each design, darker for better designs; the best is thick, designs that are not feasible are dashed.

    designs     [count, n], in the units of the headings
    objectives  of the designs [count]
    headings    of the n variables
    feasible    of every design; None: all are
    bounds      (lower, upper) [n] of the axes; None or infinite: those of the designs
    objective   heading of the last axis
    title       of the figure
    largest     whether the best has the largest objective, not the smallest

    >>> figure = mbd.viz.parallel_coordinates([[45.0, 0.0], [30.0, 60.0]], [2.0, 1.0], ["ply 1 [deg]", "ply 2 [deg]"])
    >>> [text.get_text() for text in figure.axes[0].get_xticklabels()]
    ['ply 1\\n[deg]', 'ply 2\\n[deg]', 'objective']
    """
    X, y = np.asarray(designs, dtype=float), np.asarray(objectives, dtype=float)
    if X.ndim != 2 or not len(X) or X.shape != (len(y), len(headings)):
        raise InputError(
            "designs",
            X,
            f"must have shape ({len(y)}, {len(headings)}), a row for each objective, a column for each heading",
            state=f"have shape {X.shape}",
        )
    good = np.ones(len(X), dtype=bool) if feasible is None else np.asarray(feasible, dtype=bool)
    all_ = np.column_stack([X, y])
    low, high = np.nanmin(all_, axis=0), np.nanmax(all_, axis=0)
    if bounds is not None:
        for edge, bound in zip((low, high), bounds, strict=True):
            values = np.broadcast_to(np.asarray(bound, dtype=float), len(headings))
            edge[:-1] = np.where(np.isfinite(values), values, edge[:-1])
    span = np.where(high > low, high - low, 1.0)
    share = np.where(high > low, (all_ - low) / span, 0.5)
    figure, (axes,) = figure_of(4.0)
    figure.set_size_inches(max(6.0, 0.75 * all_.shape[1] + 1.5), 4.0)
    places = np.arange(all_.shape[1])
    worse = -y if largest else y
    rank = np.argsort(np.argsort(-worse))
    order = np.argsort(rank + len(X) * good)  # the best is drawn last
    for k in order:
        shade = str(0.8 * (1.0 - (rank[k] + 1) / len(X)))
        axes.plot(
            places, share[k], color=shade if good[k] else OTHER, lw=0.9, ls="-" if good[k] else ":", marker="o", ms=2.5
        )
    if good.any():
        k = int(np.nanargmin(np.where(good, worse, np.nan)))
        axes.plot(places, share[k], color=BEST, lw=2.2, marker="o", ms=4, label="best")
    axes.plot([], [], color="0.4", lw=0.9, label="other starts, the better the darker")
    if not good.all():
        axes.plot([], [], color=OTHER, lw=0.9, ls=":", label="not feasible")
    for k in places:
        axes.vlines(k, 0.0, 1.0, color="#444444", lw=0.8, zorder=0)  # between its numbers, not through them
        for edge, text, va in ((-0.03, low[k], "top"), (1.03, high[k], "bottom")):
            axes.text(k, edge, f"{text:.4g}", ha="center", va=va, fontsize=7)
    if len(_lines(objective)) > _LINES:  # a long objective has its own line below
        axes.set_xlabel(wrapped(f"objective: {objective}", 90), fontsize=8, labelpad=8)
        objective = "objective" + "".join(objective.rpartition(" [")[1:]) * objective.endswith("]")
    words = [*headings, objective]
    axes.set_xticks(places, ["\n".join(_lines(word)) for word in words], fontsize=8)
    axes.tick_params(axis="x", pad=14, length=0)
    axes.set_yticks([])
    axes.spines[["left", "bottom"]].set_visible(False)
    axes.grid(False)
    axes.legend(frameon=False, fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.08), ncols=3)
    return titled(figure, title)


def _lines(heading: str) -> list[str]:
    name, bracket, unit = heading.partition(" [")
    return [*textwrap.wrap(name, 14), *([f"[{unit}"] if bracket else [])]
