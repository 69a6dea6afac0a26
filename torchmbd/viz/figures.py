"""Figures of a study, in the style of a printed paper: convergence, energy over time, criterion against angle.

Each function returns a matplotlib Figure (no pyplot, no global state); `save` writes it by the ending of the file name
(.png for a browser, .pdf or .svg for print). Colors: Okabe and Ito, distinguished by color-blind eyes as well.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.process import imports
from torchmbd.summary import plural

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Numbers = Sequence[float] | np.ndarray
BEST, OTHER, BAD = "#0072b2", "#a0a0a0", "#d55e00"
CYCLE = ("#444444", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00")


def convergence(
    objectives: Mapping[str, Numbers],
    violations: Mapping[str, Numbers],
    best: str | None = None,
    ylabel: str = "objective",
) -> Figure:
    """Objective and largest constraint violation of every start over its iterations; the best start stands out.

    >>> figure = mbd.viz.convergence({"start 0": [2.0, 1.5, 1.2]}, {"start 0": [0.0, 0.0, 0.0]})
    >>> [axes.get_ylabel() for axes in figure.axes]
    ['objective', 'violation [share]']
    """
    if not objectives or not any(len(values) for values in objectives.values()):
        raise InputError(
            "objectives", objectives, "must contain at least one start with one iteration", state="is empty"
        )
    figure, (top, bottom) = figure_of(5.4, rows=2, ratios=(3, 1))
    for name, style in best_on_top(objectives, best):
        steps = range(len(objectives[name]))
        top.plot(steps, objectives[name], marker="o", ms=2.5, **style)
        bottom.plot(steps, violations.get(name, [0.0] * len(steps)), marker="o", ms=2.5, **style)
    values = np.concatenate([np.asarray(values, dtype=float) for values in objectives.values()])
    if (values > 0).all():
        top.set_yscale("log")
    top.set_ylabel(wrapped(ylabel, 45))
    if best is not None:
        top.legend(frameon=False, loc="upper right")
    bottom.set_ylabel("violation [share]", fontsize=8)
    if not any(value > 0.0 for values in violations.values() for value in values):
        bottom.set_yticks([0.0])  # a scale would show rounding only
    bottom.set_xlabel("iteration")
    bottom.locator_params(axis="x", integer=True)
    top.set_title(plural(len(objectives), "start"), loc="left", fontsize=9)
    return figure


def best_on_top(starts: Iterable[str], best: str | None) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the name and the line style of each start, the best last."""
    for name in sorted(starts, key=lambda name: name == best):
        yield (
            name,
            {"color": BEST, "lw": 2.0, "label": f"best: {name}"} if name == best else {"color": OTHER, "lw": 0.9},
        )


def energy_over_time(t: Numbers, energies: Mapping[str, Numbers], body: str = "") -> Figure:
    """Strain energy of a body in several designs of one motion (Fig. 9).

    t         times [s]
    energies  name of the design -> energy at these times [J]
    body      name of the body, for the label

    >>> motion = mbd.simulate(mbd.examples.arm(), 0.1, steps=40)
    >>> energy = motion.body("arm").strain_energy[0]
    >>> figure = mbd.viz.energy_over_time(motion.t, {"45/-45 degrees": energy}, body="arm")
    >>> figure.axes[0].get_ylabel()
    'strain energy of arm [J]'
    """
    figure, (axes,) = figure_of(3.4)
    for (label, energy), color in zip(energies.items(), CYCLE * len(energies), strict=False):
        over_time(axes, t, energy, label, color)
    axes.set_xlabel("time [s]")
    axes.set_ylabel(f"strain energy of {body} [J]" if body else "strain energy [J]")
    axes.set_xlim(float(t[0]), float(t[-1]))
    axes.set_ylim(bottom=0.0)
    axes.legend(frameon=False)
    return figure


def over_time(axes: Axes, t: Numbers, y: Numbers, label: str, color: str) -> None:
    """Draw a history [times]; the curve of a failed lane, nan from a time on, ends with a cross and a note in its label."""
    t, y = (plain(x) for x in (t, y))
    good = np.flatnonzero(np.isfinite(y))
    last = int(good[-1]) if len(good) else 0
    fails = last < len(y) - 1
    label = f"{label} (fails at t = {t[last]:.4g} s)" if fails else label
    axes.plot(t, y, color=color, lw=1.3, label=label)
    if fails and len(good):
        axes.plot(t[last], y[last], "x", color=color, ms=7)


def plain(x: Any) -> np.ndarray:
    """Return numbers as an array, a tensor detached."""
    return np.asarray(x.detach() if isinstance(x, Tensor) else x, dtype=float)


def criterion(
    values: Numbers,
    criteria: Mapping[str, Numbers],
    xlabel: str,
    mark: float | None = None,
) -> Figure:
    """Normalized criteria against one design variable (Fig. 8); failed evaluations are gaps marked at the axis.

    values    design variable, ascending, in the unit of `xlabel`
    criteria  name -> criterion divided by its value at the start design; nan where it could not be evaluated
    mark      design variable of the start design

    >>> figure = mbd.viz.criterion([0, 45, 90], {"energy": [1.0, 0.6, 0.8]}, "ply angle [deg]", mark=0)
    >>> figure.axes[0].get_xlabel()
    'ply angle [deg]'
    """
    figure, (axes,) = figure_of(3.6)
    x = np.asarray(values, dtype=float)
    for (label, criterion), color in zip(criteria.items(), CYCLE[1:] * len(criteria), strict=False):
        y = np.asarray(criterion, dtype=float)
        axes.plot(x, y, color=color, lw=1.3, marker="o", ms=3, label=label)
        missing = ~np.isfinite(y)
        if missing.any():
            label = "failed evaluation"
            axes.plot(
                x[missing], np.zeros(missing.sum()), "x", color=BAD, transform=axes.get_xaxis_transform(), label=label
            )
    if mark is not None:
        axes.axvline(mark, color=OTHER, lw=0.8, ls="--", label="start design")
    degrees(axes, x=xlabel)
    axes.set_xlabel(xlabel)
    axes.set_ylabel("criterion / its size at start")
    axes.legend(frameon=False)
    return figure


def save(figure: Figure, path: str | Path) -> Path:
    """Write a figure; the ending of the name chooses the format.

    >>> figure = mbd.viz.energy_over_time([0.0, 1.0], {"start": [0.0, 2.0]})
    >>> mbd.viz.save(figure, "energy.svg").name
    'energy.svg'
    """
    path = Path(path)
    if path.suffix not in (".png", ".pdf", ".svg"):
        raise InputError("path", str(path), "a name that ends in .png, .pdf, .svg")
    for line in (line for axes in figure.axes for line in axes.lines):
        line.set_in_layout(False)  # lines lie inside their axes: without them the layout takes half the time
    figure.savefig(path, dpi=160)
    return path


def titled(figure: Figure, title: str) -> Figure:
    """Return the figure with a title, wrapped to its width."""
    if not isinstance(title, str):
        raise InputError("title", title, "a str")
    if title:
        figure.suptitle("\n".join(textwrap.wrap(title, 75)), x=0.01, ha="left", fontsize=10)
    return figure


def degrees(axes: Axes, x: str = "", y: str = "") -> None:
    """Mark the axes whose headings are of angles, `angle 1 [deg]`, at parts of a right angle."""
    from matplotlib.ticker import MaxNLocator

    for axis, heading in ((axes.xaxis, x), (axes.yaxis, y)):
        if heading.endswith("[deg]"):
            axis.set_major_locator(MaxNLocator(nbins=9, steps=[1.5, 3.0, 4.5, 9.0]))


LINE = 95  # characters of the smallest letters in the width of a figure


def wrapped(text: str, width: int) -> str:
    """Return a text in lines of so many characters."""
    return "\n".join(line for part in text.splitlines() for line in textwrap.wrap(part, width))


def figure_of(
    height: float, rows: int = 1, ratios: Sequence[float] | None = None, sharex: bool = True
) -> tuple[Figure, list[Axes]]:
    """Return a figure of one column, in the style of all, with its axes."""
    with imports():
        from matplotlib.figure import Figure  # half a second: imported when a figure is drawn

    figure = Figure(figsize=(6.0, height), layout="constrained")
    axes = figure.subplots(rows, 1, sharex=sharex, squeeze=False, height_ratios=ratios)[:, 0]
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
        ax.tick_params(labelsize=9)
        ax.grid(color="#e8e8e8", lw=0.6)
        ax.set_axisbelow(True)
    return figure, list(axes)
