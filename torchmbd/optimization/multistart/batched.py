"""Many starts at the same time: their simulations are one batch.

The optimizer of every start runs in a thread of its own, which waits whenever it asks for an evaluation. The caller's thread
evaluates all requests in common batches (those with gradients, those without), and then answers one start after the other:
each computes until it asks again or ends, before the next is answered, since Python threads that compute at once slow each
other down. When a start ends, a waiting one begins. So a batch depends on the starts and their order alone, never on timing;
the problem, the callback and Ctrl-C stay in the caller's thread.

If the problem evaluates several batches in parallel, on workers (batch.py), the starts are divided into as many groups, start
k into group k modulo their number; into up to twice as many, as long as each has starts for half a batch. While the
optimizers of one group compute, the batch of another is ready for the workers. What is in a batch then depends on the number
of workers as well.

Threads do only small arithmetic between two simulations; simulations run in parallel only if the problem sees to it.
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

from torchmbd.optimization.batch import Batch, begin_batch, wrong_count
from torchmbd.optimization.optimizer import Evaluation, Iterate, NonlinearProgram, OptimizationResult
from torchmbd.optimization.search import EvaluateBatch, Interrupted, Report, Search

Runner = Callable[[EvaluateBatch, Report], OptimizationResult]


@dataclass
class LiveStart:
    """A start whose optimizer is running: its request, the answer to it, and how it ended."""

    index: int
    request: tuple[np.ndarray, bool] | None = None  # designs [k, n], with gradients
    answer: list[Evaluation] | None = None
    reports: list[Iterate] = field(default_factory=list)
    result: OptimizationResult | None = None
    error: BaseException | None = None
    thread: threading.Thread | None = None
    resume: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(0))  # released when it is answered

    @property
    def ended(self) -> bool:
        return self.result is not None or self.error is not None


@dataclass
class Group:
    """Starts whose requests are evaluated together."""

    waiting: deque[int]  # indices of starts
    width: int  # live starts at most
    live: list[LiveStart] = field(default_factory=list)
    requests: list[tuple[LiveStart, int]] = field(default_factory=list)  # number of designs, in the order of the parts
    parts: deque[tuple[np.ndarray, bool]] = field(default_factory=deque)  # designs of the batches to be evaluated
    batch: Batch | None = None  # under evaluation: the first part
    evaluations: list[Evaluation] = field(default_factory=list)  # of the parts that are done


class BatchedSearches:
    """Runs many starts in common batches.

    runners    one for each start
    max_lanes  designs in a batch, and starts that run at the same time, at most
    callback   called with every iterate
    may_begin  called with the results so far before each further start; False: no start begins any more
    ended      called with every result
    groups     batches that the problem evaluates in parallel
    """

    def __init__(
        self,
        problem: NonlinearProgram,
        runners: list[Runner],
        max_lanes: int,
        callback: Callable[[Iterate], None] | None = None,
        may_begin: Callable[[list[OptimizationResult]], bool] = lambda results: True,
        ended: Callable[[OptimizationResult], None] | None = None,
        groups: int = 1,
    ) -> None:
        self.problem, self.runners = problem, runners
        self.callback, self.may_begin, self.ended = callback, may_begin, ended
        self.results: list[OptimizationResult] = []
        self.interrupted = False
        self.stopped_early = False
        self._returned = threading.Semaphore(0)  # released when a start that was begun or answered waits or has ended
        parallel = max(1, min(groups, max_lanes, len(runners)))
        width = max_lanes // parallel
        count = 1 if parallel == 1 else max(parallel, min(2 * parallel, 2 * len(runners) // width))
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
                    self._complete_part(group, group.batch)
        except KeyboardInterrupt:
            self.interrupted = True
            self._stop_all()
            for group in self._groups:
                self._collect_reports(group)
        except BaseException:
            self._stop_all()
            raise
        return sorted(self.results, key=lambda result: result.start)

    @property
    def _live(self) -> list[LiveStart]:
        return [start for group in self._groups for start in group.live]

    def _advance(self, group: Group) -> None:
        """Report iterates and results of a group, begin waiting starts, and begin to evaluate what is requested."""
        self._collect_reports(group)
        while self._launch(group):
            self._collect_reports(group)
        self._collect_requests(group)

    def _collect_reports(self, group: Group) -> None:
        for start in group.live:
            reports, start.reports = start.reports, []
            for iterate in reports:
                if self.callback is not None:
                    self.callback(iterate)
        for start in [start for start in group.live if start.ended]:
            group.live.remove(start)
            if start.error is not None:
                raise start.error
            assert start.result is not None
            self.results.append(start.result)
            if self.ended is not None:
                self.ended(start.result)

    def _launch(self, group: Group) -> bool:
        """Begin waiting starts up to the width of the group; return whether one began."""
        began = False
        while len(group.live) < group.width and group.waiting:
            if self.results and not self.may_begin(self.results):
                self.stopped_early = True
                break
            start = LiveStart(group.waiting.popleft())
            start.thread = threading.Thread(target=self._work, args=(start,), name=f"start-{start.index}", daemon=True)
            group.live.append(start)
            start.thread.start()
            self._returned.acquire()
            began = True
        return began

    def _collect_requests(self, group: Group) -> None:
        """Divide the requests of a group into batches, designs with gradients first, and begin to evaluate."""
        for gradients in (True, False):
            asking = [start for start in group.live if start.request is not None and start.request[1] is gradients]
            if not asking:
                continue
            requests = [start.request[0] for start in asking if start.request is not None]
            group.requests += [(start, len(request)) for start, request in zip(asking, requests, strict=True)]
            X = np.concatenate(requests)
            group.parts += [(X[first : first + group.width], gradients) for first in range(0, len(X), group.width)]
        self._begin(group)

    def _begin(self, group: Group) -> None:
        if group.parts:
            group.batch = begin_batch(self.problem, *group.parts[0], len(self._groups))
            group.batch.notify(partial(self._ready.put, group))

    def _complete_part(self, group: Group, batch: Batch) -> None:
        """Keep the evaluations of a batch, and begin the next part or answer the starts."""
        evaluations = batch.evaluations()
        (designs, _), group.batch = group.parts.popleft(), None
        if len(evaluations) != len(designs):
            raise wrong_count(evaluations, designs)
        group.evaluations += evaluations
        if group.parts:
            self._begin(group)
            return
        requests, group.requests = group.requests, []
        answers, group.evaluations = iter(group.evaluations), []
        for start, count in requests:  # one after the other: each computes until it asks again or ends
            start.request, start.answer = None, [next(answers) for _ in range(count)]
            start.resume.release()
            self._returned.acquire()
        self._advance(group)

    def _stop_all(self) -> None:
        for group in self._groups:
            if group.batch is not None:
                group.batch.cancel()
        for start in self._live:
            start.resume.release()  # without an answer: it is interrupted
        for start in self._live:
            if start.thread is not None:
                start.thread.join()

    def _work(self, start: LiveStart) -> None:
        """Run the optimizer of a start, in its thread; keep its result or its error."""

        def evaluate_batch(X: np.ndarray, gradients: bool) -> list[Evaluation]:
            start.request = X, gradients
            self._returned.release()
            start.resume.acquire()
            if start.answer is None:
                raise Interrupted
            answer, start.answer = start.answer, None
            return answer

        result, error = None, None
        try:
            result = self.runners[start.index](evaluate_batch, lambda iterate: start.reports.append(iterate))
        except BaseException as exception:
            error = exception
        start.result, start.error = result, error
        self._returned.release()


def run_batched(
    problem: Any,
    searches: Sequence[Callable[[int, EvaluateBatch, Report], Search]],
    run_one: Callable[[Search], OptimizationResult],
    max_lanes: int,
    ended: Callable[[OptimizationResult], None] | None = None,
) -> tuple[list[OptimizationResult | None], bool]:
    """Run one optimizer on several searches of the same problem; return their results, and whether the user stopped them.

    searches  functions of (index, evaluate_batch, report) that make the searches
    run_one   runs the optimizer on a search
    ended     called with every result

    A search that failed, found no feasible design, or was interrupted has None as its result.
    """

    def runner(index: int, evaluate_batch: EvaluateBatch, report: Report) -> OptimizationResult:
        return run_one(searches[index](index, evaluate_batch, report))

    batched = BatchedSearches(problem, [partial(runner, k) for k in range(len(searches))], max_lanes, ended=ended)
    ends: list[OptimizationResult | None] = [None] * len(searches)
    for result in batched.run():
        if result.status not in ("failed", "infeasible", "interrupted"):
            ends[result.start] = result
    return ends, batched.interrupted
