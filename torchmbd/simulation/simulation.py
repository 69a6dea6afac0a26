"""A simulation: a system with its duration, method, phases and start, checked and prepared once, called with designs.

    parameters --structure stage--> data --Motion--> q, v, a, lam --torch--> responses

A preparation has the start, the system that begins there with its topology and saddle point, the integrator with the defaults
of this system, and the segments of the phases (phases/segment.py). A call checks the designs and integrates.

Numbers count as they are at the call: parameters and constants of the system, and tensors of `start`. Where the topology of the
system was made anew since the preparation, as `System` does for other constant positions, axes or rates of bodies and after
`load_state_dict`, or where `stabilization` is another, the next call prepares anew. Arguments cannot change.
Checked in tests/integrate/test_simulation.py, tests/integrate/test_simulate.py.
"""

from __future__ import annotations

import copy
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor

from torchmbd.diagnosis.diagnose import explain, warn_of_model, warn_of_motion
from torchmbd.diagnosis.jumps import refuse_jumps
from torchmbd.diagnosis.repetition import Repetition
from torchmbd.errors import InputError, argument_names, true_or_false
from torchmbd.fixed_arguments import FixedArguments
from torchmbd.integrate.arguments import (
    check_backend,
    check_dtypes,
    check_gradients,
    check_phase_times,
    check_start,
    checked_designs,
    checked_integrator,
    duration_is_differentiated,
    refuse_dual_level,
    seconds_of,
    start_of,
)
from torchmbd.integrate.backend import backend_of
from torchmbd.integrate.forward_integration import ForwardIntegration
from torchmbd.integrate.integrated_motion import IntegratedMotion
from torchmbd.integrate.integrated_trajectory import at_moving_times, plain, trajectory_of
from torchmbd.integrate.integrator import Integrator
from torchmbd.integrate.memory import require_memory
from torchmbd.integrate.motion import Motion
from torchmbd.integrate.one_step import OneStep
from torchmbd.integrate.phases.phase import ONE_PHASE, Phase
from torchmbd.integrate.phases.segment import (
    DURATION,
    Segment,
    actions_of,
    check_order,
    keep_equations,
    segments_of,
    times_of,
)
from torchmbd.integrate.registry import DEFAULT, integrator_of
from torchmbd.integrate.reverse_integration import ReverseIntegration
from torchmbd.integrate.step_count import FEWEST, rounding
from torchmbd.integrate.variables import entry_labels, lanes_of_batch, refuse_other_designs, variable_names
from torchmbd.math.gradients import is_differentiated
from torchmbd.math.module_call import exclusive, outside_transforms
from torchmbd.multibody.equations.topology import Topology
from torchmbd.multibody.start.start import Start
from torchmbd.multibody.system import System
from torchmbd.progress import motion_shown
from torchmbd.results.trajectory import Trajectory
from torchmbd.summary import Summary


class _Preparation(NamedTuple):
    """Parts of a simulation that follow from the topology of its system.

    topology, stabilization   of the system when it was prepared
    system                    the same with the start of the motions;  whole: with the locks of its phases as well
    segments                  of the phases
    keeps_equations           whether all joints and laws act in every segment
    """

    topology: Topology
    stabilization: float
    start: Start
    system: System
    whole: System
    segments: list[Segment]
    integrator: Integrator
    keeps_equations: bool


class Simulation(FixedArguments, Summary):
    """The motions of a system over a duration, for any designs: prepared and checked once, called often.

    system, duration, method, steps, phases, backend, start, options   as in `simulate`

    `simulation(designs, gradients, variables, progress, diagnose)` returns a Trajectory; its arguments are those of `simulate`.
    `simulate(...)` is `Simulation(...)(...)`, with the same numbers.

    A call uses the present numbers of parameters, constants and tensors of `start`. If constant positions, axes or velocities
    of bodies have changed, or a state dict was loaded, the call prepares the simulation again. Bodies, joints and forces of a
    System cannot change: make another System and another Simulation. Arguments of a Simulation cannot change either:
    `with_arguments` makes another. Raises InputError for bad arguments.

    >>> simulation = mbd.Simulation(mbd.examples.arm(), duration=0.1, steps=40)
    >>> simulation().q.shape  # lanes, times, coordinates
    torch.Size([1, 41, 16])
    >>> designs = {"arm.laminate.angles": mbd.deg([[0.0, 90.0], [45.0, -45.0]])}
    >>> simulation(designs, gradients="none").status  # two designs at once
    ['ok', 'ok']
    """

    def __init__(
        self,
        system: System,
        duration: float | Tensor,
        method: str = DEFAULT,
        steps: int | None = None,
        phases: Sequence[Phase] | None = None,
        backend: str = "auto",
        start: str | Mapping[str, Any] | Trajectory = "assembled",
        **options: Any,
    ):
        if not isinstance(system, System):
            raise InputError("system", system, "a System")
        self._integrator = checked_integrator(duration, method, steps, options, argument_names(Simulation))
        check_backend(backend)
        check_dtypes(system)
        self.system, self.duration, self.method, self.backend = system, duration, method, backend
        self.steps = None if steps is None else int(steps)
        self.phases = tuple(phases) if isinstance(phases, list) and phases else ONE_PHASE if phases is None else phases
        self.start = dict(start) if isinstance(start, Mapping) else start
        self.options = options
        self._known: _Preparation | None = None
        self._prepared()

    @classmethod
    def of_caller(cls, names: Collection[str], system: System, duration: float | Tensor, **arguments: Any) -> Self:
        """The simulation that a function with arguments of these `names` makes: a message about an option names the nearest."""
        options = {name: x for name, x in arguments.items() if name not in argument_names(cls)}
        integrator_of(arguments.get("method", DEFAULT), options, names)
        return cls(system, duration, **arguments)

    def _remedy(self, argument: str) -> str:
        """The remedy in the error: how a simulation with another argument is made."""
        return f"simulation.with_arguments({argument}=...), which makes another"

    @property
    def seconds(self) -> float:
        """The duration as a number [s]."""
        return float(seconds_of(self.duration))  # a float of NumPy may be one of single precision

    @property
    def integrator(self) -> Integrator:
        """The integrator, with the defaults of the system."""
        return self._prepared().integrator

    @property
    def settings(self) -> dict[str, Any]:
        """All arguments but system and duration, without a start that is the default."""
        settings = {"method": self.method, "steps": self.steps, "phases": self.phases, "backend": self.backend}
        start = {} if isinstance(self.start, str) and self.start == "assembled" else {"start": self.start}
        return settings | self.options | start

    def with_steps(self, steps: int | None) -> Self:
        """The same simulation by other steps; the preparation is shared."""
        if (steps is None or isinstance(steps, int)) and steps == self.steps:
            return self
        checked_integrator(self.duration, self.method, steps, self.options)
        known, other = self._prepared(), copy.copy(self)
        vars(other).update(steps=None if steps is None else int(steps), _known=known)
        return other

    def with_arguments(self, **arguments: Any) -> Simulation:
        """A simulation with some other arguments, checked and prepared anew."""
        return Simulation(**{"system": self.system, "duration": self.duration} | self.settings | arguments)

    def _summary(self) -> list[tuple[str, Any]]:
        return [
            ("bodies", ", ".join(body.name for body in self.system.bodies)),
            ("motion", f"{self.seconds:g} s, {self.method}, steps {self.steps or 'by default'}"),
            ("phases", len(self.phases)),
            ("backend", self.backend),
        ]

    def __getstate__(self) -> dict[str, Any]:
        """Arguments only: the process that reads them prepares."""
        return vars(self) | {"_known": None}

    @exclusive
    def _prepared(self) -> _Preparation:
        """The preparation, anew where the system has changed (module header)."""
        system, known = self.system, self._known
        system.join_again()
        if known and known.topology is system.topology and known.stabilization == system.stabilization:
            return known
        # Whatever the mode of its maker: later calls may have gradients, also by a motion at whose end they start.
        with torch.inference_mode(False), torch.enable_grad():
            start = start_of(system, self.start)
            is_assembled = isinstance(self.start, str) and self.start == "assembled"
            from_start = system if is_assembled else system.starting(start)
            whole, segments = _segments(from_start, self.phases, self.seconds)
        integrator = self._integrator.with_defaults(from_start.topology)
        keeps = keep_equations(segments, whole.topology)
        of_system = system.topology, system.stabilization
        self._known = _Preparation(*of_system, start, from_start, whole, segments, integrator, keeps)
        return self._known

    @exclusive
    def __call__(
        self,
        designs: Mapping[str, Tensor] | None = None,
        gradients: str = "auto",
        variables: Sequence[str] | None = None,
        progress: bool | None = None,
        diagnose: bool = True,
    ) -> Trajectory:
        """The motions of designs, name -> values [lanes, ...], or [...] for one lane; arguments as in `simulate`.

        Raises InputError for bad arguments.
        """
        design_values = checked_designs(self.system, designs)
        diagnose = true_or_false("diagnose", diagnose)
        prepared = self._prepared()
        start, system, integrator = prepared.start, prepared.system, prepared.integrator
        check_gradients(gradients, integrator)
        phases, steps, seconds = self.phases, self.steps, self.seconds
        grad = gradients in ("forward", "reverse") or (gradients == "auto" and torch.is_grad_enabled())
        # Inference tensors have no gradients, not even later; to leave their mode switches grad mode on.
        with torch.inference_mode(False), torch.set_grad_enabled(grad), motion_shown(progress, seconds):
            by_duration = duration_is_differentiated(self.duration, gradients, integrator)
            check_phase_times(phases, gradients, integrator)
            check_order(phases, seconds)
            if by_duration:
                refuse_jumps(system, seconds, phases)
            if diagnose:
                warn_of_model(system, seconds, steps, integrator, phases)
            by_times = by_duration or any(phase.time is not None for phase in phases)
            names = variable_names(system, design_values, gradients, variables, by_times)
            check_start(start, gradients, integrator)
            if gradients != "none":
                refuse_other_designs(names, design_values)
            batch = lanes_of_batch(system, design_values, names, {"start": start.lanes})
            if gradients in ("forward", "reverse"):
                leaves = {k for k, x in batch.items() if k in names and not is_differentiated(x)}
                batch = {k: x.detach().clone().requires_grad_() if k in leaves else x for k, x in batch.items()}
            lanes = max((len(x) for x in batch.values()), default=start.lanes)
            intervals = integrator.stored_intervals(steps) if steps else FEWEST
            tangents = sum(x[0].numel() for name, x in batch.items() if name in names)
            require_memory(system, lanes, intervals, tangents, gradients != "forward")
            has_switches = len(prepared.segments) > 1 or not prepared.keeps_equations
            if gradients == "forward" or has_switches or not integrator.adjoint:
                refuse_dual_level(batch)
            forward = gradients == "forward" or not isinstance(integrator, OneStep)
            if forward:
                motion = self._with_tangents(prepared, batch, names)
            else:
                motion = self._with_adjoint(prepared, batch, names, self.duration if by_duration else seconds)
            made = motion.integration
            assert isinstance(made, IntegratedMotion)
            assert made.steps is not None  # they are known once it has run
            dynamics = made.dynamics
            motion.stats["backend"] = dynamics.backend
            motion.stats["threads"] = backend_of(dynamics).threads(dynamics, integrator.work)
            mode = "forward" if forward else "reverse"
            motion.stats["gradients"] = mode if names or by_times or start.is_differentiated else "none"
            motion.stats.pop("valid_times", None)
            with torch.no_grad():
                values = plain(motion, made.validity[0, 0])
                values = replace(values, switches=made.switches)
                explain(values, plain(motion))
                if diagnose:
                    warn_of_motion(values, plain(motion))
            motion.repetition = Repetition(
                simulation=self,
                designs={name: x.detach() for name, x in design_values.items()},
                integrator=integrator,
                steps=made.steps,
                multiple=rounding(integrator, dynamics, seconds)(1),
                parameters={name: x.detach().clone() for name, x in self.system.named_parameters()},
            )
            return motion

    def _with_tangents(self, prepared: _Preparation, batch: dict[str, Tensor], names: list[str]) -> Trajectory:
        """A motion whose tangents by the parameters of these names are integrated with it."""
        integration = ForwardIntegration(
            names=tuple(batch),
            variables=tuple(names),
            labels=entry_labels(prepared.system, names),
            duration=self.seconds,
            steps=self.steps,
            system=prepared.system,
            phases=self.phases,
            integrator=prepared.integrator,
            backend=self.backend,
        )
        outputs: Any = Motion.apply(integration, *_lanes_last(batch))
        whole = integration.system  # with the locks of its phases
        motion = trajectory_of(whole, integration, outputs, integration.dynamics.data, batch, names)
        motion.actions = integration.actions
        return motion

    def _with_adjoint(
        self, prepared: _Preparation, batch: dict[str, Tensor], names: list[str], duration: float | Tensor
    ) -> Trajectory:
        """A motion whose structure stage is differentiated by torch, its steps by their adjoint; also by a `duration` []."""
        model, integrator = prepared.system, prepared.integrator
        phases, seconds = self.phases, self.seconds
        assert isinstance(integrator, OneStep)
        system, segments = prepared.whole, prepared.segments
        dynamics, shapes = system.stages(batch)
        if (of_modes := model.with_modes(dynamics.topology.mode_counts)) is not model:
            system, segments = _segments(of_modes, phases, seconds)
        dynamics = replace(system.equations(), data=dynamics.data)
        data = dynamics.data | times_of(segments)
        if isinstance(duration, Tensor):
            data[DURATION] = duration[None, None]
        events = batch if any(segment.ends_by_event for segment in segments) else {}
        integration = ReverseIntegration(
            names=tuple(data),
            designs=tuple(events),
            differentiated=tuple(name for name, x in data.items() if x.requires_grad and name != DURATION),
            duration=seconds,
            steps=self.steps,
            system=system,
            segments=segments,
            model=replace(dynamics, data={}),
            integrator=integrator,
            backend=self.backend,
        )
        outputs: Any = Motion.apply(integration, *data.values(), *_lanes_last(events))
        if not torch.is_grad_enabled():
            shapes = {}  # made on demand: they take memory
        motion = trajectory_of(system, integration, outputs, data, batch, names, shapes)
        motion.actions = actions_of(segments, dynamics.topology)
        return at_moving_times(motion, duration) if isinstance(duration, Tensor) else motion


def _segments(system: System, phases: Sequence[Phase], seconds: float) -> Any:
    """As `segments_of`, also under a transform of torch.func."""
    return outside_transforms(lambda: segments_of(system, phases, seconds))


def _lanes_last(batch: dict[str, Tensor]) -> list[Tensor]:
    """Designs [lanes, ...] as inputs [..., 1, lanes] of `Motion`."""
    return [x.movedim(0, -1).unsqueeze(-2) for x in batch.values()]
