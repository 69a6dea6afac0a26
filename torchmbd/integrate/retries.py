"""Integration of lanes that fail alone: a lane that fails is integrated again, the others keep their motion.

    1. all lanes, by the steps asked for
    2. lanes with contacts that these steps do not show, each by the smaller steps that it needs itself (contacts.py); all
       lanes where held values of a controller change within a step (jumps.py)
    3. lanes that failed, as `Integrator.retry` says: one-step methods with a new matrix for every correction, then with half
       the step

It is the same for motions of one segment and of several (initial_value.py).
A lane that succeeds has the states of its smaller steps at the times of the others, and all of them for the adjoint
(`History.refined`). Of a lane that fails in all of them the motion counts that gets furthest, of equal ones the last: what it
reports is not that iterations were too few or steps too long.
Checked in tests/integrate/test_simulate.py, tests/integrate/test_contacts.py, tests/integrate/phases/test_retries.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch

from torchmbd.integrate.contacts import MOST_SUBSTEPS, UnresolvedContact
from torchmbd.integrate.held_times import substeps_at
from torchmbd.integrate.initial_value import InitialValueProblem
from torchmbd.integrate.integrator import IntegrationResult, Integrator, Steps
from torchmbd.integrate.lane_status import (
    mark_doubts,
    mark_open_joints,
    mark_unresolved_contacts,
    status_of_lanes,
    validity,
    warn_unresolved,
)
from torchmbd.integrate.lanes import pick_lanes, put_lanes
from torchmbd.integrate.statistics import Statistics
from torchmbd.multibody.equations.data import ATTACHED, Data
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.results.history import History, RefinedLane
from torchmbd.results.motion_data import Switch, has_failed

_MOST_NUMBERS = 2e7  # of the states of one lane whose steps are made smaller for its contacts


@dataclass
class LaneResults:
    """History, statistics, status, switches and data of lanes, as in IntegrationResult.

    replaced   lanes whose first motion gave way to a better one, and how that was made
    """

    history: History
    statistics: Statistics
    status: list[str]
    switches: list[Switch] = field(default_factory=list)
    data: Data | None = None
    replaced: dict[int, Steps] = field(default_factory=dict)

    def replace_lanes(self, lanes: Sequence[int], by: Steps, other: LaneResults) -> list[int]:
        """Put those lanes of another integration into this one that failed there no more, or later; returns them.

        other   has these lanes only, integrated `by` other steps
        """
        substeps = by.substeps
        reached, reached_there = (validity(x.history, x.status, x.statistics)[0, 0] for x in (self, other))
        further = (reached_there - 1.0) / substeps >= reached[list(lanes)] - 1.0
        pairs = [
            (source, lane)
            for source, lane in enumerate(lanes)
            if not has_failed(other.status[source]) or (has_failed(self.status[lane]) and further[source])
        ]
        if not pairs:
            return []
        sources, targets = (list(x) for x in zip(*pairs, strict=True))
        source_lanes, target_lanes = torch.tensor(sources), torch.tensor(targets)
        states = {}
        for name in ("q", "v", "vd", "lam", "segment"):
            if getattr(self.history, name) is not None:
                new = getattr(other.history, name)[::substeps].index_select(-1, source_lanes)
                states[name] = getattr(self.history, name).index_copy(-1, target_lanes, new)
        sound = [(source, lane) for source, lane in pairs if not has_failed(other.status[source])]
        refined = self.history.refined | _refined_lanes(other.history, substeps, sound)
        self.history = replace(self.history, **states, refined=refined)
        both = zip(self.switches, other.switches, strict=True)
        self.switches = [switch.with_lanes(target_lanes, new, source_lanes) for switch, new in both]
        if self.data is not None and other.data is not None:
            self.data = self.data | {
                name: put_lanes(self.data[name], targets, pick_lanes(other.data[name], sources))
                for name in ATTACHED
                if name in self.data and self.data[name].shape[-1] == len(self.status)
            }
        self._replace_statistics(lanes, targets, sources, substeps, other.statistics)
        for source, lane in pairs:
            self.status[lane] = other.status[source]
            deeper = other.replaced.get(source, Steps(by.integrator, 1))
            self.replaced[lane] = Steps(deeper.integrator, deeper.substeps * substeps)
        return targets

    def _replace_statistics(
        self, lanes: Sequence[int], targets: list[int], sources: list[int], substeps: int, other: Statistics
    ) -> None:
        """Take over the statistics of replaced lanes, and list them by how they were integrated again."""
        self.statistics.replace_lanes(targets, other, sources, substeps, len(self.status))
        by_smaller_steps = {lanes[source] for source in other.halved or []}.intersection(targets)
        halved = set(targets) if substeps > 1 else by_smaller_steps
        failed = {lane for lane in targets if has_failed(self.status[lane])}
        self.statistics.note("halved", halved)
        self.statistics.note("renewed", set(targets) - halved)
        self.statistics.note("failed_first", failed.union(lanes[source] for source in other.failed_first or []))


def _refined_lanes(history: History, substeps: int, pairs: Sequence[tuple[int, int]]) -> dict[int, RefinedLane]:
    """Where the steps of lanes are found that this history has as `pairs` (its lane, lane of the batch)."""
    result = {}
    for source, lane in pairs:
        if source in history.refined:
            deeper = history.refined[source]
            result[lane] = deeper._replace(substeps=deeper.substeps * substeps)
        else:
            result[lane] = RefinedLane(history, source, substeps)
    return result


def integrate_lanes(
    integrator: Integrator,
    problem: InitialValueProblem,
    steps: int,
    first: IntegrationResult | None = None,
    substeps: int = 1,
) -> LaneResults:
    """The motion of all lanes by equal steps; see the module header.

    first      the first integration, where it was made before
    substeps   how many of these steps stand already for one that the caller asked for
    """
    first = first or problem.integrate(integrator, steps)
    dynamics, duration, statistics, retry = problem.dynamics, problem.duration, first.statistics, integrator.retry()
    status = status_of_lanes(first.history, duration, statistics, first.sizes, first.failed)
    mark_open_joints(status, problem, first)
    for lane, reason in dynamics.start_errors.items():  # no initial state: no time has numbers
        status[lane] = f"failed: {reason}"
        if statistics.valid_times is None:
            statistics.valid_times = torch.full((len(status),), len(first.history.q))
        statistics.valid_times[lane] = 0
    contacts = {lane: contact for lane, contact in first.contacts.items() if not has_failed(status[lane])}
    to_retry = [
        lane
        for lane, reason in enumerate(status)
        if has_failed(reason) and lane not in {*dynamics.start_errors, *contacts, *first.for_good}
    ]
    results = LaneResults(first.history, statistics, status, first.switches, first.data)
    finer = _lanes_by_substeps(integrator, dynamics, steps, substeps, contacts)
    held = substeps_at(problem.held_times(), duration, steps) if integrator.refines else None
    if held is not None and held > 1:  # contacts are looked at again, in these steps
        finer = {held: [lane for lane in range(len(status)) if lane not in dynamics.start_errors]}
    for count, lanes in finer.items():
        if not lanes:
            continue
        other = integrate_lanes(integrator, problem.select_lanes(lanes), count * steps, substeps=count * substeps)
        for lane in results.replace_lanes(lanes, Steps(integrator, count), other):
            contacts.pop(lane, None)
    to_retry = [lane for lane in to_retry if lane not in results.replaced]
    mark_doubts(results.status, {lane: x for lane, x in first.doubts.items() if lane not in results.replaced})
    mark_unresolved_contacts(results.status, contacts)
    if to_retry and retry is not None:
        other = integrate_lanes(
            retry.integrator,
            problem.select_lanes(to_retry),
            retry.substeps * steps,
            substeps=retry.substeps * substeps,
        )
        results.replace_lanes(to_retry, retry, other)
    warn_unresolved([reason for lane, reason in enumerate(results.status) if lane not in results.replaced])
    return results


def integrate_again(
    results: LaneResults, problem: InitialValueProblem, integrator: Integrator, steps: int
) -> LaneResults:
    """A motion with the same values as `results` by the steps that each of its lanes took in the end: states and switches."""
    groups: dict[Steps, list[int]] = {}
    for lane in range(len(results.status)):
        groups.setdefault(results.replaced.get(lane, Steps(integrator, 1)), []).append(lane)
    whole: LaneResults | None = None
    for by, lanes in groups.items():
        part = problem.select_lanes(lanes).integrate(by.integrator, by.substeps * steps)
        errors = Statistics(tangent_error=part.statistics.tangent_error)
        other = LaneResults(part.history, errors, [results.status[k] for k in lanes], part.switches, part.data)
        if whole is None:
            whole = _spread(other, lanes, by.substeps, results.status)
        whole.replace_lanes(lanes, by, other)
    assert whole is not None
    return whole


def _spread(results: LaneResults, lanes: Sequence[int], substeps: int, status: Sequence[str]) -> LaneResults:
    """Results of some lanes as those of all that have a status, at fewer times: the others have any numbers."""
    index = torch.zeros(len(status), dtype=torch.long)
    index[list(lanes)] = torch.arange(len(lanes))
    h, every = results.history, slice(None, None, substeps)
    q, v, vd, lam = (x[every].index_select(-1, index) for x in h.states)
    segment = None if h.segment is None else h.segment[every].index_select(-1, index)
    history = replace(h, q=q, v=v, vd=vd, lam=lam, segment=segment, refined={})
    data = results.data
    if data is not None:
        marks = {name: x for name, x in data.items() if name in ATTACHED and x.shape[-1] == len(lanes)}
        data = data | {name: pick_lanes(x, index.tolist()) for name, x in marks.items()}
    switches = [x.of_lanes(index) for x in results.switches]
    return LaneResults(history, results.statistics.of_lanes(index), list(status), switches, data)


def _lanes_by_substeps(
    integrator: Integrator, dynamics: Dynamics, steps: int, substeps: int, contacts: Mapping[int, UnresolvedContact]
) -> dict[int, list[int]]:
    """Lanes with contacts that the steps do not show, by how many steps stand for one; those without finer ones have none.

    A lane decides for itself: its steps depend neither on other lanes nor on tangents.
    """
    groups: dict[int, list[int]] = {}
    T = dynamics.topology
    most = min(MOST_SUBSTEPS // substeps, int(_MOST_NUMBERS / (steps * (T.n_q + 2 * T.n_v + T.rows))))
    for lane, contact in contacts.items() if integrator.refines else ():
        finer = contact.substeps
        while finer > most:
            finer //= 2
        if finer > 1:
            groups.setdefault(finer, []).append(lane)
    return groups
