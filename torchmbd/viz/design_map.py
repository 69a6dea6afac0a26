"""Figure of the design space: evaluated designs, paths of searches, and the minima in which they ended.

One variable: objective over the variable, all evaluations as dots, the paths of the starts on them.
Two variables: evaluations as dots colored by their objective; with contours if there are enough of them.
More variables: the same in the plane in which the searches spread most (principal components of their designs, each variable
divided by its range), without contours: designs that lie on top of each other may differ.
Searches that end in the same minimum have the same color.
Checked in tests/viz/test_design_map.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from torchmbd.errors import InputError
from torchmbd.viz.figures import CYCLE, OTHER, degrees, figure_of, wrapped

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_CONTOURS = 12  # evaluations from which on contours are drawn
_MINIMA = 8  # in the legend, the best first
_NAMED = 3  # variables in the heading of a direction
_WIDE = 10.0  # ratio of objectives from which on their colors and contours are logarithmic


def design_map(
    paths: Mapping[str, np.ndarray],
    objectives: Mapping[str, np.ndarray],
    headings: Sequence[str],
    ends: Mapping[str, int] | None = None,
    visited: tuple[np.ndarray, np.ndarray] | None = None,
    objective: str = "objective",
) -> Figure:
    """Draw the paths of searches through a design space; of more than two variables in the plane in which they spread most.

    paths       designs of every search [k, n], in the units of the headings
    objectives  their objectives [k]
    ends        number of the minimum in which a search ended; searches without one are gray
    visited     designs [m, n] and objectives [m] of every evaluation; those that are not finite are left out

    >>> path = np.array([[45.0, -45.0], [20.0, -20.0]])  # designs of one search [deg]
    >>> figure = mbd.viz.design_map({"start 0": path}, {"start 0": np.array([2.0, 1.0])}, ["ply 1 [deg]", "ply 2 [deg]"])
    >>> figure.axes[0].get_xlabel()
    'ply 1 [deg]'
    """
    sizes = {np.asarray(path).shape[1:] for path in paths.values()}
    if len(sizes) != 1 or (len(headings),) not in sizes:
        raise InputError(
            "paths",
            paths,
            f"must have designs of shape ({len(headings)},), a variable for each heading",
            state=f"have designs of shape {sizes or 'none'}",
        )
    flat = len(headings) > 2
    if flat:
        paths, visited, headings = _projected(paths, visited, list(headings))
    figure, (axes,) = figure_of(4.6 if flat else 4.2)
    X, y = (np.asarray(x, dtype=float) for x in (visited if visited is not None else ((), ())))
    X = X.reshape(-1, len(headings))
    seen = np.isfinite(y)
    if len(headings) == 1:
        axes.plot(X[seen, 0], y[seen], ".", color="#c0c0c0", ms=4, zorder=1)
    else:
        _plane_of_designs(axes, X[seen], y[seen], objective, contours=not flat)
    named = set()
    for name, path in paths.items():
        end = None if ends is None else ends.get(name)
        color = OTHER if end is None else CYCLE[1:][end % (len(CYCLE) - 1)]
        label = (
            "did not converge" if end is None else f"ends in minimum {end + 1}" if end < _MINIMA else "ends in another"
        )
        label = None if ends is None or label in named else label
        named.add(label)
        across = np.asarray(path)[:, 0]
        up = np.asarray(objectives[name]) if len(headings) == 1 else np.asarray(path)[:, 1]
        axes.plot(across, up, color=color, lw=0.9, marker="o", ms=2, label=label)
        axes.plot(across[:1], up[:1], "s", color=color, ms=5, mfc="white")
        axes.plot(across[-1:], up[-1:], "*", color=color, ms=11, mec="black", mew=0.5)
    axes.use_sticky_edges = False  # contours: what lies at the border is seen as a whole
    axes.autoscale_view()
    axes.set_xlabel(headings[0])
    axes.set_ylabel(headings[1] if len(headings) == 2 else wrapped(objective, 50))
    degrees(axes, **dict(zip("xy", headings, strict=False)))
    axes.plot([], [], "s", color="black", ms=5, mfc="white", label="start")
    axes.plot([], [], "*", color="black", ms=9, label="end")
    entries = sorted(zip(*axes.get_legend_handles_labels(), strict=True), key=lambda e: (e[1][:4] != "ends", e[1]))
    handles, labels = zip(*entries, strict=True)
    figure.legend(handles, labels, frameon=False, fontsize=8, loc="outside upper left", ncols=4)  # nothing is hidden
    return figure


def _projected(
    paths: Mapping[str, np.ndarray], visited: tuple[np.ndarray, np.ndarray] | None, headings: list[str]
) -> tuple[dict[str, np.ndarray], tuple[np.ndarray, np.ndarray] | None, list[str]]:
    """Return paths and visited designs in the plane in which the paths spread most, with headings of its axes."""
    X = np.concatenate([np.asarray(path, dtype=float) for path in paths.values()])
    middle, span = X.mean(0), np.ptp(X, axis=0)
    span = np.where(span > 0.0, span, 1.0)
    _, sizes, directions = np.linalg.svd((X - middle) / span, full_matrices=False)
    directions = np.vstack([directions, np.zeros((2, len(headings)))])[:2]  # of a single design there is no direction
    shares = np.append(sizes**2 / max(float((sizes**2).sum()), 1e-300), [0.0, 0.0])

    def plane(designs: np.ndarray) -> np.ndarray:
        return (np.asarray(designs, dtype=float).reshape(-1, len(headings)) - middle) / span @ directions.T

    names = []
    for k, direction in enumerate(directions):
        first = [headings[i].partition(" [")[0] for i in np.argsort(-np.abs(direction))[:_NAMED]]
        names.append(f"direction {k + 1} ({shares[k]:.0%} of the spread):\nmostly {', '.join(first)}")
    seen = None if visited is None else (plane(visited[0]), np.asarray(visited[1], dtype=float))
    return {name: plane(path) for name, path in paths.items()}, seen, names


def _plane_of_designs(axes: Axes, X: np.ndarray, y: np.ndarray, objective: str, contours: bool) -> None:
    if not len(X):
        return
    wide = y.min() > 0.0 and y.max() > _WIDE * y.min()
    if contours and len(X) >= _CONTOURS and np.linalg.matrix_rank(X - X.mean(0)) == 2:
        levels = np.geomspace(y.min(), y.max(), 13)[1:] if wide else 12
        axes.tricontour(X[:, 0], X[:, 1], y, levels=levels, colors="#d0d0d0", linewidths=0.7, zorder=0)
    dots = axes.scatter(X[:, 0], X[:, 1], c=y, s=12, cmap="viridis", norm="log" if wide else None, zorder=1)
    axes.figure.colorbar(dots, ax=axes, label=wrapped(objective, 50))
