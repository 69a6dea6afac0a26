"""Time-dependent criteria as rows: one limit for the values at many times; eqs. (20), (22), (23).

    AtTimes    y(t_k) at fixed times                         all points of eq. (23)
    AtPeaks    the highest local maxima of y: critical points, located in the motion of each design

    AtPeaks(StrainEnergy("rod"), count=8) <= 0.5            a constraint at critical points
    Problem(minimize=AtPeaks(StrainEnergy("rod")), ...)     min-max by an extra variable (problem.py)

Max is not smooth where another peak becomes the largest. The rows of AtPeaks keep the gradients of all peaks there.
Lower limits: AtPeaks(-y) <= -c.
Checked in tests/contracts/test_responses.py, tests/design/test_formulations.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from torchmbd.design.measures import OfHistory
from torchmbd.design.response import Constraint
from torchmbd.design.spline import Spline
from torchmbd.errors import InputError


@dataclass(frozen=True)
class AtTimes(OfHistory):
    """Values of a history at many times [lanes, rows], in its unit, with one limit; eq. (23).

    count  number of equally spaced times of the window, ends included
    times  [s], instead of count and window

    >>> motion = mbd.simulate(mbd.examples.pendulum(), 0.5, steps=50)
    >>> rows = mbd.AtTimes(mbd.Position("bob", "y"), count=6)
    >>> rows(motion).shape
    torch.Size([1, 6])
    >>> rows <= -0.9  # six constraints
    Constraint(measure=AtTimes(history=Position(body='bob', axis='y'...), limit=-0.9, kind='at_most', scale=None)
    """

    count: int = 101
    times: Sequence[float] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_count(self.count, 2)
        if self.times is None:
            return
        if self.window is not None:
            raise InputError(
                "times", self.times, "must not be given together", state="are both given", noun="times and window"
            )
        if not len(self.times) or not all(0.0 <= float(t) < float("inf") for t in self.times):
            raise InputError("times", self.times, "at least one time, zero or positive [s]")

    @property
    def rows(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.count if self.times is None else len(self.times)

    @property
    def until(self) -> float:
        return super().until if self.times is None else max(float(t) for t in self.times)

    def reduce(self, curve: Spline) -> Tensor:
        if self.times is not None:
            return curve.sampled(curve.t.new_tensor([float(t) for t in self.times]))
        return curve.spaced(self.count)


@dataclass(frozen=True)
class AtPeaks(OfHistory):
    """The highest local maxima of a history [lanes, count], in its unit, the highest first; eqs. (20), (22).

    count  number of peaks; missing peaks are filled with values that lie below all others

    >>> motion = mbd.simulate(mbd.examples.pendulum(), 3.0, steps=150)
    >>> peaks = mbd.AtPeaks(mbd.Position("bob", "y"), count=2)(motion)
    >>> peaks.shape
    torch.Size([1, 2])
    """

    count: int = 8
    error_note: ClassVar[str] = "the error of each peak assumes that finer steps keep the order and number of peaks"

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_count(self.count, 1)

    @property
    def rows(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.count

    def reduce(self, curve: Spline) -> Tensor:
        intervals = curve.t.shape[-1] - 1
        if intervals < self.count:
            raise InputError(
                "count", self.count, f"at most {intervals}, the intervals of the motion", shown=f"{self.count}"
            )
        return curve.peaks(self.count)

    def __ge__(self, limit: float | str) -> Constraint:
        raise InputError(
            "constraint",
            self,
            "a constraint with <=",
            shown=f"{self} >= {limit!r}",
            hint="AtPeaks(-history) <= -limit, for minima",
        )


def _check_count(count: object, least: int) -> None:
    if isinstance(count, bool) or not isinstance(count, int) or count < least:
        raise InputError("count", count, f"an integer, at least {least}")
