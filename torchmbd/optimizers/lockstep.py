"""Many starts side by side, so that their simulations are one batch.

Every start runs its own optimizer in its own thread and blocks where it asks for an evaluation. The coordinator, in
the caller's thread, evaluates all requests as one batch (those with gradients, those without), and hands the answers
back, one start after the other: each goes on until it asks again or ends, then the next, since threads that compute at
once would only fight for the interpreter. A start that ends makes room for the next. So a batch depends
on the starts alone, in their order, never on timing; the problem, the callback and the user's Ctrl-C live in the
caller's thread.

A thread here only waits or does small arithmetic between two simulations: parallel computation is the problem's affair.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from torchmbd.errors import InputError
from torchmbd.optimizers.optimizer import Evaluation, Iterate, OptimizationResult, Problem
from torchmbd.optimizers.search import Ask, Interrupted, Report, Search

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


class Lockstep:
    """Runs `runners` (one per start), `max_lanes` at once; `go_on(results)` is asked before each further start.

    `callback` hears of every iterate, `ended` of every result, as they come.
    """

    def __init__(
        self,
        problem: Problem,
        runners: list[Runner],
        max_lanes: int,
        callback: Callable[[Iterate], None] | None = None,
        go_on: Callable[[list[OptimizationResult]], bool] = lambda results: True,
        ended: Callable[[OptimizationResult], None] | None = None,
    ) -> None:
        self.problem, self.runners, self.max_lanes = problem, runners, max_lanes
        self.callback, self.go_on, self.ended = callback, go_on, ended
        self.results: list[OptimizationResult] = []
        self.interrupted = False
        self.stopped_early = False
        self._back = threading.Semaphore(0)  # the start whose turn it was has asked or ended
        self._live: list[Lane] = []
        self._next = 0

    def run(self) -> list[OptimizationResult]:
        """Run all starts; return their results in the order of the starts (after Ctrl-C: of those begun)."""
        try:
            self._launch()
            while self._live:
                self._report()
                self._collect()
                self._launch()
                self._answer()
        except KeyboardInterrupt:
            self.interrupted = True
            self._stop_all()
            self._report()
            self._collect()
        except BaseException:
            self._stop_all()
            raise
        return sorted(self.results, key=lambda result: result.start)

    def _launch(self) -> None:
        while len(self._live) < self.max_lanes and self._next < len(self.runners):
            if self.results and not self.go_on(self.results):
                self.stopped_early = True
                return
            lane = Lane(self._next)
            lane.thread = threading.Thread(target=self._work, args=(lane,), name=f"start-{lane.index}", daemon=True)
            self._live.append(lane)
            self._next += 1
            lane.thread.start()
            self._back.acquire()

    def _report(self) -> None:
        for lane in self._live:
            reports, lane.reports = lane.reports, []
            for iterate in reports:
                if self.callback is not None:
                    self.callback(iterate)

    def _collect(self) -> None:
        for lane in [lane for lane in self._live if lane.ended]:
            self._live.remove(lane)
            if lane.error is not None:
                raise lane.error
            assert lane.result is not None
            self.results.append(lane.result)
            if self.ended is not None:
                self.ended(lane.result)

    def _answer(self) -> None:
        asking = [lane for lane in self._live if lane.request is not None]
        answers: dict[int, list[Evaluation]] = {}
        for gradients in (True, False):
            group = [lane for lane in asking if lane.request is not None and lane.request[1] is gradients]
            if not group:
                continue
            requests = [lane.request[0] for lane in group if lane.request is not None]
            evaluations = self._evaluate(np.concatenate(requests), gradients)
            for lane, request in zip(group, requests, strict=True):
                answers[lane.index] = [next(evaluations) for _ in request]
        for lane in asking:
            lane.request, lane.answer = None, answers[lane.index]
            lane.turn.release()
            self._back.acquire()

    def _evaluate(self, X: np.ndarray, gradients: bool) -> Iterator[Evaluation]:
        """Evaluate designs [k, n], at most `max_lanes` in one batch."""
        for first in range(0, len(X), self.max_lanes):
            batch = X[first : first + self.max_lanes]
            evaluations = self.problem.evaluate(batch, gradients)
            if len(evaluations) != len(batch):
                raise InputError(f"problem.evaluate returned {len(evaluations)} evaluations for {len(batch)} designs")
            yield from evaluations

    def _stop_all(self) -> None:
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


def side_by_side(
    problem: Any,
    searches: Sequence[Callable[[int, Ask, Report], Search]],
    run_one: Callable[[Search], OptimizationResult],
    max_lanes: int,
) -> tuple[list[OptimizationResult | None], bool]:
    """Run one optimizer on different searches of the same designs; return the feasible results and whether interrupted.

    None stands for a search that found no feasible design, or was interrupted.
    """

    def runner(index: int, ask: Ask, report: Report) -> OptimizationResult:
        return run_one(searches[index](index, ask, report))

    lockstep = Lockstep(problem, [partial(runner, k) for k in range(len(searches))], max_lanes, None)
    ends: list[OptimizationResult | None] = [None] * len(searches)
    for result in lockstep.run():
        if result.status not in ("failed", "infeasible", "interrupted"):
            ends[result.start] = result
    return ends, lockstep.interrupted
