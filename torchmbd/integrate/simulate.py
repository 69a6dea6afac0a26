"""One function for all integrators: `simulate(system, duration, method=...)`, a differentiable operation of PyTorch.

    parameters --structure stage--> data --Motion--> q, v, a, lam --torch--> responses

"generalized_alpha" (default) integrates the index-3 equations with equal steps; every method of torchdiffeq goes by its
own name on the index-1 form. Both return the same Trajectory and agree within their tolerances
(tests/convergence/test_two_routes.py).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError, argument_names, checked_signature
from torchmbd.integrate.arguments import (
    check_backend,
    check_gradients,
    check_phase_times,
    check_start,
    checked_designs,
    checked_integrator,
    checked_variables,
    duration_is_differentiated,
    refuse_dual_level,
    seconds_of,
    start_of,
)
from torchmbd.integrate.forward_integration import ForwardIntegration
from torchmbd.integrate.jumps import warn_of_jumps
from torchmbd.integrate.memory import require_memory
from torchmbd.integrate.motion import Motion
from torchmbd.integrate.one_step import OneStep
from torchmbd.integrate.outputs import switches_with
from torchmbd.integrate.phase import Phase
from torchmbd.integrate.registry import DEFAULT
from torchmbd.integrate.reverse_integration import ReverseIntegration
from torchmbd.integrate.segment import DURATION, segments_of, switching, times_of
from torchmbd.integrate.simulation import Simulation
from torchmbd.integrate.step_count import FEWEST, rounding
from torchmbd.math.gradients import is_differentiated
from torchmbd.math.module_call import exclusive, outside_transforms
from torchmbd.multibody.system import Dynamics, System
from torchmbd.multibody.system.expansion import Expansion
from torchmbd.multibody.system.truncation import warn_static_truncation
from torchmbd.progress import motion_shown
from torchmbd.results.elastic_limits import (
    name_causes,
    warn_of_displacements,
    warn_of_loads,
    warn_of_spin,
)
from torchmbd.results.history import History
from torchmbd.results.mode_shapes import DesignShapes, without_failed
from torchmbd.results.singular_positions import report_singular_positions
from torchmbd.results.time_rows import IntegratedSignals, StepStates
from torchmbd.results.trajectory import Trajectory


@checked_signature
@exclusive
def simulate(
    system: System,
    duration: float | Tensor,
    method: str = DEFAULT,
    steps: int | None = None,
    designs: Mapping[str, Tensor] | None = None,
    phases: Sequence[Phase] | None = None,
    gradients: str = "auto",
    variables: Sequence[str] | None = None,
    backend: str = "auto",
    start: str | Mapping[str, Any] | Trajectory = "assembled",
    progress: bool | None = None,
    **options: Any,
) -> Trajectory:
    """Simulate one design, or a batch of independent designs (lanes).

    The motion is a differentiable function of the parameters, as any operation of torch: of `designs` and of parameters of
    the system that require a gradient, in grad mode and under torch.func. Second derivatives are refused.

    system      the model; parameters that `designs` does not name keep their own values
    duration    simulated time [s], positive; a tensor [] has a gradient: the number of steps stays, their size changes
    method      "generalized_alpha", "hht_alpha", or a method of torchdiffeq, such as "dopri5" or "rk4"
    steps       equal time steps, and output intervals; default: as many as drives, loads and the vibrations that they excite
                need, by the estimated error of a step, at least 200 (how-to "Choose steps"); `stats["steps"]` says how many.
                Adaptive methods choose their own steps between the outputs
    designs     parameter name -> values [lanes, ...], or [...] for one lane; others keep their own values
    phases      a list of Phase, one after the other; default: a single phase without locks or releases
    gradients   "reverse": by the adjoint of the steps, about one simulation for the first response and half of one for each
                further one, however many variables there are; one-step methods, such as generalized_alpha.
                "forward": by tangents of all variables, integrated with the motion: about a quarter of a simulation for each;
                then the motion has `dq_db` as well. "auto": reverse where there is an adjoint, else forward, by what
                requires a gradient or is under torch.func. "none": values only
    backend     what makes the steps: "native" (C++, compiled once for kinds of joints and forces), "eager" (operators of torch,
                the reference) or "auto": native where there is a compiler and all laws can be traced. The same call gives the
                same numbers every time
    start       "assembled": bodies as they were given, joints closed, flexible bodies undeformed or `bent`. "equilibrium": at
                rest under gravity and forces, drives where they are at t = 0. A motion: its last state. Or numbers [...] or
                [lanes, ...] for some bodies, {"rod.modal": ..., "load.velocity": ...}: position, axes, velocity,
                angular_velocity, modal, modal_velocity. Joints are closed and rates made compatible from there
    progress    a bar of the simulated time on standard error; None: in a terminal or a notebook, where the motion takes more
                than three seconds
    variables   names of the parameters by which gradients are wanted; default with "forward" and "reverse": all that require
                a gradient
    options     of the method: the fields of its class in registry.py. generalized_alpha: spectral_radius, iterations, refresh;
                halvings, and checkpoint=k, which keeps every k-th state; torchdiffeq: rtol, atol, options

    `status` reports a lane that fails; it is nan from there on and adds nothing to a gradient. `status` also reports a lane
    whose steps do not resolve its vibrations; this lane has all numbers. `stats` has the mode of gradients and the backend.
    Threads that simulate wait for each other: use processes, or lanes. Raises InputError for bad arguments.

    >>> motion = mbd.simulate(mbd.examples.arm(), duration=0.1, steps=40)
    >>> motion.status, motion.q.shape  # lanes, times, coordinates
    (['ok'], torch.Size([1, 41, 16]))
    >>> designs = {"arm.laminate.angles": mbd.deg([[0.0, 90.0], [45.0, -45.0]])}
    >>> both = mbd.simulate(mbd.examples.arm(), 0.1, steps=40, designs=designs)  # two designs at once
    >>> mbd.Max(mbd.StrainEnergy("arm"))(both).shape
    torch.Size([2])
    """
    if not isinstance(system, System):
        raise InputError(f"system is {system!r}; allowed: a System")
    design_values = checked_designs(system, designs)
    system.join_again()
    phases = switching(phases)
    integrator = checked_integrator(duration, method, steps, options, argument_names(simulate))
    initial = start_of(system, start)
    model = system  # without the start, which `arguments` have
    system = system if start == "assembled" else system.starting(initial)
    integrator = integrator.with_defaults(system.topology)
    steps = None if steps is None else int(steps)
    seconds = float(seconds_of(duration))  # a float of NumPy may be one of single precision
    check_gradients(gradients, integrator)
    check_backend(backend)
    grad = gradients in ("forward", "reverse") or (gradients == "auto" and torch.is_grad_enabled())
    # Inference tensors have no gradients, not even later; to leave their mode switches grad mode on.
    with torch.inference_mode(False), torch.set_grad_enabled(grad), motion_shown(progress, seconds):
        warn_static_truncation(system)
        by_duration = duration_is_differentiated(duration, gradients, integrator)
        if phases is not None:
            check_phase_times(phases, gradients, integrator)
            outside_transforms(lambda: segments_of(system, phases, seconds))
        warn_of_jumps(system, seconds, steps, integrator, phases, by_duration)
        by_times = by_duration or any(phase.time is not None for phase in phases or ())
        names = variable_names(system, design_values, gradients, variables, by_times)
        check_start(initial, gradients, integrator)
        if gradients != "none":
            _refuse_other_designs(names, design_values)
        batch = lanes_of_batch(system, design_values, names, initial.lanes)
        if gradients in ("forward", "reverse"):
            leaves = {k for k, x in batch.items() if k in names and not is_differentiated(x)}
            batch = {k: x.detach().clone().requires_grad_() if k in leaves else x for k, x in batch.items()}
        lanes = max((len(x) for x in batch.values()), default=initial.lanes)
        intervals = integrator.stored_intervals(steps) if steps else FEWEST
        tangents = sum(x[0].numel() for name, x in batch.items() if name in names)
        require_memory(system, lanes, intervals, tangents, gradients != "forward")
        if gradients == "forward" or phases is not None or not integrator.adjoint:
            refuse_dual_level(batch)
        if gradients == "forward" or not isinstance(integrator, OneStep):
            integration = ForwardIntegration(
                names=tuple(batch),
                variables=tuple(names),
                labels=entry_labels(system, names),
                duration=seconds,
                steps=steps,
                system=system,
                phases=phases,
                integrator=integrator,
                backend=backend,
            )
            outputs: Any = Motion.apply(integration, *_lanes_last(batch))
            whole = integration.system  # with the locks of its phases
            motion = trajectory_of(whole, integration, outputs, integration.dynamics.data, batch, names)
            motion.actions = integration.actions
        else:
            motion = _reverse(
                system,
                batch,
                names,
                duration=duration if by_duration else seconds,
                steps=steps,
                integrator=integrator,
                backend=backend,
                phases=phases,
            )
        motion.stats["backend"] = motion.integration.dynamics.backend
        mode = "forward" if isinstance(motion.integration, ForwardIntegration) else "reverse"
        motion.stats["gradients"] = mode if names or by_times or initial.is_differentiated else "none"
        with torch.no_grad():
            if phases is None:
                report_singular_positions(plain(motion))
            motion.stats.pop("valid_times", None)
            values = plain(motion, motion.integration.validity[0, 0])
            warn_of_spin(values)
            warn_of_loads(values)
            warn_of_displacements(values)
            name_causes(values)
        arguments = {
            "duration": seconds,
            "method": method,
            "designs": {k: x.detach() for k, x in design_values.items()},
        }
        arguments |= {"phases": phases, "backend": backend, "start": start}
        count = motion.integration.steps or len(motion.t) - 1
        motion.simulation = Simulation(
            simulate=simulate,
            system=model,
            integrator=integrator,
            steps=count,
            multiple=rounding(integrator, motion.integration.dynamics, seconds)(1),
            arguments=arguments,
            options=options,
            parameters={name: x.detach().clone() for name, x in model.named_parameters()},
        )
        return motion


def plain(motion: Trajectory, valid_times: Tensor | None = None) -> Trajectory:
    """The motion on plain tensors, also under torch.func; it shares status and statistics.

    valid_times: as of IntegratedSignals
    """
    integration = motion.integration
    dynamics, h = integration.dynamics.values(), integration.history
    q, v, vd, lam = (x[:, :, :1] for x in (h.q, h.v, h.vd, h.lam))
    history = History(q, v, vd, lam, integration.expansion(dynamics.data), segment=h.segment)
    signals = IntegratedSignals(history, integration, dynamics.data, valid_times)
    return replace(
        motion, signals=signals, dynamics=dynamics, designs={}, variables={}, integration=None, t=motion.t.detach()
    )


def variable_names(
    system: System, designs: Mapping[str, Tensor], gradients: str, variables: Sequence[str] | None, by_times: bool
) -> list[str]:
    """Names of the parameters by which the motion is differentiated.

    by_times: whether it is differentiated by its duration or times of its phases as well
    """
    if gradients == "none":
        return []
    parameters = dict(system.named_parameters())
    if variables is not None:
        return checked_variables(system, variables)
    if gradients == "auto":
        return [name for name, x in parameters.items() if is_differentiated(designs.get(name, x))]
    names = [name for name, x in parameters.items() if x.requires_grad or is_differentiated(designs.get(name, x))]
    if not names and not by_times:
        raise InputError(f"gradients is {gradients!r}, but no parameter of the system requires a gradient")
    return names


def _refuse_other_designs(names: Sequence[str], designs: Mapping[str, Tensor]) -> None:
    """InputError where a design is being differentiated, but is none of the variables of these names."""
    for name, x in designs.items():
        if name not in names and is_differentiated(x):
            raise InputError(
                f"design {name!r} is being differentiated, but variables is {list(names)}; allowed: variables with it, "
                "or its x.detach()"
            )


def _reverse(
    system: System,
    batch: dict[str, Tensor],
    names: list[str],
    *,
    duration: float | Tensor,
    steps: int | None,
    integrator: OneStep,
    backend: str,
    phases: Sequence[Phase] | None,
) -> Trajectory:
    """A motion whose structure stage is differentiated by torch, and its steps by their adjoint; also by a `duration` []."""
    seconds, segments, model = seconds_of(duration), None, system
    if phases is not None:
        system, segments = outside_transforms(lambda: segments_of(model, phases, seconds))
    dynamics, shapes = system.stages(batch)
    if phases is not None:
        mode_counts = dynamics.topology.mode_counts
        system, segments = outside_transforms(lambda: segments_of(model.with_modes(mode_counts), phases, seconds))
        dynamics = replace(system.equations(), data=dynamics.data)
    data = dynamics.data | times_of(segments or ())
    if isinstance(duration, Tensor):
        data[DURATION] = duration[None, None]
    integration = ReverseIntegration(
        names=tuple(data),
        designs=tuple(batch) if segments else (),
        differentiated=tuple(name for name, x in data.items() if x.requires_grad and name != DURATION),
        duration=seconds,
        steps=steps,
        system=system,
        segments=segments,
        model=replace(dynamics, data={}),
        integrator=integrator,
        backend=backend,
    )
    designs = _lanes_last(batch) if segments else []
    outputs: Any = Motion.apply(integration, *data.values(), *designs)
    if not torch.is_grad_enabled():
        shapes = {}  # made on demand: they take memory
    motion = trajectory_of(system, integration, outputs, data, batch, names, shapes)
    motion.actions = tuple(segment.topology.actions for segment in segments or ())
    return _at_moving_times(motion, duration) if isinstance(duration, Tensor) else motion


def _at_moving_times(motion: Trajectory, duration: Tensor) -> Trajectory:
    """The motion at times that are functions of the duration."""
    signals = motion.signals
    assert isinstance(signals, IntegratedSignals)
    t = torch.linspace(0.0, 1.0, signals.times, dtype=torch.float64) * duration
    h, x = signals.history, signals.history.expansion
    x = None if x is None else Expansion.of(x.condensation, x.data, t)
    history = replace(h, expansion=x, times=t)
    signals = IntegratedSignals(history, signals.integration, signals.data, signals.valid_times, signals.at_steps)
    return replace(motion, t=t, signals=signals)


def _lanes_last(batch: dict[str, Tensor]) -> list[Tensor]:
    """Designs [lanes, ...] as inputs [..., 1, lanes] of `Motion`."""
    return [x.movedim(0, -1).unsqueeze(-2) for x in batch.values()]


def trajectory_of(
    system: System,
    integration: Any,
    outputs: Sequence[Tensor],
    data: dict[str, Any],
    designs: dict[str, Tensor],
    names: Sequence[str],
    shapes: Mapping[str, Tensor] = MappingProxyType({}),
) -> Trajectory:
    """The motion as a function of the outputs of `Motion`, the data of the reduced model and the designs.

    names    of the variables;  shapes: mode shapes that were made already
    """
    motion = integration.outputs.like(outputs)
    q, v, vd, lam = motion.states
    valid_times, good = motion.validity[0, 0].detach(), motion.validity[1, 0] > 0.0
    whole = integration.dynamics
    data = without_failed(dict(data) | motion.data, good)
    dynamics = Dynamics(whole.topology, whole.saddle, data, whole.initial, whole.stabilization, whole.backend)
    history = History(q, v, vd, lam, integration.expansion(data), segment=next(iter(motion.segment), None))
    at_steps = StepStates(*motion.at_steps) if motion.at_steps else None
    signals = IntegratedSignals(history, integration, data, valid_times, at_steps)
    return Trajectory(
        t=torch.linspace(0.0, integration.duration, len(q), dtype=torch.float64),
        signals=signals,
        status=integration.status,
        stats=integration.stats,
        system=system,
        dynamics=dynamics,
        shapes=DesignShapes(system, designs, signals.lanes, good, shapes),
        good=good,
        designs=designs,
        parameters=entry_labels(system, names),
        variables={name: designs[name] for name in names},
        switches=switches_with(integration.switches, motion.switches),
        integration=integration,
    )


def entry_labels(system: System, names: Sequence[str]) -> tuple[str, ...]:
    """One label for each entry of the named parameters: `rod.laminate.angles[0]`."""
    parameters = dict(system.named_parameters())
    return tuple(f"{name}[{i}]" for name in names for i in range(parameters[name].numel()))


def lanes_of_batch(
    system: System, designs: Mapping[str, Tensor], names: Sequence[str], start_lanes: int
) -> dict[str, Tensor]:
    """Designs, and own values of the other variables `names`, all with the same lanes [lanes, ...]."""
    parameters = dict(system.named_parameters())
    batch = {name: parameters[name][None] for name in names if name not in designs} | dict(designs)
    counts = {name: x.shape[0] for name, x in batch.items()}
    lanes = max([*counts.values(), start_lanes])
    if not {1, lanes}.issuperset([*counts.values(), start_lanes]):
        start = f" and start {start_lanes}" if start_lanes > 1 else ""
        raise InputError(f"designs have lanes {counts}{start}; allowed: the same number for all, or one")
    return {name: x.clone().expand(lanes, *x.shape[1:]) for name, x in batch.items()}
