"""One design in several scenarios: payloads, speeds, load cases. All scenarios of all designs are one batch.

    minimize f(b) over the scenarios s   subject to   g_i(b, s) <= c_i

    payloads = {"light": {"tool.mass": 0.1}, "heavy": {"tool.mass": 0.4}}
    problem = mbd.Scenarios(system, 0.1, mbd.Max(deflection), mbd.Max(failure) <= 1.0, scenarios=payloads)

A scenario sets parameters of the system that are not design variables: lane l S + s of the batch is design l in scenario s,
so each further scenario costs a lane; the eigensolutions of a design are shared by its scenarios
(fem/reduction/shared_modes.py). A scenario may have another system, also one of another topology. Scenarios of one system
are one batch, and the batches are simulated one after another.

    {"alone": {}, "in pairs": {"system": build(arms=2), "tool.mass": 0.1}}

Checked in tests/design/test_scenarios.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchmbd.design.differentiate import differentiate
from torchmbd.design.problem import Problem
from torchmbd.design.problem_parts import Reference, limits_of, reference_of
from torchmbd.design.response import Constraint, Measure
from torchmbd.design.scenario_settings import SYSTEM, combined, normalized_weights, scenarios_by_name, settings_of
from torchmbd.errors import InputError, SimulationFailure, unknown, within
from torchmbd.fem.reduction import CutCluster
from torchmbd.integrate import Trajectory
from torchmbd.multibody.system import System
from torchmbd.results.motion_data import OK
from torchmbd.simulation import Simulation

OBJECTIVES, CONSTRAINTS = ("worst", "mean"), ("each", "worst", "mean")


class Group(NamedTuple):
    """Scenarios of one system, which are simulated as one batch.

    simulation  of the system
    indices     of these scenarios in the order of all scenarios
    settings    name of a scenario -> parameter -> value; all scenarios of the group have the same parameters
    """

    simulation: Simulation
    indices: list[int]
    settings: dict[str, dict[str, Tensor]]


class Scenarios(Problem):
    """A transient optimization problem of one design in several scenarios.

    system, duration, minimize, subject_to   as in Problem
    scenarios    name -> {parameter: value}, or a list of such settings; parameters that are not design variables [SI]. The
                 key "system" gives a scenario another system, which has all design variables in the same shapes
    objective    "worst": the largest over the scenarios (a min-max problem, with an extra variable); "mean"
    constraints  "each": hold in every scenario; "worst": one row, of the scenario that is nearest to its limit; "mean"
    weights      of the scenarios in means; None: equal. They are divided by their sum
    options      maximize, bounds, variables, start, links, method, steps, phases and options of the method, as in Problem

    A limit "initial" is the value of the initial design in the same scenario. With constraints "worst" or "mean" it is the
    worst or the mean of these values. A WeightedSum is normalized by its value in the first scenario. If a
    design fails in one scenario, its evaluation fails and names the scenario.

    >>> problem = mbd.Scenarios(
    ...     mbd.examples.arm(),
    ...     0.05,
    ...     mbd.Integral(mbd.StrainEnergy("arm")),
    ...     scenarios={"light": {"arm.laminate.thickness": [1e-3, 1e-3]}, "heavy": {"arm.laminate.thickness": [2e-3, 2e-3]}},
    ...     objective="mean",
    ...     variables=["arm.laminate.angles"],
    ...     steps=20,
    ... )
    >>> [evaluation] = problem.evaluate(problem.start[None], True)
    >>> evaluation.status, evaluation.objective_gradient.shape
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
        for name, rule, allowed in (("objective", objective, OBJECTIVES), ("constraints", constraints, CONSTRAINTS)):
            if rule not in allowed:
                raise InputError(name, rule, allowed)
        if constraints != "each" and any(c.kind == "equal" for c in self.constraints):
            raise InputError("constraints", constraints, "'each'", shown=f"{constraints!r}, and one is an equality")
        if self.peaks and objective == "mean":
            state, allowed = f"has {self.peaks} rows, and objective is 'mean'", "a measure of one number"
            raise InputError("minimize", minimize, allowed, state=state)
        if objective == "worst" and self.sign < 0.0:
            state, hint = "is given with objective='worst'", "minimize, with the negative of the measure"
            raise InputError("maximize", options["maximize"], "given with objective='mean'", hint, state=state)
        self.groups = self._grouped(scenarios)
        self.scenarios = {name: settings for group in self.groups for name, settings in group.settings.items()}
        self.scenarios = {str(name): self.scenarios[str(name)] for name in scenarios_by_name(scenarios)}
        self._objective_rule, self._constraint_rule = objective, constraints
        self.weights = normalized_weights(weights, len(self.scenarios))
        if objective == "worst":
            self.peaks = self.objective.rows * len(self.scenarios)

    def _grouped(self, scenarios: Any) -> list[Group]:
        """The scenarios by their systems."""
        scenarios = scenarios_by_name(scenarios)
        is_mapping = isinstance(scenarios, Mapping) and all(isinstance(x, Mapping) for x in scenarios.values())
        if not is_mapping or not scenarios:
            raise InputError("scenarios", scenarios, "a mapping name -> {parameter: value} with at least one name")
        if not any(scenarios.values()):
            shown = f"{scenarios!r}, and sets nothing"
            raise InputError("scenarios", scenarios, "must have at least a parameter or a system", shown=shown)
        systems: list[System] = []
        for key, settings in scenarios.items():
            system = settings.get(SYSTEM, self.system)
            if not any(system is known for known in systems):
                self._check_system(key, system)
                systems.append(system)
        return [self._group(system, scenarios) for system in systems]

    def _check_system(self, scenario: str, system: Any) -> None:
        """InputError unless the system of a scenario has the design variables, and what responses need."""
        if not isinstance(system, System):
            noun = f"system of scenario {scenario!r}"
            raise InputError(("scenarios", scenario, SYSTEM), system, "a System", noun=noun)
        shapes = {name: x.shape for name, x in system.named_parameters()}
        for name, shape in self.space.shapes.items():
            if shapes.get(name) != shape:
                has = "no such parameter" if name not in shapes else f"one of shape {list(shapes[name])}"
                state, allowed = (
                    f"has {has}: {name!r}",
                    f"must have all design variables, {name!r} of shape {list(shape)}",
                )
                path, noun = ("scenarios", scenario, SYSTEM), f"system of scenario {scenario!r}"
                raise InputError(path, system, allowed, noun=noun, state=state)
        for measure in (self.objective, *(constraint.measure for constraint in self.constraints)):
            measure.check(system)

    def _settings(self, system: System, scenario: str, settings: Mapping[str, Any]) -> dict[str, Tensor]:
        place, path = f"in scenario {scenario!r}", ("scenarios", scenario)
        return settings_of(system, self.space.variables, place, settings, path)

    def _group(self, system: System, scenarios: Mapping[str, Mapping[str, Any]]) -> Group:
        """The scenarios of one system, all with values of the same parameters."""
        of_system = {key: x for key, x in scenarios.items() if x.get(SYSTEM, self.system) is system}
        values = {str(k): self._settings(system, str(k), x) for k, x in of_system.items()}
        parameters = dict(system.named_parameters())
        names = list(dict.fromkeys(name for settings in values.values() for name in settings))
        default = {name: parameters[name].detach() for name in names}
        values = {key: default | settings for key, settings in values.items()}
        simulation = self.simulation if system is self.system else self.simulation.with_arguments(system=system)
        return Group(simulation, [k for k, key in enumerate(scenarios) if key in of_system], values)

    def settings(self) -> list[Any]:
        rules = [self._objective_rule, self._constraint_rule, self.weights]
        groups = [[group.simulation.system, group.indices, group.settings] for group in self.groups]
        return [*super().settings(), *groups, *rules]

    @property
    def simulations(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return len(self.scenarios)

    @property
    def rows(self) -> int:
        return self.peaks + sum(c.measure.rows for c in self.constraints) * self._repeats

    @property
    def _repeats(self) -> int:
        return len(self.scenarios) if self._constraint_rule == "each" else 1

    def largest(self, x: np.ndarray) -> str:
        """Name of the scenario in which the objective of a design [n] is largest; a failed motion counts as the smallest.

        If several scenarios have the same objective, for example a mass, the constraints decide: the result is the scenario
        that is nearest to its limit, or farthest beyond it.
        """
        motions = self.motions_by_system(x)
        # [scenarios, rows].
        objective, *constraints = (
            self.in_scenario_order(
                [m.value(motion).detach().reshape(1, motion.lanes, -1).numpy() for motion in motions]
            )[0]
            for m in self.reference.measures
        )
        excesses = self._excesses(constraints)
        statuses = self.in_scenario_order([np.array([motion.status]) for motion in motions])[0]
        objectives = np.where(statuses == OK, objective.max(1), -np.inf)
        candidates = np.flatnonzero(np.isclose(objectives, objectives.max(), rtol=1e-9, atol=0.0))
        return list(self.scenarios)[candidates[np.argmax(excesses[candidates])]]

    def _excesses(self, constraints: Sequence[np.ndarray]) -> np.ndarray:
        """The largest (g - limit) / scale in every scenario [scenarios], of values g [scenarios, rows] of each constraint."""
        excesses, first = np.full(len(self.scenarios), -np.inf), 0
        for constraint, g in zip(self.constraints, constraints, strict=True):
            rows = slice(first, first := first + g.shape[1] * self._repeats)
            limit, scale = (x[rows].reshape(-1, g.shape[1]) for x in (self.reference.limits, self.reference.scale))
            excess = (g - limit) / scale
            excess = abs(excess) if constraint.kind == "equal" else excess
            excesses = np.fmax(excesses, excess.max(1))
        return excesses

    def simulate(self, X: np.ndarray, gradients: bool = False, scenario: str | None = None) -> Trajectory:
        """Motions of designs [lanes, n] in one scenario. With None it is the scenario in which the last design has the
        largest objective.
        """
        X = self.checked_designs(X, len(self.space.names), len(self.names))
        name = self.largest(X[-1]) if scenario is None else scenario
        if name not in self.scenarios:
            raise unknown("scenario", name, self.scenarios)
        group = next(group for group in self.groups if name in group.settings)
        return self._motion(group.simulation, self._designs(X, [group.settings[name]]), gradients)

    def motions(self, x: np.ndarray) -> Trajectory:
        """Motions of one design [n], a lane for each scenario; InputError if they have several systems."""
        if len(self.groups) > 1:
            raise InputError(
                "scenarios",
                allowed="must have one system",
                state=f"have {len(self.groups)} systems",
                hint="motions_by_system(x), which returns a Trajectory for each system",
            )
        return self.motions_by_system(x)[0]

    def motions_by_system(self, x: np.ndarray) -> list[Trajectory]:
        """Motions of one design [n], one for each system, a lane for each of its scenarios (`groups` has their names)."""
        return self._motions(np.asarray(x, dtype=float)[None], False)

    def _motions(self, X: np.ndarray, gradients: bool, diagnose: bool = True) -> list[Trajectory]:
        X = self.checked_designs(X, len(self.space.names), len(self.names))
        try:
            return super()._motions(X, gradients, diagnose)
        except CutCluster as error:  # its lanes count scenarios, so they are no indices of designs
            raise within("scenarios", error, *error.path) from error

    def cases(self, X: np.ndarray) -> list[tuple[Simulation, dict[str, Tensor]]]:
        return [(group.simulation, self._designs(X, list(group.settings.values()))) for group in self.groups]

    def _designs(self, X: np.ndarray, settings: Sequence[dict[str, Tensor]]) -> dict[str, Tensor]:
        """Parameters of designs [lanes, n], each in all scenarios of some settings [lanes * scenarios, ...]."""
        designs = self.space.designs(X[:, : len(self.space.names)].repeat(len(settings), axis=0))
        for name in settings[0]:
            values = torch.stack([values_of_scenario[name] for values_of_scenario in settings])
            designs[name] = values.repeat(len(X), *[1] * (values.dim() - 1))
        return designs

    def in_scenario_order(self, parts: Sequence[Any]) -> Any:
        """One array [lanes, scenarios, ...] of arrays [lanes, scenarios of a group, ...]."""
        order = np.argsort([index for group in self.groups for index in group.indices])
        return np.concatenate(parts, 1)[:, order]

    @cached_property
    def reference(self) -> Reference:
        measures, motions = [self.objective, *(c.measure for c in self.constraints)], []
        if self._refers_to_start:
            motions = self._initial_motions()
            first = next(motion for group, motion in zip(self.groups, motions, strict=True) if 0 in group.indices)
            measures = [measure.at_start(first) for measure in measures]
        pairs = zip(self.constraints, measures[1:], strict=True)
        limits = [self._limits(constraint, measure, motions) for constraint, measure in pairs]
        return reference_of(self.constraints, measures, self._extra_variable(measures), limits)

    def _initial_motions(self) -> list[Trajectory]:
        """Motions of the initial design in all scenarios; SimulationFailure names one that fails."""
        motions = self.motions_by_system(self.start)
        for group, motion in zip(self.groups, motions, strict=True):
            for name, status in zip(group.settings, motion.status, strict=True):
                if status != OK:
                    raise SimulationFailure(f"the initial design in scenario {name!r}: {status}")
        return motions

    @property
    def rules(self) -> list[tuple[str, bool]]:
        """How `combined` joins the scenarios of the objective and of every constraint, and whether a limit is a lower one."""
        objective = ("each" if self._objective_rule == "worst" else "mean", False)
        return [objective, *((self._constraint_rule, c.kind == "at_least") for c in self.constraints)]

    def _limits(self, constraint: Constraint, measure: Measure, motions: Sequence[Trajectory]) -> np.ndarray:
        """Limits of the rows in every scenario [scenarios * rows], or of all scenarios together [rows] by the rule."""
        initial = np.zeros((len(self.scenarios), measure.rows))
        if motions:
            values = [measure.value(motion).detach().reshape(1, motion.lanes, -1).numpy() for motion in motions]
            initial = self.in_scenario_order(values)[0]
        limits = limits_of(constraint, initial)
        if self._constraint_rule == "each":
            return limits.reshape(-1)
        if self._constraint_rule == "mean":
            return self.weights @ limits
        return limits.min(0) if constraint.kind == "at_least" else limits.max(0)

    def _refusal(self, X: np.ndarray, gradients: bool, error: Exception) -> str:
        for group in self.groups:
            for name, settings in group.settings.items():
                try:
                    self._motion(group.simulation, self._designs(X, [settings]), gradients)
                except (InputError, SimulationFailure) as refusal:
                    return f"failed: scenario {name!r}: {refusal}"
        return f"failed: {error}"

    def _statuses(self, motions: Sequence[Trajectory], count: int) -> Sequence[str]:
        """The status of each design: that of its first scenario that fails, with the name of the scenario."""
        by_group = [np.array(motion.status, dtype=object).reshape(count, -1) for motion in motions]
        result = []
        for statuses in self.in_scenario_order(by_group):
            failed = [(name, x) for name, x in zip(self.scenarios, statuses, strict=True) if x != OK]
            texts = [f"failed: scenario {name!r}: {x.removeprefix('failed: ')}" for name, x in failed]
            result.append(texts[0] if texts else OK)
        return result

    def _unscaled(
        self, motions: Sequence[Trajectory], measures: Sequence[Measure]
    ) -> tuple[np.ndarray, np.ndarray | None]:
        measured = [differentiate(partial(self._measured, measures), motion) for motion in motions]
        lanes = sum(motion.lanes for motion in motions) // len(self.scenarios)
        by_group = [x.value.numpy() for x in measured]
        values = self.in_scenario_order([x.reshape(lanes, -1, x.shape[1]) for x in by_group])
        by_group = [self.space.slopes(x.gradient.numpy()) for x in measured if x.gradient is not None]
        slopes = None
        if by_group:
            slopes = self.in_scenario_order([x.reshape(lanes, -1, *x.shape[1:]) for x in by_group])
        parts, first = [], 0
        for measure, (rule, lower_limit) in zip(measures, self.rules, strict=True):
            rows = slice(first, first := first + measure.rows)
            own_slopes = None if slopes is None else slopes[:, :, rows]
            parts.append(combined(rule, values[:, :, rows], own_slopes, self.weights, lower_limit))
        gradients = None if slopes is None else np.concatenate([s for _, s in parts if s is not None], 1)
        return np.concatenate([v for v, _ in parts], 1), gradients
