"""What an optimizer is: a function that searches one start.

    minimize f(x)  subject to  c_i(x) <= 0,  lower <= x <= upper          (eq. 14)

A problem is any object with `names`, `start`, `lower`, `upper` [n] and `evaluate(X [lanes, n], gradients) ->
list[Evaluation]`. It may also have `equalities` (indices of the constraints that must vanish), `motion(x)`, and what
torchmbd.optimization.batch asks of one that evaluates elsewhere. Three
examples of what keeps this contract: the transient optimization of a mechanism, a Hock-Schittkowski problem of four
lines, a table of stored results.

An optimizer is a function `method(search, max_iterations, **options) -> Ending`. It sees one `Search`: scaled
variables, scaled objective, a cache, and never more than one design at a time; that many starts are simulated in one
batch is not its business. A failed evaluation is not an exception but a status: its numbers are never used.

Constraints should be of order one (a response divided by its limit, minus one): their thresholds are absolute.
Checked in tests/contracts/test_optimizers.py, over the registry.
"""

from __future__ import annotations

import inspect
import math
import numbers
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from torchmbd.errors import InputError, unknown
from torchmbd.optimization.failures import are_many, failures_text
from torchmbd.summary import Summary, few

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# How an optimization can end. Only "converged" claims an optimum.
STATUSES = {
    "converged": "the constraints and the Kuhn-Tucker conditions are satisfied, to the residual `kkt` of the method",
    "max_iterations": "stopped by the limit of iterations or of analyses",
    "max_time": "stopped by the limit of time; x is the best design seen",
    "max_boxes": "stopped by the limit of boxes of a discrete search, with boxes left that may hold a better design",
    "many_failures": "more than a tenth of the evaluations failed, so an optimum may have been missed; the message says why",
    "stalled": "no step improves the design any more, though it is not a Kuhn-Tucker point; the message says why",
    "infeasible": "the constraints could not be satisfied; x is the least infeasible design seen",
    "failed": "the start could not be evaluated, or a gradient where the values could",
    "interrupted": "stopped by the user; x is the best design seen",
}


@dataclass(frozen=True)
class Evaluation:
    """Objective and constraints of one design. A status but "ok" is the reason of a failure, the numbers nan."""

    objective: float
    constraints: np.ndarray  # [m], satisfied where <= 0
    objective_gradient: np.ndarray | None = None  # [n]
    constraint_gradients: np.ndarray | None = None  # [m, n]
    status: str = "ok"

    @property
    def ok(self) -> bool:
        return self.status == "ok"

    @property
    def differentiated(self) -> bool:
        """True if it comes with gradients."""
        return self.objective_gradient is not None

    @classmethod
    def failure(cls, reason: str, constraints: int = 0) -> Evaluation:
        """Build an evaluation that failed for `reason`."""
        return cls(float("nan"), np.full(constraints, np.nan), status=reason)


def largest_violation(constraints: np.ndarray, equality: np.ndarray | bool = False) -> float:
    """Return the largest violation of constraints [m], 0 where all are satisfied; `equality` [m]: those that must vanish."""
    violations = np.where(equality, np.abs(constraints), np.maximum(constraints, 0.0))
    return float(violations.max(initial=0.0))


def rank(objective: float, violation: float, feasibility: float) -> tuple[bool, float]:
    """Return a sort key of designs: feasible before infeasible, then by the objective, or by the violation."""
    infeasible = violation > feasibility
    return infeasible, violation if infeasible else objective


class Box(Protocol):
    """The variables of a problem and their bounds (physical units)."""

    @property
    def names(self) -> Sequence[str]:
        """One name per variable."""
        ...

    @property
    def start(self) -> np.ndarray:
        """Initial design [n]."""
        ...

    @property
    def lower(self) -> np.ndarray:
        """Lower bounds [n], may be -inf."""
        ...

    @property
    def upper(self) -> np.ndarray:
        """Upper bounds [n], may be +inf."""
        ...


class NonlinearProgram(Box, Protocol):
    """What `optimize` and `multistart` ask of a problem, such as an mbd.Problem (physical units everywhere)."""

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[Evaluation]:
        """Evaluate one design per row."""
        ...


@runtime_checkable
class Simulated(Protocol):
    """A problem that simulates a motion."""

    def motion(self, x: np.ndarray) -> Any:
        """Motion of one design [n]."""
        ...


@dataclass(frozen=True)
class Iterate:
    """One accepted design of one start, in physical units; iteration 0 is the start itself."""

    start: int
    iteration: int
    x: np.ndarray
    objective: float
    violation: float  # largest violation of a constraint, 0 where feasible
    constraints: np.ndarray
    analyses: int  # simulations of this start so far
    status: str = "ok"
    accuracy: str = ""  # by which the design was evaluated, such as "400 steps"; "": all designs by the same


@dataclass(frozen=True)
class Ending:
    """What a method says at its end: where (scaled), how (a key of STATUSES) and why (a sentence)."""

    y: np.ndarray
    status: str
    message: str


def convergence_figure(results: Sequence[OptimizationResult], best: OptimizationResult | None, title: str) -> Figure:
    """Figure of the objective and the largest violation of several starts over their iterations; the best stands out."""
    from torchmbd.viz.figures import convergence

    if not isinstance(title, str):
        raise InputError("title", title, "a str")
    names = {f"start {result.start}": result.history for result in results if result.history}
    values, violations = (
        {name: [getattr(iterate, what) for iterate in history] for name, history in names.items()}
        for what in ("objective", "violation")
    )
    return convergence(values, violations, None if best is None else f"start {best.start}", title)


def gain_text(result: OptimizationResult, first: Iterate | None) -> str:
    """Return whether a result is better than the start `first`, with the objective of the start and its violation.

    A feasible design is better than an infeasible one, whatever their objectives. Violations compare two infeasible ones.
    """
    if first is None or not math.isfinite(first.objective) or not math.isfinite(result.value):
        return "the start could not be evaluated"
    violated, start_violated = result.violation > result.feasibility, first.violation > result.feasibility
    violation = f", violation {first.violation:.3g}" if start_violated else ""
    start = f"the start (objective {result.sign * first.objective:.6g}{violation})"
    if violated != start_violated:
        return f"infeasible, unlike {start}" if violated else f"feasible, unlike {start}"
    words = ("better than", "worse than", "equal to")
    pair = (result.value, first.objective)
    if violated:
        words, pair = (
            ("less infeasible than", "more infeasible than", "as infeasible as"),
            (result.violation, first.violation),
        )
    return f"{words[0] if pair[0] < pair[1] else words[1] if pair[0] > pair[1] else words[2]} {start}"


@dataclass(frozen=True, repr=False)
class OptimizationResult(Summary):
    """The result of an optimization from one start, in physical units.

    x                     the best design that was found [n]
    value                 objective there; nan: the start could not be evaluated
    constraints           [m], satisfied where <= 0
    violation             the largest of a constraint, 0 where all are satisfied
    status, message       a key of STATUSES, and its reason; only "converged" claims an optimum
    method                its name
    iterations            accepted designs after the start
    analyses              simulations, with or without gradients
    gradient_evaluations  how many of them carried gradients
    failures              how many of them failed
    reasons               of the failures, with how often each occurred, the commonest first
    history               accepted designs, the start first. The start and the result are evaluated with the last `accuracy`;
                          every other design has the `accuracy` of its entry
    multipliers           of the constraints [m]
    bound_multipliers     [n], positive at an upper, negative at a lower bound
    kkt_residual          of the scaled problem (kkt.py), at most the method's option `kkt` where it converged; nan where no
                          gradient is known
    names                 of the design variables [n]
    start                 number of the start in a multistart
    problem               what was minimized
    feasibility           largest violation that counts as feasible

    >>> energy = mbd.Integral(mbd.StrainEnergy("arm"))
    >>> problem = mbd.Problem(mbd.examples.arm(), 0.05, energy, steps=20, bounds=mbd.deg([-90, 90]))
    >>> result = mbd.optimize(problem, max_iterations=1)
    >>> result.status, result.x.shape, len(result.history)
    ('converged', (2,), 2)
    >>> result.motion.status  # of the best design
    ['ok']
    """

    x: np.ndarray
    value: float
    constraints: np.ndarray
    violation: float
    status: str
    message: str
    method: str
    iterations: int
    analyses: int
    gradient_evaluations: int
    failures: int
    history: list[Iterate]
    multipliers: np.ndarray
    bound_multipliers: np.ndarray
    kkt_residual: float
    names: list[str] = field(default_factory=list)
    start: int = 0
    problem: Any = field(default=None, repr=False, compare=False)
    reasons: dict[str, int] = field(default_factory=dict)
    feasibility: float = 1e-6

    def _summary(self) -> list[tuple[str, Any]]:
        names = self.names or [f"x[{k}]" for k in range(len(self.x))]
        return [
            ("status", f"{self.status}: {self.message}"),
            ("value", f"{self.sign * self.value:.8g}, {self.gain_text}"),
            ("violation", f"{self.violation:.3g}"),
            ("active", few(self.active) if self.active else "no constraint and no bound"),
            ("KKT residual", f"{self.kkt_residual:.2g}"),
            ("x", few([f"{name} = {x:.6g}" for name, x in zip(names, self.x, strict=True)])),
            ("method", f"{self.method}, {self.iterations} iterations"),
            ("failures", failures_text(self.analyses, self.reasons)),
        ]

    @property
    def sign(self) -> float:
        """The factor from the value to the objective of the problem: -1 where it is maximized."""
        return float(getattr(self.problem, "sign", 1.0))

    @property
    def gain_text(self) -> str:
        """A sentence that compares the design with the start of the search."""
        return gain_text(self, self.history[0] if self.history else None)

    @property
    def active(self) -> list[str]:
        """Names of the active constraints and bounds: those with a multiplier."""
        rows = getattr(self.problem, "row_names", [])
        known = len(rows) == len(self.multipliers)
        labels = rows if known else [f"constraint {k + 1}" for k in range(len(self.multipliers))]
        names = self.names or [f"x[{k}]" for k in range(len(self.bound_multipliers))]
        active = [name for name, number in zip(labels, self.multipliers, strict=True) if abs(number) > 0.0]
        bounds = zip(names, self.bound_multipliers, strict=True)
        return active + [f"{'upper' if x > 0.0 else 'lower'} bound of {name}" for name, x in bounds if abs(x) > 0.0]

    @property
    def search_text(self) -> str:
        """How the search ended, whether its design is better than the start, and how many evaluations failed."""
        ending = "converged" if self.converged else f"not converged ({self.status}: {self.message})"
        in_message = self.status == "many_failures"
        failures = [] if in_message else [failures_text(self.analyses, self.reasons)]
        return "; ".join([ending, self.gain_text, *failures])

    @property
    def failing_text(self) -> str:
        """How many evaluations failed and why, where more than a tenth did; else ""."""
        return failures_text(self.analyses, self.reasons) if are_many(self.analyses, self.reasons) else ""

    def plot(self, title: str = "objective") -> Figure:
        """Figure of the objective and the largest violation over the iterations."""
        return convergence_figure([self], self, title)

    @property
    def converged(self) -> bool:
        """True if the design satisfies the constraints and the Kuhn-Tucker conditions."""
        return self.status == "converged"

    @cached_property
    def motion(self) -> Any:
        """Motion of the final design, simulated when first asked for (`problem.motion(x)`)."""
        if not isinstance(self.problem, Simulated):
            raise AttributeError("this problem offers no motion: its class has no method `motion(x)`")
        return self.problem.motion(self.x)


Method = Callable[..., Ending]
OPTIMIZERS: dict[str, Method] = {}
DEFAULT_METHOD = "auto"  # methods/auto.py


DENSE: set[str] = set()  # names of the methods that hold matrices of n x n numbers
MOST_DENSE = 5_000  # variables of these: each matrix has 0.2 GB, and a step factorizes some of them


def register(name: str, dense: bool = False) -> Callable[[Method], Method]:
    """Put a method into the registry under `name`; dense: it holds matrices of n x n numbers."""

    def enter(method: Method) -> Method:
        OPTIMIZERS[name] = method
        DENSE.update([name] * dense)
        return method

    return enter


def require_few(argument: str, value: Any, noun: str, size: int, remedy: str) -> None:
    """Raise InputError for an argument that needs matrices of n x n numbers of more variables than these are made for."""
    if size > MOST_DENSE:
        raise InputError(
            argument,
            value,
            f"must have at most {MOST_DENSE:,}, because it stores n x n matrices",
            hint=remedy,
            noun=noun,
            state=f"has {size:,} design variables",
        )


def require_method_of_size(method: str, size: int) -> None:
    """Raise InputError for a method whose matrices do not fit to so many variables."""
    others = " or ".join(repr(name) for name in OPTIMIZERS if name not in DENSE)
    if method in DENSE:
        require_few("method", method, f"method = {method!r}", size, f"method = {others}, or links between variables")


def find_method(name: str, options: dict[str, Any], arguments: Iterable[str] = ()) -> Method:
    """Return the method `name`; InputError for an unknown name or an option that it does not have.

    arguments  the other arguments of the function that takes the options, of which one may be meant
    """
    if not isinstance(name, str) or name not in OPTIMIZERS:
        raise unknown("method", name, OPTIMIZERS)
    method = OPTIMIZERS[name]
    allowed = [p.name for p in inspect.signature(method).parameters.values() if p.kind is p.KEYWORD_ONLY]
    for option in options:
        if option not in allowed:
            value, state = options[option], f"is not an option of method {name!r}"
            raise InputError(option, value, [*allowed, *arguments], shown=repr(value), state=state)
    return method


def require_range(name: str, value: float, low: float, high: float) -> float:
    """Return `value` if it is a number in [low, high]; InputError otherwise."""
    if isinstance(value, bool) or not isinstance(value, numbers.Real) or not low <= value <= high:
        raise InputError(name, value, f"must lie in [{low:g}, {high:g}]")
    return value


def require_count(name: str, value: int, low: int, high: int) -> int:
    """Return `value` if it is an integer in [low, high]; InputError otherwise."""
    if not isinstance(value, numbers.Integral):
        raise InputError(name, value, "an integer")
    require_range(name, value, low, high)
    return value


def require_inside(
    what: str,
    names: Sequence[str],
    lower: np.ndarray,
    x: np.ndarray,
    upper: np.ndarray,
    shown: Callable[[str, float], str] = lambda name, x: f"{x:g}",
) -> None:
    """Raise InputError unless a design [n] lies in its bounds [n].

    what   the argument that has the design
    shown  writes a value of a variable
    """
    for name, low, value, high in zip(names, lower, x, upper, strict=True):
        if not low <= value <= high:
            allowed = f"must lie between {shown(name, low)} and {shown(name, high)}"
            raise InputError((what, name), value, allowed, noun=f"{what} of {name}", shown=shown(name, value))


def require_problem(problem: Any) -> None:
    """Raise InputError unless the argument has what every problem has."""
    missing = [name for name in ("names", "start", "lower", "upper", "evaluate") if not hasattr(problem, name)]
    if missing:
        raise InputError(
            "problem",
            problem,
            "a problem, such as mbd.Problem(...)",
            shown=f"{problem!r}, without {', '.join(missing)}",
        )


def as_numbers(name: str, values: Any) -> np.ndarray:
    """Return numbers as an array of one's own; InputError if they are none."""
    try:
        numbers = np.asarray(values)
        if numbers.dtype.kind in "US":  # NumPy would read the text
            raise TypeError
        return numbers.astype(float)
    except (TypeError, ValueError, RuntimeError) as error:  # RuntimeError: a tensor that requires a gradient
        raise InputError(name, values, "numbers") from error


def checked_names(problem: Box, size: int) -> list[str]:
    """Return the problem's variable names, checked for their number."""
    names: Sequence[str] = list(problem.names)
    if len(names) != size:
        raise InputError("names", allowed=f"must have {size}, one for each variable", state=f"has {len(names)} entries")
    return list(names)
