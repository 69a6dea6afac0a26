"""One door to all integrators: `simulate(system, duration, method=...)`.

"generalized_alpha" (default) integrates the index-3 equations with equal steps; every method of torchdiffeq goes by its
own name on the index-1 form. Both return the same Trajectory and agree within their tolerances
(tests/convergence/test_two_routes.py).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.integrators import compiled_adjoint, generalized_alpha, ode, staged_alpha, staged_ode
from torchmbd.integrators.adjoint import Adjoint
from torchmbd.integrators.arguments import check, check_adjoint, check_designs, check_sensitivities
from torchmbd.integrators.attempts import careful, numbers_until, run, status_of, with_retries
from torchmbd.integrators.course import Course
from torchmbd.integrators.events import Views
from torchmbd.integrators.history import History
from torchmbd.integrators.memory import require_room
from torchmbd.integrators.phases import Phase, plan
from torchmbd.integrators.shapes import DesignShapes
from torchmbd.integrators.signals import Recorded, Untangled
from torchmbd.integrators.singular import explained
from torchmbd.integrators.spin import warn_of_spin
from torchmbd.integrators.trajectory import OK, Trajectory
from torchmbd.numerics.called import exclusive
from torchmbd.system import Dynamics, System

FEWEST = 200  # steps, where the number is left to us


@exclusive
def simulate(
    system: System,
    duration: float,
    method: str = "generalized_alpha",
    steps: int | None = None,
    sensitivities: bool | Sequence[str] = False,
    designs: Mapping[str, Tensor] | None = None,
    phases: Sequence[Phase] | None = None,
    adjoint: bool | None = False,
    **options: Any,
) -> Trajectory:
    """Simulate one design, or a batch of designs side by side (lanes).

    system         the model; its own parameters are the design where `designs` says nothing
    duration       simulated time [s], positive
    method         "generalized_alpha" or a method of torchdiffeq, such as "dopri5" or "rk4"
    steps          equal time steps, and output intervals; default: 20 per period of the fastest retained mode, at least 200.
                   Adaptive methods choose their own steps between the outputs
    sensitivities  True: by every parameter that requires a gradient; or the names of parameters
    designs        parameter name -> values [lanes, ...]; others keep their own values
    phases         locks, releases and ends of the phases that follow each other (phases.py); default: one without either
    adjoint        True: no sensitivities of the motion itself; gradients of responses by going back through its steps, which
                   costs about a simulation for the first and half of one for each further response, however many
                   variables there are (adjoint.py).
                   generalized_alpha on the CPU without phases only. None: where that is possible and compiled code is at hand
    options        generalized_alpha: spectral_radius, iterations, refresh; halvings and device (not with phases);
                   torchdiffeq: rtol, atol, options
    device         "cuda" or "cuda:1": the motion is made there, in float64; its structure, and responses, on the CPU

    A lane that fails is reported in `status`, and nan from there on; so is one whose steps do not resolve its vibrations, with
    all numbers. Threads that simulate wait for each other: use processes, or lanes. Raises InputError for bad arguments.
    """
    if not isinstance(system, System):
        raise InputError(f"system is {system!r}; allowed: a System")
    options = check(duration, method, steps, options, phases is not None)
    duration = float(duration)
    check_designs(system, designs)
    names = check_sensitivities(system, sensitivities)
    check_adjoint(adjoint, method, phases is not None, names, options.get("device"))
    possible = bool(names) and method == "generalized_alpha" and "device" not in options
    with torch.inference_mode(False):  # wherever the caller is: inference tensors have no gradients, not even later
        batch = _same_lanes({name: _own(system, name) for name in names} | dict(designs or {}))
        if phases is not None:
            system, stages = plan(system, phases, duration)
        parameters = labels(system, names)
        size = {"tangents": len(parameters), "adjoint": adjoint is not False}
        lanes = max((len(x) for x in batch.values()), default=1)
        require_room(system, lanes, int(steps or FEWEST), **size)
        dynamics = system.dynamics(batch, tangents=names)
        if steps is None:
            require_room(system, lanes, default_steps(dynamics, duration), **size)
        steps = int(steps or default_steps(dynamics, duration))
        design = {"designs": batch, "parameters": parameters}
        with torch.no_grad():
            if phases is None:
                if possible and _back(adjoint, dynamics):
                    motion = _with_way_back(system, dynamics, duration, steps, options, design)
                else:
                    history, stats, status = run(dynamics, duration, steps, method, options)
                    signals = Recorded(history, partial(_multipliers, dynamics, duration))
                    motion = _present(system, dynamics, signals, stats, status, duration, **design)
                motion = _ended(explained(motion))
                warn_of_spin(motion)
                return motion
            views = Views.of(system, dynamics, **design)
            course = Course(dynamics, stages, views, duration, steps)
            stats, status = _through(course, method, options)
            if method == "generalized_alpha" and options.get("refresh", 1) and any(x != OK for x in status):
                again = Course(dynamics, stages, views, duration, steps)
                counts, better = _through(again, method, options | careful(options))
                if better.count(OK) > status.count(OK):
                    course, stats, status = again, counts | {"renewed": list(range(len(status)))}, better
        signals = Recorded(course.history, course.multipliers)
        motion = _present(system, course.whole, signals, stats, status, duration, **design)
        motion = _ended(motion)
        warn_of_spin(motion)
        return replace(motion, switches=course.switches, actions=tuple(stage.topology.actions for stage in stages))


def _ended(motion: Trajectory) -> Trajectory:
    """The motion with nan for what comes after the failure of a lane."""
    signals = motion.signals
    assert isinstance(signals, Recorded)
    until = numbers_until(signals.history, motion.status, motion.stats)
    motion.stats.pop("until", None)
    return replace(motion, signals=signals.ended(until))


def _back(adjoint: bool | None, dynamics: Dynamics) -> bool:
    """Whether gradients come by going back through the steps."""
    return compiled_adjoint.ready(dynamics.condensed()) if adjoint is None else adjoint


def _with_way_back(
    system: System, dynamics: Dynamics, duration: float, steps: int, options: dict[str, Any], design: dict[str, Any]
) -> Trajectory:
    """A motion without tangents, and its adjoint."""
    begun = generalized_alpha.begin(dynamics)
    values = begun.values()
    history, stats, status = with_retries(values, duration, steps, precise=True, **options)
    signals = Untangled(history, partial(_multipliers, values.whole, duration))
    motion = _present(system, dynamics, signals, stats, status, duration, **design)
    return replace(motion, adjoint=Adjoint(begun, history, duration, options, compiled_adjoint.sweep))


def _through(course: Course, method: str, options: dict[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Integrate through all phases; statistics and status."""
    if method == "generalized_alpha":
        stats = staged_alpha.integrate(course, **options)
    else:
        stats = staged_ode.integrate(course, method, **options)
    found = status_of(course.history, course.duration, course.steps, stats)
    return stats, [own if own != OK else other for own, other in zip(course.status, found, strict=True)]


def labels(system: System, names: Sequence[str]) -> tuple[str, ...]:
    """One label for each entry of the named parameters: `rod.laminate.angles[0]`."""
    own = dict(system.named_parameters())
    return tuple(f"{name}[{i}]" for name in names for i in range(own[name].numel()))


def _own(system: System, name: str) -> Tensor:
    return dict(system.named_parameters())[name].detach()[None]


def _same_lanes(batch: dict[str, Tensor]) -> dict[str, Tensor]:
    counts = {name: x.shape[0] for name, x in batch.items()}
    lanes = max(counts.values(), default=1)
    if not {1, lanes}.issuperset(counts.values()):
        raise InputError(f"designs have lanes {counts}; allowed: the same number for all, or one")
    return {name: x.detach().clone().expand(lanes, *x.shape[1:]) for name, x in batch.items()}


def default_steps(dynamics: Dynamics, duration: float) -> int:
    """Twenty steps per period of the fastest retained mode, at least 200 in all."""
    if "Kr" not in dynamics.data:
        return 1000
    return max(FEWEST, math.ceil(20.0 * duration * ode.fastest_vibration(dynamics) / (2.0 * math.pi)))


def _multipliers(dynamics: Dynamics, duration: float, history: History, data: Any = None) -> Tensor:
    """All multipliers [times, rows, slots, lanes] of a motion; of redundant rows those of least norm.

    data   instead of those of the dynamics
    """
    least = dynamics.least_norm
    if least is None:
        return history.multipliers
    times = torch.linspace(0.0, duration, len(history.q), dtype=torch.float64)
    return least.at_times(dynamics.data if data is None else data, times, history.rows(0), history.multipliers)


def _present(
    system: System,
    dynamics: Dynamics,
    signals: Recorded,
    stats: dict[str, Any],
    status: list[str],
    duration: float,
    designs: dict[str, Tensor],
    parameters: tuple[str, ...],
) -> Trajectory:
    """What was integrated, with all that belongs to it."""
    return Trajectory(
        t=torch.linspace(0.0, duration, signals.times, dtype=torch.float64),
        signals=signals,
        status=status,
        stats=stats,
        system=system,
        dynamics=dynamics,
        shapes=DesignShapes(system, designs, parameters, dynamics.lanes),
        designs=designs,
        parameters=parameters,
    )
