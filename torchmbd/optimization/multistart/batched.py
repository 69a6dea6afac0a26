"""Many starts at the same time, so that their simulations are one batch.

Every start runs its own optimizer in its own thread and blocks where it asks for an evaluation. The coordinator, in
the caller's thread, evaluates all requests as one batch (those with gradients, those without), and hands the answers
back, one start after the other: each goes on until it asks again or ends, then the next, since threads that compute at
once would only fight for the interpreter. A start that ends makes room for the next. So a batch depends
on the starts alone, in their order, never on timing; the problem, the callback and the user's Ctrl-C live in the
caller's thread.

A problem that evaluates several batches at once, on workers (batch.py), gets as many groups of starts, dealt out in turn, and
up to twice as many where that leaves each starts for half a batch: no worker waits for another, nor for the optimizers, since
while those of one group think, the batch of another is at hand. What is in a batch still depends on the starts alone, and on
the number of workers.

A thread here only waits or does small arithmetic between two simulations: parallel computation is the problem's affair.
Checked in tests/optimization/multistart/test_batched.py.
"""

from __future__ import annotations

import queue
import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from torchmbd.errors import InputError
from torchmbd.optimization.batch import Batch, begin
from torchmbd.optimization.optimizer import Evaluation, Iterate, OptimizationResult, Problem
from torchmbd.optimization.search import Ask, Interrupted, Report, Search

Runner = Callable[[Ask, Report], OptimizationResult]


@dataclass
class Lane:
    """One live start: what it asks for, what it was answered, how it ended."""

    index: int
    request: tuple[np.ndarray, bool] | None = None  # designs [k, n], with gradients
    answer: list[Evaluation] | None = None
    reports: list[Iterate] = field(default_factory=list)
    result: OptimizationResult | None = None
    error: BaseException | None = None
    thread: threading.Thread | None = None
    turn: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(0))

    @property
    def ended(self) -> bool:
        return self.result is not None or self.error is not None


@dataclass
class Group:
    """Starts whose requests are evaluated together."""

    to_come: deque[int]  # indices of starts
    width: int  # live starts at most
    live: list[Lane] = field(default_factory=list)
    asked: list[tuple[Lane, int]] = field(default_factory=list)  # who asked for how many designs, in the parts' order
    parts: deque[tuple[np.ndarray, bool]] = field(
        default_factory=deque
    )  # designs to evaluate, one batch after the other
    batch: Batch | None = None  # under way: the first part
    found: list[Evaluation] = field(default_factory=list)  # of the parts that are done


class BatchedSearches:
    """Runs `runners` (one per start), `max_lanes` at once; `go_on(results)` is asked before each further start.

    `callback` hears of every iterate, `ended` of every result, as they come. `groups` of starts, each of its own pace.
    """

    def __init__(
        self,
        problem: Problem,
        runners: list[Runner],
        max_lanes: int,
        callback: Callable[[Iterate], None] | None = None,
        go_on: Callable[[list[OptimizationResult]], bool] = lambda results: True,
        ended: Callable[[OptimizationResult], None] | None = None,
        groups: int = 1,
    ) -> None:
        self.problem, self.runners = problem, runners
        self.callback, self.go_on, self.ended = callback, go_on, ended
        self.results: list[OptimizationResult] = []
        self.interrupted = False
        self.stopped_early = False
        self._back = threading.Semaphore(0)  # the start whose turn it was has asked or ended
        at_once = max(1, min(groups, max_lanes, len(runners)))
        width = max_lanes // at_once
        count = 1 if at_once == 1 else max(at_once, min(2 * at_once, 2 * len(runners) // width))
        self._groups = [Group(deque(range(k, len(runners), count)), width) for k in range(count)]
        self._ready: queue.SimpleQueue[Group] = queue.SimpleQueue()  # groups whose batches may be done

    def run(self) -> list[OptimizationResult]:
        """Run all starts; return their results in the order of the starts (after Ctrl-C: of those begun)."""
        try:
            for group in self._groups:
                self._advance(group)
            while self._live:
                group = self._ready.get()
                if group.batch is not None and group.batch.done:
                    self._take(group, group.batch)
        except KeyboardInterrupt:
            self.interrupted = True
            self._stop_all()
            for group in self._groups:
                self._hear(group)
        except BaseException:
            self._stop_all()
            raise
        return sorted(self.results, key=lambda result: result.start)

    @property
    def _live(self) -> list[Lane]:
        return [lane for group in self._groups for lane in group.live]

    def _advance(self, group: Group) -> None:
        """Hear what the starts of a group have come to, begin others in the place of those that ended, and evaluate."""
        self._hear(group)
        while self._launch(group):
            self._hear(group)
        self._ask(group)

    def _hear(self, group: Group) -> None:
        for lane in group.live:
            reports, lane.reports = lane.reports, []
            for iterate in reports:
                if self.callback is not None:
                    self.callback(iterate)
        for lane in [lane for lane in group.live if lane.ended]:
            group.live.remove(lane)
            if lane.error is not None:
                raise lane.error
            assert lane.result is not None
            self.results.append(lane.result)
            if self.ended is not None:
                self.ended(lane.result)

    def _launch(self, group: Group) -> bool:
        """Begin starts while there is room; return whether one began."""
        began = False
        while len(group.live) < group.width and group.to_come:
            if self.results and not self.go_on(self.results):
                self.stopped_early = True
                break
            lane = Lane(group.to_come.popleft())
            lane.thread = threading.Thread(target=self._work, args=(lane,), name=f"start-{lane.index}", daemon=True)
            group.live.append(lane)
            lane.thread.start()
            self._back.acquire()
            began = True
        return began

    def _ask(self, group: Group) -> None:
        """Evaluate all that a group asks for: designs with gradients, then those without, `width` in one batch at most."""
        for gradients in (True, False):
            asking = [lane for lane in group.live if lane.request is not None and lane.request[1] is gradients]
            if not asking:
                continue
            requests = [lane.request[0] for lane in asking if lane.request is not None]
            group.asked += [(lane, len(request)) for lane, request in zip(asking, requests, strict=True)]
            X = np.concatenate(requests)
            group.parts += [(X[first : first + group.width], gradients) for first in range(0, len(X), group.width)]
        self._begin(group)

    def _begin(self, group: Group) -> None:
        if group.parts:
            group.batch = begin(self.problem, *group.parts[0], len(self._groups))
            group.batch.notify(partial(self._ready.put, group))

    def _take(self, group: Group, batch: Batch) -> None:
        """Keep what a batch has found, and begin the next part or go on with the starts."""
        evaluations = batch.evaluations()
        (designs, _), group.batch = group.parts.popleft(), None
        if len(evaluations) != len(designs):
            raise InputError(f"problem.evaluate returned {len(evaluations)} evaluations for {len(designs)} designs")
        group.found += evaluations
        if group.parts:
            self._begin(group)
        else:
            self._answer(group)
            self._advance(group)

    def _answer(self, group: Group) -> None:
        """Give the starts of a group what they asked for; each goes on until it asks again or ends."""
        asked, group.asked = group.asked, []
        answers, group.found = iter(group.found), []
        for lane, count in asked:
            lane.request, lane.answer = None, [next(answers) for _ in range(count)]
            lane.turn.release()
            self._back.acquire()

    def _stop_all(self) -> None:
        for group in self._groups:
            if group.batch is not None:
                group.batch.cancel()
        for lane in self._live:
            lane.turn.release()  # and there is no answer
        for lane in self._live:
            if lane.thread is not None:
                lane.thread.join()

    def _work(self, lane: Lane) -> None:
        """What a thread does: run one start, leaving its result or its error in the lane."""

        def ask(X: np.ndarray, gradients: bool) -> list[Evaluation]:
            lane.request = X, gradients
            self._back.release()
            lane.turn.acquire()
            if lane.answer is None:
                raise Interrupted
            answer, lane.answer = lane.answer, None
            return answer

        result, error = None, None
        try:
            result = self.runners[lane.index](ask, lambda iterate: lane.reports.append(iterate))
        except BaseException as exception:
            error = exception
        lane.result, lane.error = result, error
        self._back.release()


def run_batched(
    problem: Any,
    searches: Sequence[Callable[[int, Ask, Report], Search]],
    run_one: Callable[[Search], OptimizationResult],
    max_lanes: int,
    ended: Callable[[OptimizationResult], None] | None = None,
) -> tuple[list[OptimizationResult | None], bool]:
    """Run one optimizer on different searches of the same designs; return the feasible results and whether interrupted.

    `ended` hears of every result as it comes. None stands for a search that found no feasible design, or was interrupted.
    """

    def runner(index: int, ask: Ask, report: Report) -> OptimizationResult:
        return run_one(searches[index](index, ask, report))

    batched = BatchedSearches(problem, [partial(runner, k) for k in range(len(searches))], max_lanes, ended=ended)
    ends: list[OptimizationResult | None] = [None] * len(searches)
    for result in batched.run():
        if result.status not in ("failed", "infeasible", "interrupted"):
            ends[result.start] = result
    return ends, batched.interrupted
