"""One design in several scenarios: payloads, speeds, load cases. All scenarios of all designs are one batch.

    minimize f(b) over the scenarios s   subject to   g_i(b, s) <= c_i

    payloads = {"light": {"tool.mass": 0.1}, "heavy": {"tool.mass": 0.4}}
    problem = mbd.Scenarios(system, 0.1, mbd.Max(deflection), mbd.Max(failure) <= 1.0, scenarios=payloads)

A scenario sets parameters of the system that are no design variables: lane l S + s of the batch is design l in scenario s,
so that the topology is the same and each further scenario costs a lane. It may have a system of its own, with another
topology: scenarios of one system are one batch, and the batches are simulated one after another.

    {"alone": {}, "in pairs": {"system": build(arms=2), "tool.mass": 0.1}}

Over 300 lines: a batch of several systems answers all that a Problem answers.
Checked in tests/design/test_scenarios.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchmbd.design.differentiate import differentiate
from torchmbd.design.problem import Problem
from torchmbd.design.question import Reference, scale_of
from torchmbd.design.response import Constraint, Measure
from torchmbd.design.scenario_settings import by_name, value_of, weights_of
from torchmbd.errors import InputError, SimulationFailure, nearest, unknown
from torchmbd.fem.reduction import CutCluster
from torchmbd.integrate import Trajectory, simulate
from torchmbd.integrate.arguments import start_of
from torchmbd.multibody.system import System
from torchmbd.optimization import Evaluation
from torchmbd.results.motion_data import OK

SYSTEM = "system"  # key of a scenario
OBJECTIVES, CONSTRAINTS = ("worst", "mean"), ("each", "worst", "mean")


class Group(NamedTuple):
    """Scenarios of one system, which are simulated together.

    places    of the scenarios among all
    settings  name of a scenario -> parameter -> value; all of the same parameters
    """

    system: System
    places: list[int]
    settings: dict[str, dict[str, Tensor]]


class Scenarios(Problem):
    """A transient optimization problem of one design in several scenarios.

    system, duration, minimize, subject_to   as in Problem
    scenarios    name -> {parameter: value}, or a list of such settings; parameters that are no design variables [SI]. The key
                 "system" gives a scenario a system of its own, which has all design variables in the same shapes
    objective    "worst": the largest over the scenarios (a min-max problem, with an extra variable); "mean"
    constraints  "each": hold in every scenario; "worst": one row, of the scenario that is nearest to its limit; "mean"
    weights      of the scenarios in means; None: equal. They are divided by their sum
    options      maximize, bounds, variables, start, links, method, steps, phases and options of the method, as in Problem

    A limit "initial" is the value of the initial design in the same scenario. A WeightedSum is normalized by its
    value in the first scenario. A design that fails in one scenario is a failed evaluation that names the scenario.

    >>> problem = mbd.Scenarios(
    ...     mbd.examples.arm(),
    ...     0.05,
    ...     mbd.Integral(mbd.StrainEnergy("arm")),
    ...     scenarios={"light": {"arm.laminate.thickness": [1e-3, 1e-3]}, "heavy": {"arm.laminate.thickness": [2e-3, 2e-3]}},
    ...     objective="mean",
    ...     variables=["arm.laminate.angles"],
    ...     steps=20,
    ... )
    >>> [found] = problem.evaluate(problem.start[None], True)
    >>> found.status, found.objective_gradient.shape
    ('ok', (2,))
    >>> problem.motions(problem.start).lanes  # one for each scenario
    2
    """

    def __init__(
        self,
        system: System,
        duration: float,
        minimize: Measure | None = None,
        subject_to: Constraint | Sequence[Constraint] = (),
        *,
        scenarios: Mapping[str, Mapping[str, Any]] | Sequence[Mapping[str, Any]],
        objective: str = "worst",
        constraints: str = "each",
        weights: Sequence[float] | None = None,
        **options: Any,
    ):
        super().__init__(system, duration, minimize, subject_to, **options)
        for what, given, allowed in (("objective", objective, OBJECTIVES), ("constraints", constraints, CONSTRAINTS)):
            if given not in allowed:
                raise InputError(f"{what} is {given!r}; allowed: {', '.join(allowed)}")
        if constraints != "each" and any(c.kind == "equal" for c in self.constraints):
            raise InputError(f"constraints is {constraints!r}, and one is an equality; allowed: 'each'")
        if self.peaks and objective == "mean":
            raise InputError(
                f"minimize has {self.peaks} rows, and objective is 'mean'; allowed: a measure of one number"
            )
        if objective == "worst" and self.sign < 0.0:
            raise InputError(
                "maximize is given with objective 'worst'; allowed: objective='mean', or minimize a positive measure"
            )
        self.groups = self._grouped(scenarios)
        self.scenarios = {name: settings for group in self.groups for name, settings in group.settings.items()}
        self.scenarios = {str(name): self.scenarios[str(name)] for name in by_name(scenarios)}
        self._of_objective, self._of_constraints = objective, constraints
        self.weights = weights_of(weights, len(self.scenarios))
        if objective == "worst":
            self.peaks = self.objective.rows * len(self.scenarios)

    def _grouped(self, given: Any) -> list[Group]:
        """The scenarios by their systems."""
        given = by_name(given)
        if not isinstance(given, Mapping) or not given or not all(isinstance(x, Mapping) for x in given.values()):
            raise InputError(f"scenarios is {given!r}; allowed: name -> {{parameter: value}}, one at least")
        if not any(given.values()):
            raise InputError(f"scenarios is {given!r}, and sets nothing; allowed: a parameter, or a system, at least")
        systems: list[System] = []
        for key, settings in given.items():
            system = settings.get(SYSTEM, self.system)
            if not any(system is known for known in systems):
                self._require_like(key, system)
                systems.append(system)
        return [self._group(system, given) for system in systems]

    def _require_like(self, scenario: str, system: Any) -> None:
        """A system of a scenario has the design variables, and what the responses need."""
        if not isinstance(system, System):
            raise InputError(f"system of scenario {scenario!r} is {system!r}; allowed: a System")
        own = {name: x.shape for name, x in system.named_parameters()}
        for name, shape in self.space.shapes.items():
            if own.get(name) != shape:
                has = "no such parameter" if name not in own else f"one of shape {list(own[name])}"
                raise InputError(
                    f"system of scenario {scenario!r} has {has}: {name!r}; allowed: all design variables, {name!r} of "
                    f"shape {list(shape)}"
                )
        start_of(system, self.simulation.get("start", "assembled"))
        for measure in (self.objective, *(constraint.measure for constraint in self.constraints)):
            measure.check(system)

    def _group(self, system: System, given: Mapping[str, Mapping[str, Any]]) -> Group:
        """The scenarios of one system, all with values of the same parameters."""
        mine = {key: x for key, x in given.items() if x.get(SYSTEM, self.system) is system}
        own = dict(system.named_parameters())
        names = list(dict.fromkeys(name for settings in mine.values() for name in settings if name != SYSTEM))
        for name in names:
            if name not in own:
                hint = "a plain number of a constructor becomes a parameter by mbd.variable(...)"
                raise InputError(f"parameter of a scenario {name!r} does not exist{nearest(name, own)}; {hint}")
            if name in self.space.variables:
                raise InputError(f"scenarios set {name!r}, a design variable; allowed: parameters that are none")
        settings = {
            str(key): {name: value_of(key, name, settings.get(name), own[name].detach()) for name in names}
            for key, settings in mine.items()
        }
        return Group(system, [k for k, key in enumerate(given) if key in mine], settings)

    def settings(self) -> list[Any]:
        asked = [self._of_objective, self._of_constraints, self.weights]
        return [*super().settings(), *[list(group) for group in self.groups], *asked]

    @property
    def simulations(self) -> int:
        """Motions of one design."""
        return len(self.scenarios)

    @property
    def rows(self) -> int:
        return self.peaks + sum(c.measure.rows for c in self.constraints) * self._repeats

    @property
    def _repeats(self) -> int:
        return len(self.scenarios) if self._of_constraints == "each" else 1

    def largest(self, x: np.ndarray) -> str:
        """Name of the scenario in which the objective of a design [n] is largest; a motion that fails counts least."""
        found: dict[str, float] = {}
        for group, motion in zip(self.groups, self.motions_by_system(x), strict=True):
            values = self.reference.measures[0].value(motion).detach().reshape(motion.lanes, -1).amax(1).tolist()
            for name, value, status in zip(group.settings, values, motion.status, strict=True):
                found[name] = value if status == OK else -np.inf
        return max(found, key=lambda name: found[name])

    def simulate(self, X: np.ndarray, gradients: bool = False, scenario: str | None = None) -> Trajectory:
        """Motions of designs [lanes, n] in one scenario; None: in the one where the objective of the last is largest."""
        X = self._checked(X, len(self.space.names), len(self.names))
        name = self.largest(X[-1]) if scenario is None else scenario
        if name not in self.scenarios:
            raise unknown("scenario", name, self.scenarios)
        group = next(group for group in self.groups if name in group.settings)
        return self._simulated(X, gradients, group, [group.settings[name]])

    def motions(self, x: np.ndarray) -> Trajectory:
        """Motions of one design [n], a lane for each scenario; InputError where they have several systems."""
        if len(self.groups) > 1:
            raise InputError(
                f"scenarios have {len(self.groups)} systems; allowed: motions_by_system(x), a Trajectory for each system"
            )
        return self.motions_by_system(x)[0]

    def motions_by_system(self, x: np.ndarray) -> list[Trajectory]:
        """Motions of one design [n], one for each system, a lane for each of its scenarios (`groups` names them)."""
        X = np.asarray(x, dtype=float)[None]
        return [self._simulated(X, False, group, list(group.settings.values())) for group in self.groups]

    def _simulated(
        self, X: np.ndarray, gradients: bool, group: Group, scenarios: Sequence[dict[str, Tensor]]
    ) -> Trajectory:
        designs = self._designs(self._checked(X, len(self.space.names), len(self.names)), scenarios)
        way = self.gradients if gradients else "none"
        names = self.space.variables
        options: dict[str, Any] = {**self.simulation, "steps": self.steps}
        return simulate(group.system, self.duration, designs=designs, gradients=way, variables=names, **options)

    def cases(self, X: np.ndarray) -> list[tuple[System, dict[str, Tensor]]]:
        return [(group.system, self._designs(X, list(group.settings.values()))) for group in self.groups]

    def _designs(self, X: np.ndarray, scenarios: Sequence[dict[str, Tensor]]) -> dict[str, Tensor]:
        """Of designs [lanes, n], each in all scenarios."""
        designs = self.space.designs(X[:, : len(self.space.names)].repeat(len(scenarios), axis=0))
        for name in scenarios[0]:
            values = torch.stack([settings[name] for settings in scenarios])
            designs[name] = values.repeat(len(X), *[1] * (values.dim() - 1))
        return designs

    @cached_property
    def steps(self) -> int | None:
        """Steps of every motion: those that are asked for, else the most that the initial design needs in a scenario."""
        if self.simulation["steps"]:
            return self.simulation["steps"]
        counts = []
        for group in self.groups:
            designs = self._designs(self.space.start[None], list(group.settings.values()))
            try:
                motion = simulate(group.system, self.duration, designs=designs, gradients="none", **self.simulation)
            except (CutCluster, InputError, SimulationFailure):
                return None
            if any(x != OK for x in motion.status) or motion.integration.steps is None:
                return None
            counts.append(motion.integration.steps)
        return max(counts)

    def _by_place(self, parts: Sequence[Any]) -> Any:
        """Arrays [lanes, scenarios of a group, ...] as one of all scenarios, in their order."""
        order = np.argsort([place for group in self.groups for place in group.places])
        return np.concatenate(parts, 1)[:, order]

    @cached_property
    def reference(self) -> Reference:
        motions = self.motions_by_system(self.start)
        for group, motion in zip(self.groups, motions, strict=True):
            for name, status in zip(group.settings, motion.status, strict=True):
                if status != OK:
                    raise SimulationFailure(f"the initial design in scenario {name!r}: {status}")
        first = next(motion for group, motion in zip(self.groups, motions, strict=True) if 0 in group.places)
        measures = [m.at_start(first) for m in (self.objective, *(c.measure for c in self.constraints))]
        unit = max(float(measures[0].value(motion).max()) for motion in motions) if self.peaks else 1.0
        if not unit > 0.0:
            raise InputError(f"{self.objective!r} is {unit:g} at most at the initial design; allowed: positive")
        limits, scales = [], []
        for c, measure in zip(self.constraints, measures[1:], strict=True):
            count = len(self.scenarios)
            own = np.full(count, np.nan if c.limit == "initial" else c.limit, dtype=float)
            if c.limit == "initial":
                found = [measure.value(motion).detach().reshape(1, motion.lanes, -1).numpy() for motion in motions]
                own = self._by_place([x.max(2) for x in found])[0]
            if self._of_constraints != "each":
                own = np.array([self.weights @ own if self._of_constraints == "mean" else own.max()])
            limits.append(own.repeat(measure.rows))
            scales.append(np.array([scale_of(c, float(limit)) for limit in limits[-1]]))
        return Reference(measures, unit, np.concatenate([np.zeros(0), *limits]), np.concatenate([np.zeros(0), *scales]))

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[Evaluation]:
        """Evaluate designs [lanes, n] in all scenarios as one batch, or as several where it would fill much of the memory."""
        X = self._checked(X, len(self.names))
        most = max(1, self._lanes_at_once(gradients) // len(self.scenarios))
        if len(X) > most:
            parts = [X[first : first + most] for first in range(0, len(X), most)]
            return [evaluation for part in parts for evaluation in self.evaluate(part, gradients)]
        try:
            motions = [self._simulated(X, gradients, group, list(group.settings.values())) for group in self.groups]
        except (CutCluster, InputError, SimulationFailure) as error:
            if len(X) == 1:
                return [Evaluation.failure(self._refused(X, gradients, error), self.rows)]
            return [evaluation for x in X for evaluation in self.evaluate(x[None], gradients)]
        values, slopes = self._rows(motions, X)
        statuses = self._by_place([np.array(motion.status, dtype=object).reshape(len(X), -1) for motion in motions])
        return [
            self._evaluation(statuses[lane], v, s)
            for lane, (v, s) in enumerate(zip(values, slopes if slopes is not None else [None] * len(X), strict=True))
        ]

    def _refused(self, X: np.ndarray, gradients: bool, error: Exception) -> str:
        """Which scenario the structure stage refuses, and why."""
        each = [(group, name, settings) for group in self.groups for name, settings in group.settings.items()]
        for group, name, settings in each:
            try:
                self._simulated(X, gradients, group, [settings])
            except (CutCluster, InputError, SimulationFailure) as own:
                return f"failed: scenario {name!r}: {own}"
        return f"failed: {error}"

    def _evaluation(self, statuses: Sequence[str], values: np.ndarray, slope: np.ndarray | None) -> Evaluation:
        for name, status in zip(self.scenarios, statuses, strict=True):
            if status != OK:
                return Evaluation.failure(f"failed: scenario {name!r}: {status.removeprefix('failed: ')}", self.rows)
        if not np.isfinite(values).all():
            return Evaluation.failure("failed: a response is not finite", self.rows)
        if slope is None:
            return Evaluation(float(values[0]), values[1:])
        if not np.isfinite(slope).all():
            return Evaluation.failure("failed: the gradient of a response is not finite", self.rows)
        return Evaluation(float(values[0]), values[1:], slope[0], slope[1:])

    def _rows(self, motions: Sequence[Trajectory], X: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """Objective and normalized constraints [lanes, 1 + m] with gradients [lanes, 1 + m, n], over the scenarios."""
        reference = self.reference

        def rows(motion: Trajectory) -> list[Tensor]:
            return [m.value(motion).reshape(motion.lanes, -1) for m in reference.measures]

        found = [differentiate(rows, motion) for motion in motions]
        values = self._by_place(
            [
                one.value.numpy().reshape(len(X), motion.lanes // len(X), -1)
                for one, motion in zip(found, motions, strict=True)
            ]
        )
        slopes, gradients = None, [one.gradient for one in found if one.gradient is not None]
        if gradients:
            mapped = [x.numpy() @ self.space.map for x in gradients]
            slopes = self._by_place([x.reshape(len(X), -1, *x.shape[1:]) for x in mapped])
        parts, first = [], 0
        ways = [("each" if self._of_objective == "worst" else "mean", 1.0)]
        ways += [(self._of_constraints, -1.0 if c.kind == "at_least" else 1.0) for c in self.constraints]
        for measure, (way, sign) in zip(reference.measures, ways, strict=True):
            own = slice(first, first := first + measure.rows)
            parts.append(self._over(way, sign, values[:, :, own], None if slopes is None else slopes[:, :, own]))
        combined = np.concatenate([v for v, _ in parts], 1)
        gradient = None if slopes is None else np.concatenate([s for _, s in parts if s is not None], 1)
        own = self.peaks or 1
        combined[:, own:] = (combined[:, own:] - reference.limits) / reference.scale
        if gradient is not None:
            gradient[:, own:] /= reference.scale[:, None]
        return (
            self._with_extra_variable(combined, gradient, X[:, -1], reference.unit)
            if self.peaks
            else (combined, gradient)
        )

    def _over(
        self, way: str, sign: float, values: np.ndarray, slopes: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Rows of a measure [lanes, scenarios, rows] as what is asked of the scenarios."""
        lanes, count, rows = values.shape
        if way == "each":
            return values.reshape(lanes, -1), None if slopes is None else slopes.reshape(lanes, count * rows, -1)
        if way == "mean":
            weigh = np.einsum("s,ls...->l...", self.weights, values)
            return weigh, None if slopes is None else np.einsum("s,ls...->l...", self.weights, slopes)
        worst = np.argmax(sign * values, 1)[:, None]
        chosen = np.take_along_axis(values, worst, 1)[:, 0]
        return chosen, None if slopes is None else np.take_along_axis(slopes, worst[..., None], 1)[:, 0]
