"""A motion through phases, integrated: attempts, status, and its switches as numbers that `Motion` returns.

Shared by the two ways to gradients (forward_integration.py, reverse.py).
Checked in tests/integrate/phases/test_phase.py, tests/sensitivity/test_events.py.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchmbd.integrate.attempts import chosen, contact_steps, doubted, has_failed, status_of, warn_unresolved
from torchmbd.integrate.contacts import ContactWatch, Doubt
from torchmbd.integrate.estimates import StepErrors
from torchmbd.integrate.integrator import Integrator
from torchmbd.integrate.phases.events import Views
from torchmbd.integrate.phases.phase import PhaseModel
from torchmbd.integrate.phases.run import MultiphaseRun
from torchmbd.math.pair import Pair
from torchmbd.multibody.system import Dynamics
from torchmbd.results.motion_data import OK, Switch

SIDES = ("q", "v", "a", "lam")
NUMBERS = 1 + 2 * len(SIDES)  # of a switch


def integrate(
    dynamics: Dynamics,
    phase_models: list[PhaseModel],
    views: Views,
    duration: float,
    steps: int,
    integrator: Integrator,
) -> tuple[MultiphaseRun, dict[str, Any], list[str]]:
    """Through all stages, once more and carefully where lanes failed; with statistics and status of the lanes."""

    def attempt(integrator: Integrator) -> tuple[MultiphaseRun, dict[str, Any], list[str]]:
        multiphase = MultiphaseRun(dynamics, phase_models, views, duration, steps)
        stats = integrator.integrate_phases(multiphase)
        found = status_of(multiphase.history, duration, stats)
        found = [own if own != OK else other for own, other in zip(multiphase.status, found, strict=True)]
        doubted(found, _doubts(multiphase, duration, steps, integrator.adjoint))
        return multiphase, stats, found

    multiphase, stats, status = attempt(integrator)
    again = integrator.again()
    if again is not None and again.steps == 1 and any(x != OK for x in status):
        other, counts, better = attempt(again.integrator)
        if better.count(OK) > status.count(OK):
            failed = [lane for lane, reason in enumerate(status) if has_failed(reason)]
            return other, counts | {"renewed": list(range(len(status))), "failed_first": failed}, better
    warn_unresolved(status)
    return multiphase, stats, status


def _doubts(multiphase: MultiphaseRun, duration: float, steps: int, equal: bool) -> dict[int, Doubt]:
    """Contacts that the steps do not show; `equal`: as of ContactWatch."""
    watch, h = ContactWatch(multiphase.whole), multiphase.history
    if not watch.idle:
        times = torch.linspace(0.0, duration, steps + 1, dtype=torch.float64)
        watch.see(times, *(h.rows(order, pair=slice(1)) for order in range(2)))
    return watch.doubts(duration / steps, equal)


def steps_of_phases(
    system: Any,
    dynamics: Dynamics,
    phase_models: list[PhaseModel],
    designs: dict[str, Tensor],
    duration: float,
    integrator: Integrator,
    room: Callable[[int], None],
) -> int:
    """How many steps a motion through phases needs, of values alone (step_count.py)."""
    values = dynamics.values()

    def attempt(steps: int) -> tuple[None, dict[str, Any], list[str]]:
        multiphase = MultiphaseRun(values, phase_models, Views.of(system, values, designs), duration, steps)
        stats = integrator.integrate_phases(multiphase)
        h, recorded = duration / steps, multiphase.recorded()
        constant = abs(integrator.weights(1.0).step_from_new - 1.0 / 6.0)  # pyright: ignore[reportAttributeAccessIssue]
        errors = StepErrors(values, constant, h)
        errors.see(recorded, multiphase.number[1:] == multiphase.number[:-1])
        found = status_of(multiphase.history, duration, stats)
        # A phase that never ends does so with more steps as well.
        found = [OK if own != OK else other for own, other in zip(multiphase.status, found, strict=True)]
        wanted = contact_steps(_doubts(multiphase, duration, steps, True), steps, values.lanes)
        return None, stats | errors.statistics(steps) | wanted, found

    return chosen(integrator, values, duration, attempt, room)[0]


def numbers_of(switch: Switch) -> list[Any]:
    """Time and states of a switch as numbers [n, 1 + n_b, lanes]."""

    def number(x: Tensor, dx: Tensor | None) -> Any:
        y = x.T[:, None]
        return Pair(y if dx is None else torch.cat([y, dx.permute(1, 2, 0)], 1))

    t, dt = switch.t[:, None], switch.dt_db
    found = [number(t, None if dt is None else dt[:, None])]
    for side in (switch.before, switch.after):
        found += [number(getattr(side, name), getattr(side, f"d{name}_db")) for name in SIDES]
    return found


def switches_of(switches: Sequence[Switch], numbers: Sequence[Tensor]) -> list[Switch]:
    """The switches with their numbers as differentiable outputs."""

    def parts(rest: Iterator[Tensor]) -> Iterator[Switch]:
        for switch in switches:
            t = next(rest)[0, 0]
            before, after = (
                replace(side, **{name: next(rest)[:, 0].T for name in SIDES}) for side in (switch.before, switch.after)
            )
            yield replace(switch, t=t, before=before, after=after)

    return list(parts(iter(numbers)))
