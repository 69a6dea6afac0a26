"""One door to all integrators: `simulate(system, duration, method=...)`.

"generalized_alpha" (default) integrates the index-3 equations with equal steps; every method of torchdiffeq goes by its
own name on the index-1 form. Both return the same Trajectory and agree within their tolerances
(tests/convergence/test_two_routes.py).
"""

from __future__ import annotations

import math
import warnings
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
from torchmbd.integrators.course import Course
from torchmbd.integrators.events import Views
from torchmbd.integrators.history import History
from torchmbd.integrators.phases import Phase, plan
from torchmbd.integrators.shapes import DesignShapes
from torchmbd.integrators.signals import Recorded, Untangled
from torchmbd.integrators.singular import explained
from torchmbd.integrators.spin import warn_of_spin
from torchmbd.integrators.trajectory import OK, Trajectory
from torchmbd.system import Dynamics, System

# A motion is accepted when the iteration of every step left less than this share of the largest acceleration.
ITERATION_ERROR = 1e-2
# With sensitivities more than this is tried again carefully: gradients are those of equations that are solved.
IMPRECISE = 1e-3
TURN = 1.0  # [rad] of a body in one step
STEP_ERROR = 1.0  # as large as the vibrations themselves: worth a warning
_LOOKED_AT = ("iteration_error", "turn", "step_error", "suggested_steps")


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
                   costs about a simulation for each response, however many variables there are (adjoint.py).
                   generalized_alpha on the CPU without phases only. None: where that is possible and compiled code is at hand
    options        generalized_alpha: spectral_radius, iterations, refresh; halvings and device (not with phases);
                   torchdiffeq: rtol, atol, options
    device         "cuda" or "cuda:1": the motion is made there, in float64; its structure, and responses, on the CPU

    A lane that fails is reported in `status`. Raises InputError for bad arguments.
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
        dynamics = system.dynamics(batch, tangents=names)
        steps = int(steps or default_steps(dynamics, duration))
        design = {"designs": batch, "parameters": labels(system, names)}
        with torch.no_grad():
            if phases is None:
                if possible and _back(adjoint, dynamics):
                    motion = _with_way_back(system, dynamics, duration, steps, options, design)
                else:
                    history, stats, status = run(dynamics, duration, steps, method, options)
                    signals = Recorded(history, partial(_multipliers, dynamics, duration))
                    motion = _present(system, dynamics, signals, stats, status, duration, **design)
                motion = explained(motion)
                warn_of_spin(motion)
                return motion
            views = Views.of(system, dynamics, **design)
            course = Course(dynamics, stages, views, duration, steps)
            stats, status = _through(course, method, options)
            if method == "generalized_alpha" and options.get("refresh", 1) and any(x != OK for x in status):
                again = Course(dynamics, stages, views, duration, steps)
                counts, better = _through(again, method, options | _careful(options))
                if better.count(OK) > status.count(OK):
                    course, stats, status = again, counts | {"renewed": list(range(len(status)))}, better
        signals = Recorded(course.history, course.multipliers)
        motion = _present(system, course.whole, signals, stats, status, duration, **design)
        warn_of_spin(motion)
        return replace(motion, switches=course.switches, actions=tuple(stage.topology.actions for stage in stages))


def _back(adjoint: bool | None, dynamics: Dynamics) -> bool:
    """Whether gradients come by going back through the steps."""
    return compiled_adjoint.ready(dynamics.condensed()) if adjoint is None else adjoint


def _with_way_back(
    system: System, dynamics: Dynamics, duration: float, steps: int, options: dict[str, Any], design: dict[str, Any]
) -> Trajectory:
    """A motion without tangents, and its adjoint."""
    begun = generalized_alpha.begin(dynamics)
    values = begun.values()
    history, stats, status = _with_retries(values, duration, steps, precise=True, **options)
    signals = Untangled(history, partial(_multipliers, values.whole, duration))
    motion = _present(system, dynamics, signals, stats, status, duration, **design)
    return replace(motion, adjoint=Adjoint(begun, history, duration, options, compiled_adjoint.sweep))


def _through(course: Course, method: str, options: dict[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Integrate through all phases; statistics and status."""
    if method == "generalized_alpha":
        stats = staged_alpha.integrate(course, **options)
    else:
        stats = staged_ode.integrate(course, method, **options)
    found = _status(course.history, course.duration, course.steps, stats)
    return stats, [own if own != OK else other for own, other in zip(course.status, found, strict=True)]


def _careful(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options of generalized_alpha for lanes that failed: a new matrix for every correction, and more of these.

    The matrix of the step before does not suit one near a singular position: there its inverse grows without bound.
    """
    values, tangents = options.get("iterations", (3, 1))
    return {"iterations": (2 * values, tangents), "refresh": 0}


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
    return max(200, math.ceil(20.0 * duration * ode.fastest_vibration(dynamics) / (2.0 * math.pi)))


def run(
    dynamics: Dynamics, duration: float, steps: int, method: str, options: dict[str, Any]
) -> tuple[History, dict[str, Any], list[str]]:
    """Integrate; a lane that fails does not take the others with it.

    Equal steps: the lanes that failed are tried again (`_with_retries`). Adaptive methods: the lanes are run one by one.
    """
    if method == "generalized_alpha":
        begun = generalized_alpha.begin(dynamics)
        return _with_retries(begun, duration, steps, precise=dynamics.tangents > 0, **options)
    try:
        history, stats = ode.integrate(dynamics, duration, steps, method, **options)
        return history, stats, _status(history, duration, steps, {})
    except FloatingPointError as error:
        if dynamics.lanes == 1:
            return _empty(dynamics, steps), {}, [f"failed: {error}"]
    parts = [run(dynamics.some([i]), duration, steps, method, options) for i in range(dynamics.lanes)]
    q, v, vd, lam = (torch.cat([getattr(h, name) for h, _, _ in parts], -1) for name in ("q", "v", "vd", "lam"))
    counts = {"evaluations": sum(s.get("evaluations", 0) for _, s, _ in parts)}
    return History(q, v, vd, lam), counts, [status for _, _, statuses in parts for status in statuses]


def _with_retries(
    begun: generalized_alpha.Begun, duration: float, steps: int, precise: bool, halvings: int = 1, **options: Any
) -> tuple[History, dict[str, Any], list[str]]:
    """generalized_alpha; lanes that fail, or whose gradients are imprecise, are tried again carefully, then with half the step.

    precise: whether there are gradients;  halvings: how many times the step may be halved
    """
    if not isinstance(halvings, int) or halvings < 0:
        raise InputError(f"halvings is {halvings!r}; allowed: a whole number, 0 or more")
    history, stats = generalized_alpha.integrate(begun, duration, steps, **options)
    status = _status(history, duration, steps, stats)
    quick = options.get("refresh", 1) > 0
    poor = (stats["iteration_error"] > (IMPRECISE if quick and precise else torch.inf)).tolist()
    failed = [lane for lane, reason in enumerate(status) if reason != OK or poor[lane]]
    if not failed or not (quick or halvings):
        return history, stats, status
    often, left = (1, halvings) if quick else (2, halvings - 1)
    options |= _careful(options) if quick else {}
    again = generalized_alpha.begin(begun.whole.some(failed))
    better, counts, retried = _with_retries(again, duration, often * steps, precise, left, **options)
    cured = [(i, lane) for i, lane in enumerate(failed) if retried[i] == OK]
    if not cured:
        return history, stats, status
    source, lanes = (list(x) for x in zip(*cured, strict=True))

    def patch(x: Tensor, y: Tensor) -> Tensor:
        old, new = (torch.tensor(i).to(x.device) for i in (lanes, source))
        return x.index_copy(-1, old, y[::often].index_select(-1, new))

    parts = {name: patch(getattr(history, name), getattr(better, name)) for name in ("q", "v", "vd", "lam")}
    for name in (*_LOOKED_AT, "tangent_error"):
        if name in stats:
            stats[name][lanes] = counts[name][source]
    for lane in lanes:
        status[lane] = OK
    halved = lanes if often == 2 else [failed[i] for i in counts.get("halved", [])]
    stats |= {"halved": halved, "renewed": [lane for lane in lanes if lane not in halved]}
    return replace(history, **parts, finer=_finer(better, often, cured)), stats, status


def _finer(better: History, often: int, cured: list[tuple[int, int]]) -> dict:
    """Where the smaller steps of lanes are that were `cured` [(place among the failed, lane)]."""
    result = {}
    for i, lane in cured:
        if i in better.finer:
            history, own, every = better.finer[i]
            result[lane] = history, own, every * often
        elif often > 1:
            result[lane] = better, i, often
    return result


def _empty(dynamics: Dynamics, steps: int) -> History:
    start = generalized_alpha.initial(dynamics)
    return History.of([start.map(lambda x: x * torch.nan)] * (steps + 1))


def _status(history: History, duration: float, steps: int, stats: dict[str, Any]) -> list[str]:
    """For each lane: the first time at which it is not finite, or what its steps leave to be desired."""
    # A sum is finite where all its terms are, short of overflow: one pass over the numbers.
    good = torch.stack([torch.isfinite(x.sum((1, 2))) for x in (history.q, history.v, history.vd)]).all(0).cpu()
    result = []
    for lane in range(good.shape[1]):
        bad = torch.nonzero(~good[:, lane])
        if len(bad):
            result.append(f"failed: the motion is not finite from t = {duration * int(bad[0]) / steps:.6g} s on")
        else:
            result.append(_complaint({name: float(stats[name][lane]) for name in _LOOKED_AT if name in stats}))
    return result


def _complaint(found: dict[str, float]) -> str:
    """What is wrong with the steps of a finite motion, or "ok"."""
    if found.get("iteration_error", 0.0) > ITERATION_ERROR:
        left = found["iteration_error"]
        return f"failed: the iteration of a step did not converge (relative error {left:.1e}); more steps help"
    if found.get("turn", 0.0) > TURN:
        return f"failed: a body turns by {found['turn']:.2g} rad in one step; allowed: {TURN:g}"
    if found.get("step_error", 0.0) > STEP_ERROR:
        # Not a failure: of a stiff body only the gross motion may be wanted, which damped vibrations leave right.
        warnings.warn(
            f"the steps do not resolve the vibrations of a flexible body (estimated error {found['step_error']:.1e} of the "
            f"largest): its energies mean little; {found['suggested_steps']:.0f} steps would resolve them",
            stacklevel=6,
        )
    return OK


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
