"""Integration of lanes that fail alone: a lane that fails is integrated again, the others keep their motion.

    1. all lanes, by the steps asked for
    2. lanes with contacts that these steps do not show, by smaller steps (contacts.py); all lanes where held values of a
       controller change within a step (jumps.py)
    3. lanes that failed, and with gradients those whose iteration is imprecise, as `Integrator.retry` says: one-step methods
       with a new matrix for every correction, then with half the step

A lane that succeeds has the states of its smaller steps at the times of the others, and all of them for the adjoint
(`History.refined`).
Checked in tests/integrate/test_simulate.py, tests/integrate/test_contacts.py.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch

from torchmbd.integrate.contacts import MOST_SUBSTEPS, UnresolvedContact
from torchmbd.integrate.integrator import IntegrationResult, Integrator
from torchmbd.integrate.jumps import held_times_of, substeps_at
from torchmbd.integrate.lane_status import (
    IMPRECISE,
    STEP_STATISTICS,
    mark_open_joints,
    mark_unresolved_contacts,
    status_of_lanes,
    warn_unresolved,
)
from torchmbd.integrate.step_count import Trial, choose_steps
from torchmbd.multibody.system import Dynamics
from torchmbd.results.history import History, RefinedLane
from torchmbd.results.motion_data import has_failed

_MOST_NUMBERS = 2e8  # of a motion whose steps are made smaller for its contacts


@dataclass
class LaneResults:
    """History, statistics and status of lanes; `replaced`: lanes whose first motion gave way to a better one."""

    history: History
    statistics: dict[str, Any]
    status: list[str]
    replaced: list[int] = field(default_factory=list)

    def replace_lanes(self, lanes: Sequence[int], substeps: int, other: LaneResults) -> list[int]:
        """Put those lanes of another integration into this one that did not fail there; returns them.

        other   has these lanes only, `substeps` steps for each one here
        """
        pairs = [(source, lane) for source, lane in enumerate(lanes) if not has_failed(other.status[source])]
        if not pairs:
            return []
        sources, targets = (list(x) for x in zip(*pairs, strict=True))
        states = {}
        for name in ("q", "v", "vd", "lam"):
            new = getattr(other.history, name)[::substeps].index_select(-1, torch.tensor(sources))
            states[name] = getattr(self.history, name).index_copy(-1, torch.tensor(targets), new)
        refined = self.history.refined | _refined_lanes(other.history, substeps, pairs)
        self.history = replace(self.history, **states, refined=refined)
        self._replace_statistics(lanes, targets, sources, substeps, other.statistics)
        for source, lane in pairs:
            self.status[lane] = other.status[source]
        self.replaced += targets
        return targets

    def _replace_statistics(
        self, lanes: Sequence[int], targets: list[int], sources: list[int], substeps: int, other: Mapping[str, Any]
    ) -> None:
        """Take over the statistics of replaced lanes, and list them by how they were integrated again."""
        for name in (*STEP_STATISTICS, "tangent_error"):
            if name in self.statistics:
                self.statistics[name][targets] = other[name][sources]
        by_smaller_steps = {lanes[source] for source in other.get("halved", [])}.intersection(targets)
        halved = set(targets) if substeps > 1 else by_smaller_steps
        failed = {lane for lane in targets if has_failed(self.status[lane])}  # the others were imprecise
        self._list("halved", halved)
        self._list("renewed", set(targets) - halved)
        self._list("failed_first", failed.union(lanes[source] for source in other.get("failed_first", [])))

    def _list(self, name: str, lanes: Iterable[int]) -> None:
        """Add lanes to a sorted list among the statistics."""
        self.statistics[name] = sorted({*self.statistics.get(name, []), *lanes})


def _refined_lanes(history: History, substeps: int, pairs: Sequence[tuple[int, int]]) -> dict[int, RefinedLane]:
    """Where the steps of lanes are found that this history has as `pairs` (its lane, lane of the batch)."""
    result = {}
    for source, lane in pairs:
        if source in history.refined:
            deeper = history.refined[source]
            result[lane] = deeper._replace(substeps=deeper.substeps * substeps)
        elif substeps > 1 or history.checkpoints:
            result[lane] = RefinedLane(history, source, substeps)
    return result


def integrate_lanes(
    integrator: Integrator,
    dynamics: Dynamics,
    duration: float,
    steps: int,
    with_gradients: bool,
    first: IntegrationResult | None = None,
    substeps: int = 1,
) -> LaneResults:
    """The motion of all lanes by equal steps; see the module header.

    with_gradients   lanes whose iteration is imprecise are integrated again as well
    first            the first integration, where it was made before
    substeps         how many of these steps stand already for one that the caller asked for
    """
    first = first or integrator.integrate(dynamics, duration, steps)
    statistics, retry = first.statistics, integrator.retry()
    status = status_of_lanes(first.history, duration, statistics, first.failed)
    mark_open_joints(status, dynamics, first.history, duration, statistics)
    imprecise = torch.zeros(len(status), dtype=torch.bool)
    if with_gradients and retry is not None and retry.substeps == 1:
        imprecise = statistics["iteration_error"] > IMPRECISE
    for lane, reason in dynamics.start_errors.items():  # no initial state: no time has numbers
        status[lane] = f"failed: {reason}"
        statistics.setdefault("valid_times", torch.full((len(status),), len(first.history.q)))[lane] = 0
    contacts = {lane: contact for lane, contact in first.contacts.items() if not has_failed(status[lane])}
    to_retry = [
        lane
        for lane, reason in enumerate(status)
        if (has_failed(reason) or imprecise[lane]) and lane not in dynamics.start_errors and lane not in contacts
    ]
    results = LaneResults(first.history, statistics, status)
    finer, lanes = _substeps_for_contacts(integrator, dynamics, steps, substeps, contacts), list(contacts)
    held = substeps_at(held_times_of(dynamics, duration), duration, steps) if integrator.refines else None
    if held is not None and held > 1:  # contacts are looked at again, in these steps
        finer, lanes = held, [lane for lane in range(len(status)) if lane not in dynamics.start_errors]
    if finer > 1 and lanes:
        other = integrate_lanes(
            integrator, dynamics.select_lanes(lanes), duration, finer * steps, with_gradients, substeps=finer * substeps
        )
        for lane in results.replace_lanes(lanes, finer, other):
            contacts.pop(lane, None)
        to_retry = [lane for lane in to_retry if lane not in results.replaced]
    mark_unresolved_contacts(results.status, contacts)
    if to_retry and retry is not None:
        other = integrate_lanes(
            retry.integrator,
            dynamics.select_lanes(to_retry),
            duration,
            retry.substeps * steps,
            with_gradients,
            substeps=substeps,
        )
        results.replace_lanes(to_retry, retry.substeps, other)
    warn_unresolved([reason for lane, reason in enumerate(results.status) if lane not in results.replaced])
    return results


def _substeps_for_contacts(
    integrator: Integrator, dynamics: Dynamics, steps: int, substeps: int, contacts: Mapping[int, UnresolvedContact]
) -> int:
    """How many steps stand for one in lanes with contacts that the steps do not show; 1: no more steps."""
    if not contacts or not integrator.refines:
        return 1
    finer = min(max(contact.substeps for contact in contacts.values()), MOST_SUBSTEPS // substeps)
    T = dynamics.topology
    numbers = steps * (T.n_q + 2 * T.n_v + T.rows) * (1 + dynamics.tangents) * len(contacts)
    while finer > 1 and finer * numbers > _MOST_NUMBERS:
        finer //= 2
    return max(finer, 1)


def integrate_by_chosen_steps(
    integrator: Integrator,
    dynamics: Dynamics,
    duration: float,
    with_gradients: bool,
    check_memory: Callable[[int], None],
) -> tuple[int, LaneResults]:
    """The number of steps that the motion needs (step_count.py), and the motion of all lanes by these.

    check_memory   raises InputError for a number of steps that does not fit into memory
    """
    values = dynamics.values() if dynamics.tangents else dynamics

    def integrate(steps: int) -> Trial[IntegrationResult]:
        found = integrator.integrate(values, duration, steps)
        status = status_of_lanes(found.history, duration, found.statistics, found.failed)
        return Trial(found, found.statistics, status, found.contacts)

    steps, found = choose_steps(integrator, values, duration, integrate, check_memory)
    first = None if dynamics.tangents else found  # a motion of values alone has no tangents
    return steps, integrate_lanes(integrator, dynamics, duration, steps, with_gradients, first)
