"""Blocks of lanes on threads: compiled code and operators of torch release the lock of Python, so that several run at once.

    piece     a range of blocks (or lanes); a thread takes the next piece when it has finished one
    scratch   memory of a thread, used again by each of its pieces
    group     at most GROUP lanes, whose operators of torch run together

A block depends on no other and a thread changes nothing but its blocks, so that results have the same bits with any number of
threads. Groups follow from the number of lanes alone, for the same reason. The calling thread takes pieces, too: where all
others are busy, it makes all of them. A piece that shares its own work divides the threads which its team leaves.
Checked in tests/math/test_threads.py, tests/extensions/native/test_threads.py.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from itertools import pairwise
from typing import Any, TypeVar

import torch

from torchmbd.process import cores, thread_count

PIECES = 4  # for each thread, so that none waits long for the last piece
GROUP = 16  # lanes whose operators of torch stay in the cache of a processor, and share the cost of a call
_team = threading.local()  # threads: those that a piece may use, while one runs

Result = TypeVar("Result")


@cache
def _pool() -> ThreadPoolExecutor:
    """The threads of this process, started when they are needed."""
    return ThreadPoolExecutor(max(cores(), thread_count()), thread_name_prefix="torchmbd")


os.register_at_fork(after_in_child=_pool.cache_clear)  # a child has none of the threads of its parent


def run_blocks(
    run: Callable[[int, int, int], int | None], blocks: int, threads: int | None = None, scratch: int = 0
) -> int:
    """Call run(begin, end, address of scratch) for pieces of all blocks; return the first status that is not 0, or 0.

    threads   at most so many; None: `thread_count()`, and inside of a piece its part of them
    scratch   bytes that a thread needs

    After such a status or an exception no other piece begins. When this returns, no thread runs a piece.
    """
    if not blocks:
        return 0
    most = 1 if blocks == 1 else getattr(_team, "threads", None) or thread_count()
    count = min(most if threads is None else threads, blocks)
    memory = [torch.empty(-(-scratch // 8), dtype=torch.float64) for _ in range(count)]
    if count == 1:
        return run(0, blocks, memory[0].data_ptr()) or 0
    size = -(-blocks // (PIECES * count))
    pieces = deque((begin, min(begin + size, blocks)) for begin in range(0, blocks, size))
    statuses: list[int] = []

    def take(number: int) -> None:
        address, before = memory[number].data_ptr(), getattr(_team, "threads", None)
        _team.threads = max(most // count, 1)
        try:
            while piece := _next(pieces):
                if status := run(*piece, address):
                    statuses.append(status)
                    return
        finally:
            pieces.clear()
            _team.threads = before

    others = [_pool().submit(take, number) for number in range(1, count)]
    try:
        take(0)
    finally:
        wait([x for x in others if not x.cancel()])  # also after Ctrl-C: they write to arrays of the caller
    for x in others:
        if not x.cancelled():
            x.result()
    return statuses[0] if statuses else 0


def _next(pieces: deque[tuple[int, int]]) -> tuple[int, int] | None:
    try:
        return pieces.popleft()
    except IndexError:  # none is left
        return None


def lane_groups(lanes: int) -> list[slice]:
    """Return the groups of a batch: as few as possible, of nearly equal size."""
    count = -(-lanes // GROUP)
    ends = [lanes * k // count for k in range(count + 1)]
    return [slice(begin, end) for begin, end in pairwise(ends)]


def map_threads(function: Callable[..., Result], *sequences: Sequence[Any]) -> list[Result]:
    """Return [function(x, y, ...)] of the members of sequences, which threads share; torch records no derivatives inside."""
    arguments = list(zip(*sequences, strict=True))
    results: list[Any] = [None] * len(arguments)
    inference = torch.is_inference_mode_enabled()  # a thread has its own mode

    def run(begin: int, end: int, _: int) -> None:
        with torch.inference_mode(inference), torch.no_grad():
            for k in range(begin, end):
                results[k] = function(*arguments[k])

    run_blocks(run, len(arguments))
    return results
