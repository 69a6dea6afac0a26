"""The result of an identification: values with intervals, what the data cannot see, and how well model and data agree.

Checked in tests/extensions/identification/test_identify.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from torchmbd.errors import InputError
from torchmbd.extensions.identification.channel_fit import ChannelFit, agreement, channel_fits
from torchmbd.extensions.identification.deviations import NO_FREEDOM, leverages
from torchmbd.extensions.identification.fit_problem import FitProblem, Residuals, Rows
from torchmbd.extensions.identification.gauss_newton import AT_BOUND
from torchmbd.extensions.identification.least_squares import Fit, FitSettings
from torchmbd.extensions.identification.losses import LOSSES
from torchmbd.extensions.identification.profile import profile_interval
from torchmbd.extensions.identification.statistics import (
    LEVEL,
    correlations,
    covariance,
    half_widths,
    influence,
    quantile,
    variance_factor,
)
from torchmbd.extensions.identification.step_error import StepError, sentence
from torchmbd.extensions.identification.unseen import Unseen, singular_values, unseen_combinations, unseen_count
from torchmbd.optimization.optimizer import require_range
from torchmbd.summary import Summary, few, plural

_CORRELATED = 0.9
_SELDOM_NEGATIVE = (
    "mass",
    "stiffness",
    "damping",
)  # ends of names of parameters that may be, in a model that is made so

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame


@dataclass(eq=False, repr=False)
class Identification(Summary):
    """A model fitted to measurements.

    problem       the residuals as a function of the unknowns;  settings: how it was searched
    fit           the result of the best start;  starts: the results of all starts, the best one first, then by rising cost
    evaluations   simulations of a design, each with its Jacobian, of all starts;  failures: those of them that failed
    validation_problem, validation_residuals   problem and residuals of the validation experiments; None if there are none
    step_error    shift of the unknowns that the time steps cause; None without time steps, or if the fit has not converged
    start_doubts  warnings about the sizes of data and model at the start

    `fit["bob.mass"]` is the value of an unknown. The index may be left out if the parameter has one entry.

    >>> x = mbd.Position("bob", "x")
    >>> truth = mbd.simulate(mbd.examples.pendulum(), 1.0, steps=50)
    >>> sensor = mbd.identification.Channel(x, gain=mbd.variable(1.0))
    >>> swing = mbd.identification.TimeSeries({"t": truth.t, "x": 0.5 * x(truth)[0]}, {"x": sensor})
    >>> fit = mbd.identification.identify(mbd.identification.Experiment(mbd.examples.pendulum(), swing, steps=50))
    >>> fit.names, round(fit["x.gain"], 6), fit.status
    (['x.gain[0]'], 0.5, 'converged')
    """

    problem: FitProblem
    settings: FitSettings
    fit: Fit
    starts: list[Fit]
    evaluations: int
    failures: int
    validation_problem: FitProblem | None = None
    validation_residuals: Residuals | None = None
    step_error: StepError | None = None
    start_doubts: tuple[str, ...] = ()
    _profiles: dict[tuple[str, float], tuple[float, float]] = field(default_factory=dict, init=False, repr=False)

    @property
    def status(self) -> str:
        """ "converged", "stalled" beside designs that fail, "max_evaluations", "max_time", "failed" or "interrupted"."""
        return self.fit.status

    @property
    def message(self) -> str:
        """The reason of the status, one sentence."""
        return self.fit.message

    @property
    def converged(self) -> bool:
        """True if the best start ended at a minimum."""
        return self.status == "converged"

    @property
    def names(self) -> list[str]:
        """The unknowns [n]."""
        return self.problem.names

    @property
    def x(self) -> np.ndarray:
        """Values of the unknowns [n]."""
        return self.fit.x

    @property
    def start(self) -> np.ndarray:
        """Values before the fit [n]."""
        return self.problem.start

    @property
    def cost(self) -> float:
        """Half the sum of the losses of the residuals, in deviations."""
        return self.fit.cost

    @property
    def designs(self) -> dict[str, Any]:
        """Fitted parameters by name [1, ...], as `designs` of `simulate`; those of channels among them."""
        return self.problem.space.designs(self.x[None])

    def __getitem__(self, name: str) -> float:
        """The value of an unknown by its name; of a parameter of one entry also without its index."""
        return float(self.x[self._index(name)])

    def _index(self, name: str) -> int:
        for label in (name, f"{name}[0]"):
            if label in self.names:
                return self.names.index(label)
        raise InputError("name", name, self.names, noun="unknown")

    @cached_property
    def _jacobian(self) -> np.ndarray:
        """Derivatives of the residuals at the solution [rows, n]; InputError if there is none."""
        jacobian = self.fit.residuals.jacobian
        if jacobian is None:
            raise InputError(
                "result",
                self.status,
                "a fit whose start can be simulated",
                state=f"has no Jacobian: {self.status}, {self.message}",
            )
        return jacobian

    @property
    def residuals(self) -> np.ndarray:
        """Model minus data in deviations, then those of priors [rows]."""
        return self.fit.residuals.values

    @property
    def jacobian(self) -> np.ndarray:
        """Derivatives of the residuals by the unknowns [rows, n]."""
        return self._jacobian

    @property
    def searched(self) -> np.ndarray:
        """Indices of the unknowns whose bounds differ. The others are constants and do not have a standard deviation."""
        return np.flatnonzero(self.settings.lower < self.settings.upper)

    @property
    def freedoms(self) -> int:
        """Degrees of freedom: the number of samples minus the number of unknowns that were fitted."""
        return len(self.residuals) - len(self.searched)

    @cached_property
    def _freedoms_of_channels(self) -> dict[str, float]:
        """Numbers of each channel less the unknowns that it determines, which is 0 where nothing is known of its noise."""
        h = leverages(self._jacobian[:, self.searched], self.size[self.searched])
        result = {}
        for row in self.problem.rows:
            count = row.rows.stop - row.rows.start
            free = count - float(h[row.rows].sum())
            result[row.name] = free if free > NO_FREEDOM * count else 0.0
        return result

    @property
    def _unknown_noise(self) -> list[Rows]:
        """Channels whose deviation is neither given nor to be estimated, since they have no degrees of freedom."""
        return [row for row in self.problem.rows if row.estimated and not self._freedoms_of_channels[row.name]]

    @cached_property
    def _known_jacobian(self) -> np.ndarray:
        """Derivatives with respect to the searched unknowns [rows, n] of numbers with a known noise; zero for the others."""
        result = self._jacobian[:, self.searched].copy()
        for row in self._unknown_noise:
            result[row.rows] = 0.0
        return result

    @cached_property
    def covariance(self) -> np.ndarray:
        """Covariance [n, n], linearized; infinite for unknowns that the data do not determine, zero for constants."""
        searched, result = self.searched, np.zeros((len(self.names), len(self.names)))
        result[np.ix_(searched, searched)] = covariance(self._known_jacobian, self.size[searched], self.variance_factor)
        return result

    def _half_width(self, level: float) -> np.ndarray:
        """Half the width of the intervals of a level [n]; infinite for unknowns that the data do not determine, zero for
        constants.
        """
        free, k = self._freedoms_of_channels, self.searched
        channels = [(row.rows, free[row.name]) for row in self.problem.rows if row.estimated and free[row.name]]
        if self.settings.loss is not LOSSES["linear"]:  # the factor of variances is that of the residuals
            channels = [(row.rows, min(free[row.name], self.freedoms)) for row in self.problem.rows if free[row.name]]
        moves, lost = influence(self._known_jacobian, self.size[k])
        result = np.zeros(len(self.names))
        result[k] = np.where(lost, np.inf, np.sqrt(self.variance_factor) * half_widths(moves, channels, level))
        return result

    @property
    def half_width(self) -> np.ndarray:
        """Half the width of the intervals of 95 % [n]."""
        return self._half_width(LEVEL)

    @property
    def size(self) -> np.ndarray:
        """Sizes of the unknowns [n], to which changes are compared: their scales, or their values if these are larger."""
        return np.fmax(self.fit.scale, np.abs(self.x))

    @property
    def variance_factor(self) -> float:
        """Factor of the covariance (statistics.py)."""
        s = self.settings
        return variance_factor(self.residuals, s.data, len(self.searched), s.loss, s.f_scale)

    @property
    def deviation(self) -> np.ndarray:
        """Standard deviations of the unknowns [n], linearized; inf if the data do not determine them."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def interval(self) -> np.ndarray:
        """Intervals of 95 % [n, 2], linearized."""
        return np.stack([self.x - self.half_width, self.x + self.half_width], 1)

    @property
    def correlations(self) -> np.ndarray:
        """Correlations of the unknowns [n, n]; nan if the data do not determine them."""
        return correlations(self.covariance)

    @property
    def singular_values(self) -> np.ndarray:
        """Singular values of `jacobian` scaled by `size`; below 1 the data do not determine the combination of unknowns."""
        return singular_values(self._jacobian[:, self.searched], self.size[self.searched])[0]

    @cached_property
    def unseen(self) -> list[Unseen]:
        """Combinations of unknowns that the data cannot see, in words (unseen.py); a few further simulations."""

        k = self.searched

        def values(x: np.ndarray) -> np.ndarray:
            design = self.x.copy()
            design[k] = x
            return self.problem.evaluate(design[None], False)[0].values

        return unseen_combinations(self._jacobian[:, k], self.size[k], [self.names[i] for i in k], self.x[k], values)

    @property
    def at_bounds(self) -> list[str]:
        """Unknowns that end at a bound, where intervals do not hold."""
        s = self.settings
        near = AT_BOUND * self.size
        at = ((self.x - s.lower < near) | (s.upper - self.x < near)) & (s.upper > s.lower)
        return [name for name, is_there in zip(self.names, at, strict=True) if is_there]

    @property
    def remarks(self) -> list[str]:
        """Remark on each unknown [n]: at a bound, or why a converged fit has no interval for it; "" for others."""
        parts = {name: x.names for x in self.unseen for name in x.names} if self.converged else {}
        result = []
        for name, half in zip(self.names, self.half_width, strict=True):
            remark = "at a bound" if name in self.at_bounds else ""
            if self.converged and np.isinf(half):
                unseen = "the data hardly see it" if not self._unknown_noise else "the noise is unknown"
                if name in parts:
                    unseen = "the data cannot see it" + " alone" * (len(parts[name]) > 1)
                remark = f"{unseen}, {remark}" if remark else unseen
            result.append(remark)
        return result

    @property
    def channels(self) -> list[ChannelFit]:
        """How model and data agree in every channel."""
        return channel_fits(self.problem, self.residuals)

    @property
    def validation(self) -> list[ChannelFit]:
        """How model and data agree in the validation experiments; empty without them, or if the model fails there."""
        if self.validation_problem is None or self.validation_residuals is None or not self.validation_residuals.ok:
            return []
        return channel_fits(self.validation_problem, self.validation_residuals.values)

    @property
    def notes(self) -> list[str]:
        """Remarks of the measurements on their fit, such as pairs of modes and data that the fit leaves out."""
        of_channels = [f"{row.name}: {row.block.note}" for row in self.problem.rows if row.block.note]
        return [*of_channels, *self._doubts, *self.fit.residuals.notes]

    @property
    def warnings(self) -> list[str]:
        """Warnings about a converged fit: unknown noise, or time steps whose error shifts the unknowns."""
        result = []
        if not self.converged:
            return result
        if names := [repr(row.name) for row in self._unknown_noise]:
            channels = f"channel{'s' * (len(names) > 1)} {', '.join(names)}"
            result.append(
                f"{channels}: the unknowns fit every number exactly, so nothing is known of the noise. Try: deviation="
            )
        if self.step_error is not None and (text := sentence(self.step_error, self.names, self.problem.steps)):
            result.append(text)
        return result

    @property
    def _doubts(self) -> list[str]:
        """What numbers of a fit do not say by themselves."""
        result = [*self.start_doubts, *self.warnings]
        if not self.converged:
            return result
        for name, x in zip(self.names, self.x, strict=True):
            if x < 0.0 and name.rpartition("[")[0].endswith(_SELDOM_NEGATIVE):
                result.append(f"{name} is negative: {x:.3g}")
        c = np.nan_to_num(np.triu(self.correlations, 1))
        pairs = sorted(zip(*np.nonzero(np.abs(c) > _CORRELATED), strict=True), key=lambda ij: -abs(c[ij]))
        result += [f"{self.names[i]} and {self.names[j]} have a correlation of {c[i, j]:.4g}" for i, j in pairs]
        return result

    def leave_one_out(self) -> DataFrame:
        """How far each unknown moves, in its standard deviations, if a channel, or an experiment, is left out; linearized.

        A row for each channel, then for each experiment where there are several. A large move means that this channel
        contradicts the others.
        """
        import pandas as pd

        groups = {row.name: [row.rows] for row in self.problem.rows}
        experiments = dict.fromkeys(row.experiment for row in self.problem.rows)
        if len(experiments) > 1:
            groups |= {
                f"experiment {name}": [row.rows for row in self.problem.rows if row.experiment == name]
                for name in experiments
            }
        if len(groups) == 1:
            raise InputError(
                "experiments",
                list(groups),
                "must have at least two channels, because one of them is left out",
                state="has one channel",
            )
        searched, r, result = self.searched, self.residuals, {}
        size = self.size[searched]
        J = self._jacobian[:, searched] * size
        for name, parts in groups.items():
            kept = np.ones(len(r), dtype=bool)
            for rows in parts:
                kept[rows] = False
            values, vectors = singular_values(J[kept], np.ones_like(size))
            # Directions that only the group sees keep their values.
            seen = vectors[:, : len(values) - unseen_count(values)]
            step = -seen @ np.linalg.lstsq(J[kept] @ seen, r[kept], rcond=None)[0]
            result[name] = step * size / self.deviation[searched]
        return pd.DataFrame(result, index=[self.names[k] for k in searched]).T

    def profile(self, name: str, level: float = LEVEL) -> tuple[float, float]:
        """Interval of an unknown by its profile likelihood: all others are fitted again for each of its values.

        It is not linearized: for strongly nonlinear unknowns it is not symmetric, and infinite if the data do not bound it.
        Every call simulates some tens of designs.
        """
        key = (name, level)
        require_range("level", level, 0.0, 1.0)
        if key not in self._profiles:
            index = self._index(name)
            width, evaluate = float(self.deviation[index]), self.problem.evaluate
            if self._unknown_noise and np.isinf(width):  # a sum of squares without a noise to compare it with
                return -np.inf, np.inf
            limit = quantile(np.inf, level)
            if 0.0 < width < np.inf:
                limit = float(self._half_width(level)[index]) / width
            self._profiles[key] = profile_interval(
                evaluate, self.settings, self.fit, index, limit, width, self.variance_factor
            )
        return self._profiles[key]

    def to_frame(self) -> DataFrame:
        """A row for each unknown: value, standard deviation, interval of 95 %, start, bounds, whether it is at a bound."""
        import pandas as pd

        ends = self.interval
        columns = {
            "value": self.x,
            "deviation": self.deviation,
            "low": ends[:, 0],
            "high": ends[:, 1],
            "start": self.start,
            "lower": self.settings.lower,
            "upper": self.settings.upper,
            "at_bound": [name in self.at_bounds for name in self.names],
        }
        return pd.DataFrame(columns, index=pd.Index(self.names, name="unknown"))

    def channels_frame(self) -> DataFrame:
        """A row for each channel of the fit, then of the validation: see ChannelFit."""
        import pandas as pd

        rows = [vars(x) | {"held_out": False} for x in self.channels] + [
            vars(x) | {"held_out": True} for x in self.validation
        ]
        return pd.DataFrame(rows).set_index("name")

    def plot(self) -> Figure:
        """Figure of data and model in every channel, and of the residuals below."""
        from torchmbd.extensions.identification.figure import data_and_model

        problem, values = self.problem, self.problem.predictions(self.residuals)
        return data_and_model(
            [
                (row.name, row.block.title, row.block.abscissa, row.block.x, row.block.measured, values[row.rows])
                for row in problem.rows
            ]
        )

    def _summary(self) -> list[tuple[str, Any]]:
        rows: list[tuple[str, Any]] = [
            ("status", f"{self.status}: {self.message}"),
            (
                "work",
                f"{self.evaluations} simulations with Jacobians, {self.failures} failed, {plural(len(self.starts), 'start')}",
            ),
        ]
        if self.fit.residuals.jacobian is None:
            return rows
        if not self.converged:  # deviations and what data see are those at a minimum
            return [
                *rows,
                *((name, f"{value:.6g}") for name, value in zip(self.names, self.x, strict=True)),
                *self._agreements,
            ]
        columns = zip(self.names, self.x, self.half_width, self.remarks, strict=True)
        for k, (name, value, half, remark) in enumerate(columns):
            if k not in self.searched:
                rows.append((name, f"{value:.6g}, its bounds"))
                continue
            text = f"{value:.6g} +- {half:.2g} (95 %)" if np.isfinite(half) else f"{value:.6g}"
            rows.append((name, f"{text}, {remark}" if remark else text))
        rows += [("the data see", x.words) for x in self.unseen]
        return rows + self._agreements

    @property
    def _agreements(self) -> list[tuple[str, Any]]:
        rows: list[tuple[str, Any]] = [(x.name, agreement(x)) for x in self.channels]
        rows += [(f"held out: {x.name}", agreement(x)) for x in self.validation]
        if self.validation_residuals is not None and not self.validation_residuals.ok:
            rows.append(("held out", self.validation_residuals.status))
        return rows + ([("notes", few(self.notes))] if self.notes else [])


def best_first(fits: Sequence[Fit]) -> list[Fit]:
    """Fits by their cost, those without numbers last."""
    return sorted(
        fits, key=lambda fit: (not np.isfinite(fit.cost), fit.cost if np.isfinite(fit.cost) else 0.0, fit.start)
    )
