"""Blocks of lanes on threads: a call of compiled code releases the lock of Python, so that several run at once.

    piece     a range of blocks (or lanes); a thread takes the next piece when it has finished one
    scratch   memory of a thread, used again by each of its pieces

A block depends on no other and a thread changes nothing but its blocks, so that results have the same bits with any number of
threads. The calling thread takes pieces, too: where all others are busy, it makes all of them.
Checked in tests/extensions/native/test_threads.py.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache

import torch

from torchmbd.process import cores, thread_count

PIECES = 4  # for each thread, so that none waits long for the last piece


@cache
def _pool() -> ThreadPoolExecutor:
    """The threads of this process, started when they are needed."""
    return ThreadPoolExecutor(max(cores(), thread_count()), thread_name_prefix="torchmbd")


os.register_at_fork(after_in_child=_pool.cache_clear)  # a child has none of the threads of its parent


def run_blocks(
    run: Callable[[int, int, int], int | None], blocks: int, threads: int | None = None, scratch: int = 0
) -> int:
    """Call run(begin, end, address of scratch) for pieces of all blocks; return the first status that is not 0, or 0.

    threads   at most so many; None: `thread_count()`
    scratch   bytes that a thread needs

    After such a status or an exception no other piece begins. When this returns, no thread runs a piece.
    """
    count = min(thread_count() if threads is None else threads, blocks)
    memory = [torch.empty(-(-scratch // 8), dtype=torch.float64) for _ in range(count)]
    if count == 1:
        return run(0, blocks, memory[0].data_ptr()) or 0
    size = -(-blocks // (PIECES * count))
    pieces = deque((begin, min(begin + size, blocks)) for begin in range(0, blocks, size))
    statuses: list[int] = []

    def take(number: int) -> None:
        address = memory[number].data_ptr()
        try:
            while piece := _next(pieces):
                if status := run(*piece, address):
                    statuses.append(status)
                    return
        finally:
            pieces.clear()

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
