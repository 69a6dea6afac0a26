"""A motion through phases, integrated: retries, the status of lanes, and switches as numbers that `Motion` returns.

Shared by forward and reverse mode (forward_integration.py, phases/reverse.py).
Checked in tests/integrate/phases/test_phase.py, tests/sensitivity/test_events.py.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchmbd.integrate.contacts import ContactWatch, UnresolvedContact
from torchmbd.integrate.estimates import StepErrors
from torchmbd.integrate.integrator import Integrator
from torchmbd.integrate.lane_status import mark_doubts, mark_unresolved_contacts, status_of_lanes, warn_unresolved
from torchmbd.integrate.one_step import OneStep
from torchmbd.integrate.phases.events import Views
from torchmbd.integrate.phases.run import MultiphaseRun
from torchmbd.integrate.segment import Segment
from torchmbd.integrate.step_count import Trial, choose_steps
from torchmbd.math.pair import Pair
from torchmbd.multibody.system import Dynamics
from torchmbd.results.motion_data import OK, Switch, has_failed

SIDES = ("q", "v", "a", "lam")
NUMBERS = 1 + 2 * len(SIDES)  # of a switch


def integrate(
    dynamics: Dynamics,
    phase_models: list[Segment],
    views: Views,
    duration: float,
    steps: int,
    integrator: Integrator,
) -> tuple[MultiphaseRun, dict[str, Any], list[str]]:
    """The motion through all phases, with statistics and status of the lanes; all of it once more where lanes failed."""

    def integrate_by(integrator: Integrator) -> tuple[MultiphaseRun, dict[str, Any], list[str]]:
        multiphase = MultiphaseRun(dynamics, phase_models, views, duration, steps)
        statistics = integrator.integrate_phases(multiphase) | _step_errors(multiphase, integrator)
        of_steps = status_of_lanes(multiphase.history, duration, statistics)
        status = [own if own != OK else other for own, other in zip(multiphase.status, of_steps, strict=True)]
        mark_doubts(status, multiphase.doubts)
        mark_unresolved_contacts(status, _unresolved_contacts(multiphase, by_steps=integrator.adjoint))
        return multiphase, statistics, status

    multiphase, statistics, status = integrate_by(integrator)
    retry, failed = integrator.retry(), [lane for lane, reason in enumerate(status) if has_failed(reason)]
    if retry is not None and retry.substeps == 1 and failed:
        other, other_statistics, other_status = integrate_by(retry.integrator)
        # Where both fail, the more careful one counts: what it reports is not that its iterations were too few.
        if {lane for lane, reason in enumerate(other_status) if has_failed(reason)} <= set(failed):
            by_retry = {"renewed": list(range(len(status))), "failed_first": failed}
            multiphase, statistics, status = other, other_statistics | by_retry, other_status
    warn_unresolved(status)
    return multiphase, statistics, status


def _unresolved_contacts(multiphase: MultiphaseRun, by_steps: bool) -> dict[int, UnresolvedContact]:
    """Contacts that the steps do not show; by_steps: as of ContactWatch."""
    watch, h = ContactWatch(multiphase.whole), multiphase.history
    if not watch.idle:
        watch.update(multiphase.times, *(h.rows(order, pair=slice(1)) for order in range(2)))
    return watch.unresolved(multiphase.duration / multiphase.steps, by_steps)


def _step_errors(multiphase: MultiphaseRun, integrator: Integrator) -> dict[str, Tensor]:
    """Estimated errors of the steps within the phases [lanes]; none of a method that has no such estimates."""
    if not isinstance(integrator, OneStep):
        return {}
    constant = abs(integrator.weights(1.0).step_from_new - 1.0 / 6.0)
    errors = StepErrors(multiphase.whole, constant, multiphase.duration / multiphase.steps)
    errors.update(multiphase.recorded(), multiphase.phase_number[1:] == multiphase.phase_number[:-1])
    return errors.statistics(multiphase.steps)


def steps_of_phases(
    system: Any,
    dynamics: Dynamics,
    phase_models: list[Segment],
    designs: dict[str, Tensor],
    duration: float,
    integrator: Integrator,
    check_memory: Callable[[int], None],
) -> int:
    """How many steps a motion through phases needs, of values alone (step_count.py)."""
    values = dynamics.values()

    def integrate_by(steps: int) -> Trial[None]:
        multiphase = MultiphaseRun(values, phase_models, Views.of(system, values, designs), duration, steps)
        statistics = integrator.integrate_phases(multiphase) | _step_errors(multiphase, integrator)
        status = status_of_lanes(multiphase.history, duration, statistics)
        # A phase that never ends does so with more steps as well.
        status = [OK if own != OK else other for own, other in zip(multiphase.status, status, strict=True)]
        contacts = _unresolved_contacts(multiphase, by_steps=True)
        return Trial(None, statistics, status, contacts)

    return choose_steps(integrator, values, duration, integrate_by, check_memory)[0]


def switch_numbers(switch: Switch) -> list[Any]:
    """Time and states of a switch as numbers [n, 1 + n_b, lanes]."""

    def number(x: Tensor, dx: Tensor | None) -> Any:
        y = x.T[:, None]
        return Pair(y if dx is None else torch.cat([y, dx.permute(1, 2, 0)], 1))

    t, dt = switch.t[:, None], switch.dt_db
    found = [number(t, None if dt is None else dt[:, None])]
    for side in (switch.before, switch.after):
        found += [number(getattr(side, name), getattr(side, f"d{name}_db")) for name in SIDES]
    return found


def switches_with(switches: Sequence[Switch], numbers: Sequence[Tensor]) -> list[Switch]:
    """The switches with numbers, in the order of `switch_numbers`, that are differentiable outputs of `Motion`."""

    def parts(rest: Iterator[Tensor]) -> Iterator[Switch]:
        for switch in switches:
            t = next(rest)[0, 0]
            before, after = (
                replace(side, **{name: next(rest)[:, 0].T for name in SIDES}) for side in (switch.before, switch.after)
            )
            yield replace(switch, t=t, before=before, after=after)

    return list(parts(iter(numbers)))
