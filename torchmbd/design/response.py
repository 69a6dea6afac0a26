"""Responses: numbers at every time of a motion (histories) or of a whole motion (measures), as torch functions of it.

    History   values(motion) [lanes, times]             strain energy, displacement, reaction, ...
              rates(motion) [lanes, times] twice        y', y'' if they are known exactly, to locate peaks between the samples
    Measure   value(motion)  [lanes] or [lanes, rows]   integral, maximum, frequency, ... ; rows: one limit holds for all

A response is called with a motion, `Integral(StrainEnergy("rod"))(motion)`, and returns a tensor that is differentiable as the
motion is: torch applies the chain rule of eq. (27) to all quantities that depend on the design: the motion, its rates, the
multipliers, the reduced stiffness, the mode shapes. A response that a user writes:

    @mbd.history
    def reach(motion):
        return motion.body("rod").at("right").position.norm(dim=-1)

    mbd.Max(reach) <= 0.5

Histories, measures and numbers are combined by `+ - * /`, `**` and `abs`.
Checked in tests/contracts/test_responses.py.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NoReturn

import torch
from torch import Tensor

from torchmbd.design.constant_arguments import ConstantArguments
from torchmbd.design.differentiate import ValueAndGradient, differentiate
from torchmbd.design.operations import formula, is_number, keeps_zero, operand, settle
from torchmbd.errors import InputError
from torchmbd.integrate import Trajectory
from torchmbd.math.checked_numbers import scalar
from torchmbd.math.forward_mode import jvp
from torchmbd.multibody.system import System


class History(ConstantArguments):
    """A number at every time of a motion; called with a motion it gives values [lanes, times], in the unit of the response.

    args, kwargs  arguments of the class, such as the body of StrainEnergy. `mbd.history` makes a history of a function

    >>> height = mbd.Position("arm", "z", node="right")
    >>> isinstance(height, mbd.History), height(mbd.simulate(mbd.examples.arm(), 0.01, steps=4)).shape
    (True, torch.Size([1, 5]))
    """

    def values(self, motion: Trajectory) -> Tensor:
        """Value [lanes, times]: a differentiable function of the motion."""
        raise NotImplementedError(type(self).__name__)

    def rates(self, motion: Trajectory) -> tuple[Tensor, Tensor] | None:
        """First and second derivative with respect to time [lanes, times] if they are known exactly; None: by differences."""
        return None

    @property
    def smooth(self) -> bool:
        """True if the history is smooth between the switches of a motion, so that it may be interpolated between samples."""
        return True

    @property
    def natural_zero(self) -> bool:
        """True if zero has a meaning: for an energy it has one, but not for a position, whose origin is a choice."""
        return True

    @property
    def since_start(self) -> bool:
        """True if the value is a change since the start of the motion: a state alone does not have it."""
        return False

    def __call__(self, motion: Trajectory) -> Tensor:
        """Value [lanes, times]; lanes that failed have nan, and no derivative."""
        _check(self, motion)
        return motion.sound(self.values(motion))

    def check(self, system: System) -> None:
        """Raise InputError if the system lacks what the history needs."""

    def series(self, motion: Trajectory) -> ValueAndGradient:
        """Value [lanes, times] and gradient [lanes, times, n_b], None for a motion without gradients."""
        _check(self, motion)
        return differentiate(self.values, motion)

    def _without_limit(self, limit: Any) -> NoReturn:
        """A history has many numbers: InputError that says of which one a limit can be."""
        raise InputError("constraint", self, "a measure of it, such as mbd.Max(history) <= limit", state="is a history")

    __le__ = __ge__ = __lt__ = __gt__ = _without_limit

    def __add__(self, other: Any) -> History:
        return Combined(torch.add, (self, other))

    __radd__ = __add__

    def __sub__(self, other: Any) -> History:
        return Combined(torch.sub, (self, other))

    def __rsub__(self, other: Any) -> History:
        return Combined(torch.add, (-self, other))

    def __mul__(self, factor: Any) -> History:
        return Combined(torch.mul, (self, factor))

    __rmul__ = __mul__

    def __truediv__(self, divisor: float) -> History:
        return Combined(torch.div, (self, divisor))

    def __neg__(self) -> History:
        return Combined(torch.mul, (self, -1.0))

    def __pow__(self, exponent: int) -> History:
        return Combined(torch.pow, (self, exponent))

    def __abs__(self) -> History:
        return Combined(torch.abs, (self,))


@dataclass(frozen=True)
class Combined(History):
    """An operation on histories and numbers."""

    operation: Callable[..., Tensor]
    parts: tuple

    def __repr__(self) -> str:
        return formula(self.operation, self.parts)

    def __post_init__(self) -> None:
        allowed = "combined with another history or a number"
        settle(self, "parts", tuple(operand(part, History, "history", allowed) for part in self.parts))

    @property
    def smooth(self) -> bool:
        return all(part.smooth for part in self.parts if isinstance(part, History))

    natural_zero = property(lambda self: keeps_zero(self.operation, self.parts))

    @property
    def since_start(self) -> bool:
        return any(part.since_start for part in self.parts if isinstance(part, History))

    def values(self, motion: Trajectory) -> Tensor:
        return self.operation(*(part.values(motion) if isinstance(part, History) else part for part in self.parts))

    def rates(self, motion: Trajectory) -> tuple[Tensor, Tensor] | None:
        rates = [part.rates(motion) if isinstance(part, History) else () for part in self.parts]
        if any(rate is None for rate in rates):
            return None
        # The operation on y + y' tau + y'' tau^2 / 2, differentiated twice by tau.
        parts = [(part.values(motion) if rate else part, rate) for part, rate in zip(self.parts, rates, strict=True)]

        def at_delay(tau: Tensor) -> Tensor:
            return self.operation(*(y + (r[0] + 0.5 * r[1] * tau) * tau if r else y for y, r in parts))

        def rate(tau: Tensor) -> Tensor:
            return jvp(at_delay, (tau,), (torch.ones_like(tau),))[1]

        zero = torch.zeros((), dtype=torch.float64)
        return jvp(rate, (zero,), (torch.ones_like(zero),))[:2]

    def check(self, system: System) -> None:
        for part in self.parts:
            if isinstance(part, History):
                part.check(system)


def _check(response: History | Measure, motion: Any) -> None:
    """Check a response by the system of a motion; what is no motion is refused where it is read."""
    if (system := getattr(motion, "system", None)) is not None:
        response.check(system)


class Measure(ConstantArguments):
    """Numbers of a motion: one, or `rows` of one kind to which one limit applies, in the unit of the response.

    Called with a motion it gives its value [lanes], or [lanes, rows].

    args, kwargs  arguments of the class, such as the history of Max. `mbd.measure` makes a measure of a function

    >>> heavier = mbd.Mass("arm") + mbd.Mass("tool")  # [kg]
    >>> isinstance(heavier, mbd.Measure), round(heavier(mbd.simulate(mbd.examples.arm(), 0.01, steps=4)).item(), 4)
    (True, 0.2793)
    """

    rows: int = 1
    error_note: ClassVar[str] = ""  # what an estimate of its error by the steps is worth
    infinite_note: ClassVar[str] = ""  # when the value is infinite, and what to ask for instead
    drawing: ClassVar[str] = (
        ""  # pictures of such measures in a report, by their name in DRAWINGS of study/report/terminal.py
    )

    def value(self, motion: Trajectory) -> Tensor:
        """Value [lanes], or [lanes, rows]: a differentiable function of the motion."""
        raise NotImplementedError(type(self).__name__)

    def __call__(self, motion: Trajectory) -> Tensor:
        """Value [lanes], or [lanes, rows]; lanes that failed have nan, and no derivative."""
        _check(self, motion)
        return motion.sound(self.value(motion))

    def check(self, system: System) -> None:
        """Raise InputError if the system lacks what the measure needs."""
        for measure in self.operands:
            measure.check(system)

    def at_start(self, motion: Trajectory) -> Measure:
        """The measure with numbers for all that refers to the initial design, from its motion."""
        return self.mapped(lambda measure: measure.at_start(motion))

    def mapped(self, change: Callable[[Measure], Measure]) -> Measure:
        """The measure with `change` applied to each operand."""
        return self

    @property
    def operands(self) -> Sequence[Measure]:
        """The measures that this measure combines."""
        return ()

    @property
    def until(self) -> float:
        """The shortest duration of a motion that the measure can be evaluated on [s]."""
        return max((measure.until for measure in self.operands), default=0.0)

    @property
    def refers_to_start(self) -> bool:
        """True if the measure needs the motion of the initial design."""
        return any(measure.refers_to_start for measure in self.operands)

    @property
    def natural_zero(self) -> bool:
        """True if zero has a meaning: for a mass it has one, but not for a position, whose origin is a choice."""
        return all(measure.natural_zero for measure in self.operands)

    def size(self, motion: Trajectory) -> Tensor:
        """The size of the value, or of its change if zero has no meaning; the origin and added constants do not matter."""
        return (self.value(motion).detach() if self.natural_zero else self.change(motion)).abs()

    def change(self, motion: Trajectory) -> Tensor:
        """The part of the value that depends on the motion, in its shape; for a measure of the design, the value."""
        return self.value(motion).detach()

    def __add__(self, other: Any) -> Measure:
        return CombinedMeasure(torch.add, (self, other)) if is_number(other) else Total([(1.0, self), (1.0, other)])

    __radd__ = __add__

    def __mul__(self, factor: Any) -> Measure:
        return CombinedMeasure(torch.mul, (self, factor)) if isinstance(factor, Measure) else Total([(factor, self)])

    __rmul__ = __mul__

    def __pow__(self, exponent: int) -> Measure:
        return CombinedMeasure(torch.pow, (self, exponent))

    def __abs__(self) -> Measure:
        return CombinedMeasure(torch.abs, (self,))

    def __truediv__(self, divisor: Any) -> Measure:
        if isinstance(divisor, Measure):
            return CombinedMeasure(torch.div, (self, divisor))
        if not is_number(divisor) or not divisor:
            raise InputError(
                "divisor",
                divisor,
                "divided by a finite number other than 0",
                state=f"is divided by {divisor!r}",
                noun="a measure",
            )
        return Total([(1.0 / divisor, self)])

    def __neg__(self) -> Measure:
        return Total([(-1.0, self)])

    def __sub__(self, other: Any) -> Measure:
        return CombinedMeasure(torch.sub, (self, other)) if is_number(other) else Total([(1.0, self), (-1.0, other)])

    def __rsub__(self, other: Any) -> Measure:
        return -self + other

    def of(self, motion: Trajectory) -> ValueAndGradient:
        """Value [lanes, ...] and gradient [lanes, ..., n_b], None for a motion without gradients."""
        _check(self, motion)
        return differentiate(self.value, motion)

    def value_and_gradient(self, motion: Trajectory) -> ValueAndGradient:
        """Value [lanes, ...] and its gradient in the design variables [lanes, ..., n_b]; both are nan in lanes that failed.

        Raises InputError for a motion without gradients.

        >>> motion = mbd.simulate(mbd.examples.arm(), 0.1, steps=40)
        >>> value, gradient = mbd.Integral(mbd.StrainEnergy("arm")).value_and_gradient(motion)
        >>> value.shape, gradient.shape  # one design, two ply angles
        (torch.Size([1]), torch.Size([1, 2]))
        """
        result = self.of(motion)
        if result.gradient is None:
            raise InputError(
                "motion",
                allowed="simulated in grad mode, with a parameter that requires a gradient",
                state="has no gradient",
            )
        return result

    def __le__(self, limit: float | str) -> Constraint:
        return Constraint(self, limit)

    def __ge__(self, limit: float | str) -> Constraint:
        return Constraint(self, limit, "at_least")

    def __lt__(self, limit: Any) -> NoReturn:
        raise InputError("constraint", self, "made with <=, >= or equals(...)", shown=f"{self} < {limit!r}")

    def __gt__(self, limit: Any) -> NoReturn:
        raise InputError("constraint", self, "made with <=, >= or equals(...)", shown=f"{self} > {limit!r}")

    def equals(self, limit: float | str, scale: float | None = None) -> Constraint:
        """Equality constraint; `scale` divides the violation, for a limit of zero."""
        return Constraint(self, limit, "equal", scale)


def check_scale(scale: object) -> None:
    """InputError unless a smooth largest number has the size of what it is of: no number suits all units."""
    allowed = "a positive number, the size of the values in their unit"
    if scale is None or scalar("scale", scale, allowed) <= 0.0:
        raise InputError("scale", scale, allowed, hint="the limit of the values")


def require_scalar_measures(parts: Iterable[Any], kind: str) -> None:
    """InputError unless every part is a measure of one number."""
    for part in parts:
        if not isinstance(part, Measure) or part.rows != 1:
            raise InputError("parts", part, "a measure of one number, such as Integral(...)", noun=f"part of {kind}")


@dataclass(frozen=True)
class Total(Measure):
    """A sum of measures, each times a number: terms are pairs (factor, measure)."""

    terms: Sequence[tuple[float, Measure]]

    def __post_init__(self) -> None:
        require_scalar_measures([measure for _, measure in self.terms], "sum")
        settle(self, "terms", [(scalar(("Measure", "factor"), factor), measure) for factor, measure in self.terms])

    def value(self, motion: Trajectory) -> Tensor:
        return torch.stack([factor * measure.value(motion) for factor, measure in self.terms]).sum(0)

    def change(self, motion: Trajectory) -> Tensor:
        return torch.stack([abs(factor) * measure.size(motion) for factor, measure in self.terms]).sum(0)

    @property
    def operands(self) -> Sequence[Measure]:
        return [measure for _, measure in self.terms]

    def mapped(self, change: Callable[[Measure], Measure]) -> Measure:
        return Total([(factor, change(measure)) for factor, measure in self.terms])


@dataclass(frozen=True)
class CombinedMeasure(Measure):
    """An operation on measures of one number and numbers."""

    operation: Callable[..., Tensor]
    parts: tuple

    def __repr__(self) -> str:
        return formula(self.operation, self.parts)

    def __post_init__(self) -> None:
        allowed = "combined with measures of one number, or finite numbers"
        settle(self, "parts", tuple(operand(part, Measure, "measure", allowed) for part in self.parts))
        for part in self.parts:
            if isinstance(part, Measure) and part.rows != 1:
                raise InputError("parts", part, allowed, state=f"is combined with {part!r}", noun="a measure")

    def value(self, motion: Trajectory) -> Tensor:
        return self.operation(*(part.value(motion) if isinstance(part, Measure) else part for part in self.parts))

    natural_zero = property(lambda self: keeps_zero(self.operation, self.parts))

    def change(self, motion: Trajectory) -> Tensor:
        """The sum of the changes that each operand makes by its size."""
        values = [x.value(motion).detach() if isinstance(x, Measure) else x for x in self.parts]
        sizes = [x.size(motion) if isinstance(x, Measure) else 0.0 for x in self.parts]
        moved = [self.operation(*values[:k], values[k] + size, *values[k + 1 :]) for k, size in enumerate(sizes)]
        return torch.stack([(x - self.operation(*values)).abs() for x in moved]).sum(0)

    @property
    def operands(self) -> Sequence[Measure]:
        return [part for part in self.parts if isinstance(part, Measure)]

    def mapped(self, change: Callable[[Measure], Measure]) -> Measure:
        return CombinedMeasure(self.operation, tuple(change(x) if isinstance(x, Measure) else x for x in self.parts))


KINDS = ("at_most", "at_least", "equal")


@dataclass(frozen=True)
class Constraint(ConstantArguments):
    """A limit on a measure, eq. (37); written Max(...) <= 0.5, Min(...) >= "initial" or Final(...).equals(0.0).

    measure  g, one number or several rows
    limit    c, in the unit of the measure; "initial": the value at the initial design. If the measure has several rows, this
             is their largest value for <=, their least value for >=, and the value of each row for an equality
    kind     "at_most", "at_least" or "equal"
    scale    divisor of the violation, in the unit of the measure; None: |c|, or 1 for c = 0

    Optimizers see (g - c) / scale; a design is feasible where it is not positive.

    >>> limit = mbd.Max(mbd.StrainEnergy("arm")) <= "initial"
    >>> limit.kind, limit.limit
    ('at_most', 'initial')
    >>> (mbd.Frequency("arm") >= 50.0).kind
    'at_least'
    """

    measure: Measure
    limit: float | str
    kind: str = "at_most"
    scale: float | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.measure, Measure):
            raise InputError(
                "measure", self.measure, "a measure, such as Max(StrainEnergy('rod'))", noun="measure of a constraint"
            )
        if not isinstance(self.limit, str) or self.limit != "initial":
            settle(self, "limit", scalar("limit", self.limit, "a finite number or 'initial'"))
        if self.kind not in KINDS:
            raise InputError("kind", self.kind, KINDS, noun="kind of a constraint")
        if self.scale is not None and not (is_number(self.scale) and float(self.scale) > 0.0):
            raise InputError("scale", self.scale, "a positive number", noun="scale of a constraint")

    def __bool__(self) -> bool:
        raise InputError(
            "constraint",
            self,
            "written with one <= or >=",
            noun="a constraint",
            state="is used as True or False, as Python does in a chain 1 <= Max(...) <= 2",
            hint="two constraints: Max(...) >= 1, Max(...) <= 2",
        )
