"""Figures of the objective and the constraints of a problem over time and over iterations; the parts of a weighted sum.

Names and units come from the responses (design/words.py); angles are drawn in degrees. Checked in tests/viz/test_criteria.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from torchmbd.design.curve import samples_over_time
from torchmbd.design.problem import Problem
from torchmbd.design.problem_parts import responses_of
from torchmbd.design.response import Total
from torchmbd.design.weighted import WeightedSum
from torchmbd.design.words import unit, words
from torchmbd.errors import InputError
from torchmbd.summary import plural
from torchmbd.viz.animation import lane_labels
from torchmbd.viz.figures import BAD, CYCLE, LINE, best_on_top, figure_of, over_time, titled, wrapped
from torchmbd.viz.panels import SIGNS, display_unit, first_limits, full_name, panels_of, require_problem

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from torchmbd.integrate import Trajectory
    from torchmbd.optimization.optimizer import Iterate

_SHORT = 24  # characters of the label of a low row
_WHOLE = 0.9  # of the motion: a longer window is not drawn by itself
_APART = 30.0  # ratio of the largest values of designs from which on an axis of a window is logarithmic
_FAR = 3.0  # ranges of the curves: a limit that is farther away is written, not drawn


def criteria_over_time(
    problem: Problem, motion: Trajectory, labels: Sequence[str] | None = None, title: str = ""
) -> Figure | None:
    """The histories of the objective and the constraints of a problem, with their limits; a curve for each design.

    A window of a response, such as the dwell after a move, is drawn once more by itself.

    problem  an mbd.Problem
    motion   its motion, a lane for each design, as problem.simulate(X)
    labels   a name for each lane; None: "design 1", "design 2", ...
    title    of the figure

    None for a problem of masses and frequencies, which has no histories.

    >>> arm = mbd.examples.arm()
    >>> energy = mbd.StrainEnergy("arm")
    >>> problem = mbd.Problem(arm, 0.1, mbd.Integral(energy), mbd.Max(energy) <= 5.0, steps=40)
    >>> figure = mbd.viz.criteria_over_time(problem, problem.motion(problem.start), ["start"])
    >>> figure.axes[0].get_ylabel()
    'strain energy of arm [J]'
    """
    require_problem(problem)
    labels = lane_labels(motion, labels)
    panels = panels_of(problem)
    if not panels:
        return None
    whole = float(motion.t[0]), float(motion.t[-1])
    spans = []
    for panel in panels:  # a part of the motion is drawn once more: what counts there may be small beside the rest
        short = [window for window in panel.windows if window[1] - window[0] < _WHOLE * (whole[1] - whole[0])]
        spans += [(panel, span) for span in dict.fromkeys([whole, *short])]
    figure, rows = figure_of(1.0 + 2.1 * len(spans), rows=len(spans), sharex=False)
    for axes, (panel, span) in zip(rows, spans, strict=True):
        factor, name = display_unit(unit(panel.history))
        curves = [samples_over_time(panel.history, motion, lane) for lane in range(motion.lanes)]
        drawn = [(x.numpy(), factor * np.asarray(y.detach())) for x, y in curves]
        for (x, y), label, color in zip(drawn, labels, CYCLE * len(labels), strict=False):
            over_time(axes, x, y, label, color)
        parts = [y[(x >= span[0]) & (x <= span[1])] for x, y in drawn]
        inside = np.concatenate(parts)
        if span == whole:
            _limits(axes, inside, [(factor * x, kind) for x, kind in panel.limits], name)
            for window in panel.windows:
                axes.axvspan(*window, color="#f0f0f0", zorder=0)
        else:
            _show_only(axes, parts)
        said = "; ".join(panel.goals) if span == whole else f"the window {span[0]:.4g} to {span[1]:.4g} s"
        axes.set_title(wrapped(said, LINE), loc="left", fontsize=8)
        axes.set_ylabel(_label(full_name(panel.history), name), fontsize=8)
        if axes.get_yscale() == "linear":
            axes.ticklabel_format(axis="y", scilimits=(-2, 4))
        axes.set_xlim(*span)
    rows[-1].set_xlabel("time [s]")
    _legend(figure, rows)
    return titled(figure, title)


def criteria_over_iterations(
    problem: Problem, searches: Mapping[str, Sequence[Iterate]], best: str | None = None, title: str = ""
) -> Figure:
    """Objective and every constrained response over the iterations of all starts, with the limits; the best start stands out.

    problem   an mbd.Problem
    searches  name of a start -> its iterates, as `.history` of its result
    best      name of the best start
    title     of the figure

    A response of several rows is drawn by the row that is nearest to its limit.

    >>> problem = mbd.Problem(mbd.examples.arm(), 0.02, mbd.Integral(mbd.StrainEnergy("arm")), steps=20)
    >>> result = mbd.optimize(problem, max_iterations=1, progress=False)
    >>> figure = mbd.viz.criteria_over_iterations(problem, {"start 0": result.history}, best="start 0")
    >>> figure.axes[-1].get_xlabel()
    'iteration'
    """
    require_problem(problem)
    searches = {name: [i for i in history if np.isfinite(i.objective)] for name, history in searches.items()}
    searches = {name: history for name, history in searches.items() if history}
    if not searches:
        raise InputError("searches", searches, "must contain at least one start with one iterate", state="is empty")
    figure, rows = figure_of(1.4 + 1.5 * (1 + len(problem.constraints)), rows=1 + len(problem.constraints))
    for name, style in best_on_top(searches, best):
        steps = [iterate.iteration for iterate in searches[name]]
        for axes, curve in zip(rows, _curves(problem, searches[name]), strict=True):
            axes.plot(steps, curve, marker="o", ms=2.5, **style)
    _, name = display_unit(unit(problem.stated_objective))
    rows[0].set_ylabel(_label(words(problem.stated_objective), name, _SHORT), fontsize=8)
    if all(value > 0.0 for line in rows[0].lines for value in np.asarray(line.get_ydata(), dtype=float)):
        rows[0].set_yscale("log")
    for axes, constraint, limit in zip(rows[1:], problem.constraints, first_limits(problem), strict=True):
        factor, name = display_unit(unit(constraint.measure))
        drawn = np.concatenate([np.asarray(line.get_ydata(), dtype=float) for line in axes.lines])
        _limits(axes, drawn, [(factor * limit, constraint.kind)], name)
        axes.set_ylabel(_label(words(constraint.measure), name, _SHORT), fontsize=8)
        axes.ticklabel_format(axis="y", scilimits=(-2, 4))
    rows[-1].set_xlabel("iteration")
    rows[-1].locator_params(axis="x", integer=True)
    _legend(figure, rows)
    return titled(figure, title or plural(len(searches), "start"))


def weighted_parts(
    problem: Problem, motion: Trajectory, labels: Sequence[str] | None = None, title: str = ""
) -> Figure | None:
    """The parts of an objective that is a sum, times their weights: a bar for each design; None for other objectives.

    Arguments as in `criteria_over_time`.

    >>> arm = mbd.examples.arm()
    >>> both = mbd.WeightedSum([(0.7, mbd.Mass("arm")), (0.3, mbd.Integral(mbd.StrainEnergy("arm")))])
    >>> problem = mbd.Problem(arm, 0.02, both, steps=20)
    >>> figure = mbd.viz.weighted_parts(problem, problem.motion(problem.start), ["start"])
    >>> [text.get_text() for text in figure.axes[0].get_yticklabels()]
    ['0.7 x mass of arm', '0.3 x integral of...']
    """
    require_problem(problem)
    labels = lane_labels(motion, labels)
    if not isinstance(problem.stated_objective, Total) or len(problem.stated_objective.terms) < 2:
        return None
    measure = problem.reference.measures[0]
    if problem.sign < 0.0:  # the measure is the negative of the objective
        assert isinstance(measure, Total)
        [(_, measure)] = measure.terms
    assert isinstance(measure, Total)
    scales = measure.normalize if isinstance(measure, WeightedSum) else None
    divisors = [1.0] * len(measure.terms) if scales is None else [float(s) for s in scales]
    names, values = [], []
    for (weight, part), divisor in zip(measure.terms, divisors, strict=True):
        names.append(f"{weight:g} x {words(part)}")
        values.append(weight / divisor * np.asarray(part(motion).detach()))
    figure, (axes,) = figure_of(1.4 + 0.25 * len(names) * (1 + len(labels)))
    thick, places = 0.8 / len(labels), np.arange(len(names))
    for k, (label, color) in enumerate(zip(labels, CYCLE * len(labels), strict=False)):
        heights = np.array([value[k] for value in values])
        axes.barh(
            places + (k - 0.5 * (len(labels) - 1)) * thick,
            heights,
            thick,
            color=color,
            label=f"{label}: {heights.sum():.4g}",
        )
    axes.set_yticks(places, [_label(name, "") for name in names], fontsize=8)
    axes.invert_yaxis()
    axes.set_xlabel(f"weight x criterion{' / its size at start' if problem.objective.refers_to_start else ''}")
    _legend(figure, [axes])
    return titled(figure, title)


def _curves(problem: Problem, history: Sequence[Iterate]) -> list[np.ndarray]:
    """Return objective and constrained responses over the iterates; of several rows the one nearest to its limit."""
    factor, _ = display_unit(unit(problem.stated_objective))
    curves = [problem.sign * factor * np.array([iterate.objective for iterate in history])]
    scaled = np.array([np.atleast_1d(iterate.constraints) for iterate in history])[:, problem.peaks :]
    responses = responses_of(problem.constraints, problem.constraint_rows, problem.reference, scaled)
    for constraint, values in zip(problem.constraints, responses, strict=True):
        curves.append(display_unit(unit(constraint.measure))[0] * values)
    return curves


def _show_only(axes: Axes, parts: Sequence[np.ndarray]) -> None:
    """Scale an axis by the values that are seen, of each design [n]; by powers of ten where designs are far apart."""
    parts = [y[np.isfinite(y)] for y in parts]
    values = np.concatenate(parts)
    peaks = [float(y.max()) for y in parts if y.size]
    if not values.size or values.max() <= values.min():
        return
    if values.min() >= 0.0 and max(peaks) > _APART * min(peaks) > 0.0:
        axes.set_yscale("log")
        axes.set_ylim(1e-2 * min(peaks), 2.0 * max(peaks))  # a square has zeros, which have no place there
        return
    edge = 0.08 * float(values.max() - values.min())
    axes.set_ylim(float(values.min()) - edge, float(values.max()) + edge)


def _limits(axes: Axes, values: np.ndarray, limits: Sequence[tuple[float, str]], name: str) -> None:
    """Draw limits near the curves as lines, and write those that are far away."""
    good = values[np.isfinite(values)]
    low, high = (float(good.min()), float(good.max())) if good.size else (0.0, 1.0)
    reach = _FAR * max(high - low, 0.05 * max(abs(low), abs(high)))
    for limit, kind in limits:
        label = f"{SIGNS[kind]} {limit:.4g} {name}".rstrip()
        if low - reach <= limit <= high + reach:
            axes.axhline(limit, color=BAD, lw=1.0, ls="--", label="limit")
        else:
            side = "above" if limit > high else "below"
            room = 0.2 * (high - low) or 0.05 * abs(high) or 1.0  # for the text, which no curve crosses
            axes.set_ylim(low - room * (side == "below") - 0.05 * room, high + room * (side == "above") + 0.05 * room)
            place = {"above": (0.99, 0.97, "top"), "below": (0.99, 0.03, "bottom")}[side]
            axes.text(
                *place[:2],
                f"limit, {label}: {side}",
                transform=axes.transAxes,
                ha="right",
                va=place[2],
                fontsize=7,
                color=BAD,
            )


def _label(said: str, name: str, width: int = 30) -> str:
    return wrapped(f"{said} [{name}]" if name else said, width)


def _legend(figure: Figure, rows: Sequence[Axes]) -> None:
    """One legend for all axes, each entry once."""
    entries: dict[str, Any] = {}
    for axes in rows:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    if entries:
        labels = [wrapped(label, LINE) for label in entries]
        columns = 3 if max(map(len, labels)) <= LINE // 3 else 1
        figure.legend(entries.values(), labels, frameon=False, fontsize=8, loc="outside lower left", ncols=columns)
