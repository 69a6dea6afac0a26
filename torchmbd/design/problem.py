"""An optimization problem: which measure of a motion to minimize over which design variables, subject to what.

    minimize f(b)   subject to   g_i(b) <= c_i,  g_j(b) = c_j,   lower <= b <= upper          eq. (14)

Constraints are passed on as (g - c)/scale, feasible where not positive. An objective of several rows y_k (AtPeaks, AtTimes)
is the min-max problem (18), solved by an extra variable, the last of the design vector:

    minimize beta y_0   subject to   y_k(b)/y_0 - beta <= 0,   beta <= 1                    eqs. (19), (20)

with y_0 the largest row of the initial design; of any sign in extra_variable.py. Max(...) as objective is the same directly.

Designs and evaluations are NumPy arrays, as torchmbd/optimization/optimizer.py requires of a problem: optimizers know no
mechanics. A batch of designs is one simulation. A design that cannot be simulated is a failed evaluation with its reason; the
other designs of its batch are evaluated. Limits and scales "initial" come from one simulation of the initial design.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchmbd.design import problem_steps
from torchmbd.design.differentiate import ROWS, differentiate
from torchmbd.design.gradient_mode import cheaper_mode
from torchmbd.design.problem_errors import problem_errors
from torchmbd.design.problem_parts import (
    Reference,
    constraints_of,
    evaluation_of,
    limits_of,
    reference_of,
    require_duration,
    stated_objective,
)
from torchmbd.design.response import Constraint, Measure
from torchmbd.design.space import DesignSpace
from torchmbd.design.words import names_of_rows
from torchmbd.errors import InputError, SimulationFailure, argument_names, keyword_hints
from torchmbd.fem.reduction import CutCluster
from torchmbd.fixed_arguments import FixedArguments
from torchmbd.integrate import Phase, Trajectory
from torchmbd.integrate.arguments import check_gradients
from torchmbd.integrate.backend import likely_backend
from torchmbd.integrate.memory import lanes_at_once, require_memory
from torchmbd.integrate.registry import DEFAULT
from torchmbd.integrate.step_count import FEWEST
from torchmbd.math.checked_numbers import is_real
from torchmbd.multibody.system import System
from torchmbd.optimization import Evaluation
from torchmbd.optimization.extra_variable import ExtraVariable
from torchmbd.optimization.optimizer import as_numbers
from torchmbd.simulation import Simulation
from torchmbd.summary import Summary, few

BOUND = "bound"  # name of the extra variable beta
Rows = tuple[np.ndarray, np.ndarray | None]  # values [lanes, rows]; slopes [lanes, rows, n] if asked for


@keyword_hints
class Problem(FixedArguments, Summary):
    """A transient optimization problem.

    system      the model; its parameters are the candidates for design variables
    duration    simulated time [s]
    minimize    a measure, such as Integral(StrainEnergy("rod")); if it has several rows, the largest row is minimized
    maximize    a measure of one number, instead of `minimize`. Evaluations and results of optimizers have its negative, which
                is minimized; tables, records and pictures of a study have its value
    subject_to  a constraint, such as Max(StrainEnergy("rod")) <= "initial", or a list of them
    bounds      (lower, upper) of the design variables: numbers for all, one for each, or a mapping from parameter
                names to such pairs [rad for angles]
    variables   names of parameters; default: every parameter that requires a gradient
    start       initial design [n], or parameter name -> values of its entries; default: the values of the system. A string
                such as "equilibrium" is `motion_start`
    motion_start   where every motion starts: `start` of `simulate`, such as "equilibrium"
    links       entries that depend on others, {"rod.laminate.angles[1]": {"rod.laminate.angles[0]": -1.0}} (space.py)
    bound       (start, upper) of the extra variable, where `minimize` has several rows; 1 at the initial design
    gradients   "reverse" or "forward", as in `simulate`; "auto": the cheaper one by an estimate (gradient_mode.py), forward
                where the method has no adjoint. `problem.gradients` is the choice
    steps       equal steps of all motions; None: as many as the start needs (problem_steps.py)
    tolerance   largest error due to time steps that each response may have if `steps` is None, as a share of its size or of
                its distance from the limit; None: the errors are not limited
    method, phases, backend, options   as in `simulate`

    >>> problem = mbd.Problem(
    ...     mbd.examples.arm(),
    ...     duration=0.1,
    ...     steps=40,
    ...     minimize=mbd.Integral(mbd.StrainEnergy("arm")),
    ...     subject_to=[mbd.Max(mbd.Displacement("arm", "z", node="right")) <= "initial"],
    ...     bounds=mbd.deg([-90, 90]),
    ... )
    >>> problem.names
    ['arm.laminate.angles[0]', 'arm.laminate.angles[1]']
    >>> [evaluation] = problem.evaluate(problem.start[None], True)  # of one design, with gradients
    >>> evaluation.status, evaluation.objective_gradient.shape, evaluation.constraint_gradients.shape
    ('ok', (2,), (1, 2))
    """

    def __init__(
        self,
        system: System,
        duration: float,
        minimize: Measure | None = None,
        subject_to: Constraint | Sequence[Constraint] = (),
        bounds: Any = (-np.inf, np.inf),
        variables: Sequence[str] | None = None,
        start: Any = None,
        method: str = DEFAULT,
        steps: int | None = None,
        links: Any = None,
        bound: tuple[float, float] = (1.0, 1.0),
        phases: Sequence[Phase] | None = None,
        gradients: str = "auto",
        backend: str = "auto",
        motion_start: Any = "assembled",
        maximize: Measure | None = None,
        tolerance: float | None = problem_steps.TOLERANCE,
        **options: Any,
    ):
        subject_to = constraints_of(subject_to)
        if isinstance(start, str):
            start, motion_start = None, start
        self.simulation = Simulation.of_caller(
            argument_names(Problem),
            system,
            duration.detach() if isinstance(duration, Tensor) else duration,
            method=method,
            steps=steps,
            phases=phases,
            backend=backend,
            start=motion_start,
            **options,
        )
        integrator = self.simulation.integrator
        self.stated_objective, self.sign = stated_objective(minimize, maximize)
        minimize = self.stated_objective if self.sign > 0.0 else -self.stated_objective
        for measure in (minimize, *(constraint.measure for constraint in subject_to)):
            measure.check(system)
            require_duration(measure, duration)
        is_pair = isinstance(bound, (tuple, list)) and len(bound) == 2 and all(map(is_real, bound))
        if not is_pair or not 0.0 < bound[0] <= bound[1]:
            raise InputError("bound", bound, "(start, upper) with 0 < start <= upper")
        self.system, self.duration, self.objective = system, float(duration), minimize
        self.constraints = subject_to
        self.tolerance, self.chooses_steps = problem_steps.checked_tolerance(tolerance), steps is None
        self.space = DesignSpace(system, variables, bounds, start, links)
        # Rows of a min-max objective, 0 for an objective of one number; they come first among the constraints.
        self.peaks = minimize.rows if minimize.rows > 1 else 0
        self._bound = bound
        check_gradients(gradients, integrator)
        self._tangents = len(self.space.entries)
        counts = self._tangents, self._count
        cheaper = cheaper_mode(*counts, likely_backend(backend)) if integrator.adjoint else "forward"
        self.gradients = cheaper if gradients in ("auto", "none") else gradients
        require_memory(
            system,
            1,
            integrator.stored_intervals(steps) if steps else FEWEST,
            self._tangents,
            self.gradients == "reverse",
        )

    def settings(self) -> list[Any]:
        """All settings that determine the evaluations, except the values of the design variables.

        They contain the bounds if the unit of the extra variable of a min-max problem depends on the bounds.
        """
        space, responses = self.space, [self.objective, *self.constraints]
        motion = [
            self.system,
            self.simulation.settings,
            self.duration,
            self.gradients,
            self.chooses_steps and self.tolerance,
        ]
        unit_of_rows = [space.lower, space.upper, tuple(map(float, self._bound))] if self.peaks else []
        return [*motion, responses, space.links, space.offset, space.variables, space.start, *unit_of_rows]

    @property
    def rows(self) -> int:
        """Number of rows of the constraints, with those of a min-max objective."""
        return self._count - (0 if self.peaks else 1)

    def _summary(self) -> list[tuple[str, Any]]:
        start = [f"{name} = {x:.6g}" for name, x in zip(self.names, self.start, strict=True)]
        return [
            ("minimize" if self.sign > 0.0 else "maximize", self.stated_objective),
            ("subject to", few(self.constraints)),
            ("variables", few(start)),
            (
                "motion",
                f"{self.duration:g} s, {self.simulation.method}, steps {self.simulation.steps or 'by default'}",
            ),
            ("gradients", self.gradients),
        ]

    @property
    def _count(self) -> int:
        """How many numbers of a motion have gradients: rows of the objective and of the constraints."""
        return (self.peaks or 1) + sum(c.measure.rows for c in self.constraints)

    @property
    def names(self) -> list[str]:
        """One label for each design variable."""
        return self.space.names + [BOUND] * bool(self.peaks)

    @property
    def start(self) -> np.ndarray:
        """Initial design [n]."""
        return self._with_bound(self.space.start, self._bound[0])

    @property
    def lower(self) -> np.ndarray:
        """Lower bounds [n], -inf where there are none."""
        return self._with_bound(self.space.lower, -np.inf)

    @property
    def upper(self) -> np.ndarray:
        """Upper bounds [n], inf where there are none."""
        return self._with_bound(self.space.upper, self._bound[1])

    @property
    def period(self) -> np.ndarray:
        """Period of each variable [n]: pi for ply angles, a multiple for linked angles, 0 for variables without period."""
        return self._with_bound(self.space.period, 0.0)

    @property
    def has_extra_variable(self) -> bool:
        """True if the last variable is that of a min-max problem."""
        return bool(self.peaks)

    def _with_bound(self, x: np.ndarray, bound: float) -> np.ndarray:
        return np.append(x, bound) if self.peaks else x

    @property
    def equalities(self) -> np.ndarray:
        """Indices of the constraint rows that are equalities."""
        pairs = zip(self.constraints, self.constraint_rows, strict=True)
        kinds = ["at_most"] * self.peaks + [c.kind for c, rows in pairs for _ in range(rows.start, rows.stop)]
        return np.array([i for i, kind in enumerate(kinds) if kind == "equal"], dtype=int)

    @property
    def constraint_rows(self) -> list[slice]:
        """Rows of every constraint, counted after those of a min-max objective."""
        ends = np.cumsum([0, *(c.measure.rows * self._repeats for c in self.constraints)]).tolist()
        return [slice(first, last) for first, last in itertools.pairwise(ends)]

    @property
    def _repeats(self) -> int:
        """How many rows of a constraint each row of its measure makes."""
        return 1

    simulations = 1  # motions of one design

    def checked_designs(self, X: Any, *sizes: int) -> np.ndarray:
        """Return designs [lanes, n] as numbers; InputError unless n is one of the sizes."""
        X = as_numbers("designs", X)
        if X.ndim != 2 or X.shape[1] not in sizes:
            raise InputError(
                "designs",
                X,
                f"must have shape [lanes, {sizes[-1]}], of {', '.join(self.names)}",
                state=f"have shape {X.shape}",
            )
        return X

    def simulate(self, X: np.ndarray, gradients: bool = False) -> Trajectory:
        """Motions of designs [lanes, n], differentiable with respect to all design variables if `gradients`."""
        return self._motions(self.checked_designs(X, len(self.space.names), len(self.names)), gradients)[0]

    def _motion(
        self, simulation: Simulation, designs: dict[str, Tensor], gradients: bool, diagnose: bool = True
    ) -> Trajectory:
        mode = self.gradients if gradients else "none"
        return simulation.with_steps(self.steps)(designs, mode, self.space.variables, diagnose=diagnose)

    def cases(self, X: np.ndarray) -> list[tuple[Simulation, dict[str, Tensor]]]:
        """The simulations of designs [lanes, n], one for each system, with the parameters [lanes, ...] of their batches."""
        return [(self.simulation, self.space.designs(X[:, : len(self.space.names)]))]

    def motion(self, x: np.ndarray) -> Trajectory:
        """Motion of one design [n]."""
        return self.simulate(np.asarray(x)[None])

    @cached_property
    def reference(self) -> Reference:
        """Measures, limits and scales; the initial design is simulated if one of them refers to it.

        Raises SimulationFailure if the initial design is needed and cannot be simulated.
        """
        measures = [self.objective, *(c.measure for c in self.constraints)]
        initial = [np.zeros(c.measure.rows) for c in self.constraints]
        if self._refers_to_start:
            motion = self.motion(self.start).require_ok()
            measures = [measure.at_start(motion) for measure in measures]
            initial = [measure.value(motion)[0].reshape(-1).numpy() for measure in measures[1:]]
        limits = [limits_of(c, values) for c, values in zip(self.constraints, initial, strict=True)]
        return reference_of(self.constraints, measures, self._extra_variable(measures), limits)

    def _extra_variable(self, measures: Sequence[Measure]) -> ExtraVariable:
        """The extra variable of a min-max objective, by its rows at the initial design."""
        if not self.peaks:
            return ExtraVariable(0)

        def rows(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            motions = [motion.require_ok() for motion in self._motions(x[None], True)]
            values, slopes = self._unscaled(motions, measures)
            assert slopes is not None
            return values[0, : self.peaks], slopes[0, : self.peaks]

        return ExtraVariable.at(rows, self.space.start, self.space.lower, self.space.upper, float(self._bound[1]))

    @property
    def _refers_to_start(self) -> bool:
        """True if the problem has numbers of the initial design: limits, scales of a weighted sum."""
        measures = [self.objective, *(c.measure for c in self.constraints)]
        return any(c.limit == "initial" for c in self.constraints) or any(m.refers_to_start for m in measures)

    errors = problem_errors
    coarse = cached_property(problem_steps.coarse_problem)
    refined = problem_steps.refined_problem
    at_steps = problem_steps.with_steps
    accuracy = property(problem_steps.accuracy)
    row_names = property(names_of_rows)

    @property
    def limits(self) -> np.ndarray:
        """Limit of every row of the constraints [m]."""
        return self.reference.limits

    def _lanes_at_once(self, gradients: bool) -> int:
        return lanes_at_once(
            self.system, self.steps or FEWEST, self._tangents if gradients else 0, self.gradients == "reverse"
        )

    steps = cached_property(problem_steps.problem_steps)

    @cached_property
    def _evaluated(self) -> set[str]:
        """Holds "gradients" once they were evaluated. A cached property, because keys do not depend on what was done before."""
        return set()

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[Evaluation]:
        """Evaluate designs [lanes, n]; return an Evaluation for each, with a status that says whether the design failed.

        They are one simulation, or several batches if their motions would fill a large part of the memory. Warnings of what the
        model leaves out, such as stiffening by loads, come with values, and with the first gradients of a problem: those that
        follow are mostly steps of a search, whose best design is verified.
        """
        X = self.checked_designs(X, len(self.names))
        batch = max(1, self._lanes_at_once(gradients) // self.simulations) if len(X) > 1 else 1
        if len(X) > batch:
            return [e for k in range(0, len(X), batch) for e in self.evaluate(X[k : k + batch], gradients)]
        try:
            motions = self._motions(X, gradients, diagnose=not (gradients and self._evaluated))
        except CutCluster as error:  # names its lanes, so that the other designs remain one batch
            if len(X) == 1:
                return [Evaluation.failure(f"failed: {error}", self.rows)]
            failed = {lane: self.evaluate(X[lane : lane + 1], gradients)[0] for lane in error.lanes}
            rest = [lane for lane in range(len(X)) if lane not in failed]
            evaluations = dict(zip(rest, self.evaluate(X[rest], gradients), strict=True)) if rest else {}
            return [failed[lane] if lane in failed else evaluations[lane] for lane in range(len(X))]
        except (InputError, SimulationFailure) as error:
            return self._refused(X, gradients, self._refusal(X, gradients, error) if len(X) == 1 else "")
        self._evaluated.update({"gradients"} if gradients else ())
        reference = self.reference  # outside of `try`: a start that fails is no failure of these designs
        try:
            values, slopes = self._rows(reference, motions, X)
        except SimulationFailure as error:
            return self._refused(X, gradients, f"failed: {error}")
        each = slopes if slopes is not None else [None] * len(X)
        statuses = self._statuses(motions, len(X))
        measures = self._measures_of_rows
        return [evaluation_of(status, v, s, measures) for status, v, s in zip(statuses, values, each, strict=True)]

    @property
    def _measures_of_rows(self) -> list[Measure]:
        """The measures of the objective and of each row of the constraints, as optimizers see them."""
        parts = zip(self.constraints, self.constraint_rows, strict=True)
        rows = [c.measure for c, part in parts for _ in range(part.stop - part.start)]
        return [self.stated_objective] * (1 + self.rows - len(rows)) + rows

    def _motions(self, X: np.ndarray, gradients: bool, diagnose: bool = True) -> list[Trajectory]:
        """Motions of designs [lanes, n], one for each system."""
        return [self._motion(simulation, designs, gradients, diagnose) for simulation, designs in self.cases(X)]

    def _refused(self, X: np.ndarray, gradients: bool, status: str) -> list[Evaluation]:
        """Evaluations where the structure stage or a measure refuses some design: each design alone shows which."""
        if len(X) == 1:
            return [Evaluation.failure(status, self.rows)]
        return [evaluation for x in X for evaluation in self.evaluate(x[None], gradients)]

    def _refusal(self, X: np.ndarray, gradients: bool, error: Exception) -> str:
        """The status of a design [1, n] that the structure stage refuses with `error`."""
        return f"failed: {error}"

    def _statuses(self, motions: Sequence[Trajectory], count: int) -> Sequence[str]:
        """The status of each of `count` designs."""
        return motions[0].status

    def _measured(self, measures: Sequence[Measure], motion: Trajectory) -> list[Tensor]:
        """Rows [lanes, rows] of measures, in order.

        A measure with many rows is a tensor of its own, and others that follow each other are one: `differentiate` pulls back
        each tensor by itself.
        """
        groups: list[list[Tensor]] = [[]]
        for measure in measures:
            many = measure.rows > ROWS
            groups += [[]] if many else []
            groups[-1].append(measure.value(motion).reshape(motion.lanes, -1))
            groups += [[]] if many else []
        return [torch.cat(group, 1) for group in groups if group]

    def _rows(self, reference: Reference, motions: Sequence[Trajectory], X: np.ndarray) -> Rows:
        """Objective and normalized constraints [lanes, 1 + m] with gradients [lanes, 1 + m, n]."""
        first = self.peaks or 1
        values, slopes = self._unscaled(motions, reference.measures)
        values[:, first:] = (values[:, first:] - reference.limits) / reference.scale
        if slopes is not None:
            slopes[:, first:] /= reference.scale[:, None]
        return reference.extra.stated(values, slopes, X[:, -1]) if self.peaks else (values, slopes)

    def _unscaled(self, motions: Sequence[Trajectory], measures: Sequence[Measure]) -> Rows:
        """Rows of measures [lanes, rows], in their units, with gradients [lanes, rows, n] of motions that have them."""
        measured = differentiate(partial(self._measured, measures), motions[0])
        slopes = None if measured.gradient is None else self.space.slopes(measured.gradient.numpy())
        return measured.value.numpy(), slopes

    def with_least_bound(self, x: np.ndarray, evaluation: Evaluation) -> tuple[np.ndarray, Evaluation]:
        """The design [n] and its evaluation with the smallest extra variable that satisfies the rows: the largest row."""
        return self.reference.extra.tightened(x, evaluation) if self.peaks else (x, evaluation)
