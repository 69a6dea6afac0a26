"""Figures of the vibrations of a system: frequencies over speed (Campbell), and poles over a variable (root locus).

They draw numbers, each column one vibration; a crossing lies on the straight line between two speeds.
Checked in tests/extensions/vibrations/pictures/test_spectra.py.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.viz.figures import BAD, CYCLE, OTHER, figure_of, titled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_REVOLUTION = 2.0 * math.pi
_PAPER = {"facecolor": "white", "alpha": 0.7, "lw": 0.0, "pad": 0.5}  # behind numbers on lines
_WRITTEN = 14  # crossings with a number beside them, at most
#: Damping ratio that is rounding: slow poles of stiff rotors have 3e-6.
UNDAMPED = 1e-5
_LETTER = 0.62  # width of a letter by its size
_SENSES = {1: ("-", "forward whirl"), -1: ("--", "backward whirl"), 0: (":", "neither, or several")}


def campbell(
    speeds: Any,
    frequencies: Any,
    damping: Any = None,
    orders: Sequence[float] = (1, 2, 3),
    title: str = "",
    whirl: Any = None,
) -> Figure:
    """Frequencies over speed with lines of 1, 2, 3 vibrations per revolution; their crossings are marked by the speed.

    speeds       ascending [k] [rad/s]
    frequencies  [k, n] [Hz], a column for each vibration; nan where there is none
    damping      damping ratios [k, n] [-], in a second panel; both panels mark those below -0.001 %, which grow
    orders       vibrations per revolution
    title        of the figure
    whirl        [k, n], as in `campbell`: forward whirl is drawn solid, backward dashed, all else dotted; None: all solid

    >>> speeds = torch.linspace(0.0, 300.0, 31, dtype=torch.float64)
    >>> frequencies = torch.stack([20.0 - 0.02 * speeds, 20.0 + 0.03 * speeds], 1)
    >>> figure = mbd.viz.campbell(speeds, frequencies)
    >>> figure.axes[0].get_ylabel()
    'frequency [Hz]'
    """
    x, f, zeta = _numbers("speeds", speeds), _numbers("frequencies", frequencies), None
    if x.ndim != 1 or len(x) < 2 or not (np.diff(x) > 0.0).all():
        raise InputError("speeds", speeds, "two or more in ascending order [rad/s]")
    _require_columns("frequencies", f, x)
    if damping is not None:
        zeta = _numbers("damping", damping)
        _require_columns("damping", zeta, x, f.shape[1])
    if not isinstance(orders, (list, tuple)) or not all(isinstance(n, (int, float)) and n > 0.0 for n in orders):
        raise InputError("orders", orders, "positive numbers, such as (1, 2, 3)")
    ratios = None if zeta is None else (3, 1.2)
    figure, axes = figure_of(4.2 if zeta is None else 5.6, rows=1 if zeta is None else 2, ratios=ratios)
    top = axes[0]
    if whirl is None:
        for k, column in enumerate(f.T):
            top.plot(x, column, color=CYCLE[k % len(CYCLE)], lw=1.4)
    else:
        senses = _numbers("whirl", whirl)
        _require_columns("whirl", senses, x, f.shape[1])
        _whirls(top, x, f, senses)
    height = 1.08 * float(np.nanmax(f))
    top.set(xlim=(float(x[0]), float(x[-1])), ylim=(0.0, height), ylabel="frequency [Hz]")
    _orders(top, x, f, orders, height)
    if zeta is not None:
        _damping(top, axes[1], x, f, zeta)
    axes[-1].set_xlabel("speed [rad/s]")
    turns = top.secondary_xaxis("top", functions=(_per_minute, _per_second))
    turns.set_xlabel("[revolutions per minute]", fontsize=8)
    turns.tick_params(labelsize=8)
    turns.spines["top"].set_visible(False)
    return titled(figure, title)


def _whirls(axes: Any, x: Any, f: Any, senses: Any) -> None:
    """Draw lines whose dashes tell the sense; between two speeds it is that at the second, since nothing whirls at rest."""
    drawn: dict[str, Any] = {}
    for k in range(f.shape[1]):
        cuts = [0, *(np.diff(senses[1:, k]).nonzero()[0] + 1).tolist(), len(x) - 1]
        for first, last in itertools.pairwise(cuts):
            dashes, label = _SENSES[int(senses[last, k])]
            piece = slice(first, last + 1)
            (line,) = axes.plot(x[piece], f[piece, k], dashes, color=CYCLE[k % len(CYCLE)], lw=1.4)
            drawn.setdefault(label, line)
    labels = [label for _, label in _SENSES.values() if label in drawn]
    axes.legend([drawn[label] for label in labels], labels, fontsize=8, frameon=False, loc="best")


def root_locus(values: Any, poles: Any, heading: str, title: str = "") -> Figure:
    """Poles in the complex plane, colored by a variable; those on the right grow.

    values   of the variable [k], such as a speed or a design variable, in the unit of `heading`
    poles    complex [k, n] [1/s]; of pairs the upper one is drawn
    heading  name and unit of the variable
    title    of the figure

    >>> c = torch.linspace(0.0, 1.5, 16, dtype=torch.float64)
    >>> poles = torch.complex(-0.5 * c, (4.0 - 0.25 * c**2).sqrt())[:, None]
    >>> figure = mbd.viz.root_locus(c, poles, "damper [N s/m]")
    >>> figure.axes[0].get_xlabel()
    'real part [1/s]'
    """
    b, s = _numbers("values", values), _numbers("poles", poles, complex)
    if b.ndim != 1 or not len(b):
        raise InputError("values", values, "numbers [k]")
    _require_columns("poles", s, b)
    figure, (axes,) = figure_of(4.6)
    shown = np.isfinite(s) & (s.imag >= 0.0)
    color = np.broadcast_to(b[:, None], s.shape)[shown]
    dots = axes.scatter(s.real[shown], s.imag[shown], c=color, s=14, cmap="viridis", zorder=3)
    for name, marker, row in (("first", "o", 0), ("last", "s", -1)):
        ends = s[row][shown[row]]
        axes.plot(ends.real, ends.imag, marker, color="none", mec=CYCLE[0], ms=7, label=f"{name}: {b[row]:.4g}")
    axes.axvline(0.0, color=CYCLE[0], lw=0.9)
    swings = shown & (s.imag >= np.abs(s.real))  # strongly damped poles would leave no room for the others
    x, top = s.real[swings if swings.any() else shown], float(s.imag[shown].max())
    width = float(max(x.max(), 0.0) - min(x.min(), 0.0)) or 1.0
    low, high = min(float(x.min()), 0.0) - 0.06 * width, max(float(x.max()), 0.0) + 0.12 * width
    axes.axvspan(0.0, high, color=BAD, alpha=0.08, lw=0.0)
    notes = {"fontsize": 8, "textcoords": "offset points", "xycoords": axes.get_xaxis_transform()}
    axes.annotate("grows", (0.0, 0.0), (4, 4), color=BAD, **notes)
    if beyond := int((shown & (s.real < low)).any(0).sum()):
        axes.annotate(f"{beyond} more on the left", (low, 0.0), (4, 4), color="#666666", **notes)
    axes.set(xlim=(low, high), ylim=(0.0, 1.06 * top or 1.0), xlabel="real part [1/s]", ylabel="imaginary part [rad/s]")
    figure.colorbar(dots, ax=axes, label=heading)
    axes.legend(frameon=False, fontsize=8)
    return titled(figure, title)


def crossings(speeds: np.ndarray, frequencies: np.ndarray, order: float) -> np.ndarray:
    """Speeds [rad/s] and frequencies [Hz] [m, 2] at which a vibration has `order` times the frequency of the revolution."""
    gap = frequencies - order * speeds[:, None] / _REVOLUTION
    rows, columns = np.nonzero(
        (gap[:-1] * gap[1:] < 0.0) | ((gap[:-1] == 0.0) & np.isfinite(gap[1:]) & (gap[1:] != 0.0))
    )
    share = gap[rows, columns] / (gap[rows, columns] - gap[rows + 1, columns])
    at = speeds[rows] + share * (speeds[rows + 1] - speeds[rows])
    return np.stack([at, order * at / _REVOLUTION], 1)


def _orders(axes: Axes, x: np.ndarray, f: np.ndarray, orders: Sequence[float], height: float) -> None:
    """Draw a line for each order, with its name where it leaves the picture, and its crossings."""
    points, labels = [], _Labels(axes)
    for order in orders:
        end = min(float(x[-1]), _REVOLUTION * height / order)
        axes.plot(
            [x[0], x[-1]], [order * x[0] / _REVOLUTION, order * x[-1] / _REVOLUTION], color=OTHER, lw=0.9, ls="--"
        )
        side = (-1, -1) if end < x[-1] else (1, 0)  # the line ends at the top, or on the right
        labels.write(f"{order:g}/rev.", (end, order * end / _REVOLUTION), 8, [side], color="#666666", bbox=_PAPER)
        points.append(crossings(x, f, order))
    marked = np.concatenate([*points, np.zeros((0, 2))])
    marked = marked[marked[:, 0] > 0.0]
    axes.plot(marked[:, 0], marked[:, 1], "o", color=BAD, ms=4.5, zorder=4)
    texts = {f"{at:.4g}": (at, y) for at, y in marked.tolist()}  # whirls that coincide have one label
    if len(texts) <= _WRITTEN:
        for text, place in texts.items():
            sides = [(1, -1), (-1, 1), (1, 1), (-1, -1)]
            labels.write(text, place, 7, sides, color=BAD, bbox=_PAPER)


class _Labels:
    """Labels beside points, none over another: a label that finds no place is left out."""

    def __init__(self, axes: Axes):
        self.axes, self.boxes = axes, []

    def write(
        self, text: str, at: tuple[float, float], size: float, sides: Sequence[tuple[int, int]], **options: Any
    ) -> None:
        """Write at a point, on the first of the sides (right or left, above or below) with a free place; size [points]."""
        unit = self.axes.figure.dpi / 72.0
        x, y = self.axes.transData.transform(at) / unit
        wide, high = _LETTER * size * len(text), 1.2 * size
        for right, above in sides:
            low = x + (4 if right > 0 else -4 - wide), y + (3 if above > 0 else -3 - high if above < 0 else -0.5 * high)
            box = (*low, low[0] + wide, low[1] + high)
            if all(box[0] > b[2] or box[2] < b[0] or box[1] > b[3] or box[3] < b[1] for b in self.boxes):
                self.boxes.append(box)
                place: dict[str, Any] = {"ha": "left" if right > 0 else "right"}
                place["va"] = {1: "bottom", 0: "center", -1: "top"}[above]
                offset = 4 * right, 3 * above
                self.axes.annotate(text, at, offset, textcoords="offset points", fontsize=size, **place, **options)
                return


def _damping(top: Axes, bottom: Axes, x: np.ndarray, f: np.ndarray, zeta: np.ndarray) -> None:
    """Draw damping ratios, and mark in both panels where vibrations grow."""
    for k, column in enumerate(zeta.T):
        bottom.plot(x, 100.0 * column, color=CYCLE[k % len(CYCLE)], lw=1.2)
    bottom.axhline(0.0, color=CYCLE[0], lw=0.8)
    rows, columns = np.nonzero(zeta < -UNDAMPED)
    if len(rows):
        top.plot(x[rows], f[rows, columns], "x", color=BAD, ms=5, label="grows")
        bottom.plot(x[rows], 100.0 * zeta[rows, columns], "x", color=BAD, ms=5)
        top.legend(frameon=False, fontsize=8, loc="upper left")
    if not bool((np.abs(zeta) > UNDAMPED).any()):
        bottom.set_ylim(-1.0, 1.0)  # rounding is not enlarged
    bottom.set_ylabel("damping [%]")


def _per_minute(speed: Any) -> Any:
    return speed * 60.0 / _REVOLUTION


def _per_second(turns: Any) -> Any:
    return turns * _REVOLUTION / 60.0


def _numbers(name: str, x: Any, kind: type = float) -> Any:
    try:
        return np.asarray(x.detach() if isinstance(x, Tensor) else x, dtype=kind)
    except (TypeError, ValueError):
        raise InputError(name, x, "numbers") from None


def _require_columns(name: str, y: np.ndarray, x: np.ndarray, columns: int | None = None) -> None:
    """InputError unless y is [len(x), columns] with a finite number."""
    if y.ndim != 2 or len(y) != len(x) or not y.shape[1] or columns not in (None, y.shape[1]):
        raise InputError(
            name,
            y,
            f"must have shape ({len(x)}, {('vibrations' if columns is None else columns)})",
            state=f"has shape {y.shape}",
        )
    if not np.isfinite(y).any():
        raise InputError(name, allowed="must have at least one finite number", state="has no finite number")
