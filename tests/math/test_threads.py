"""A team of threads: every block once, failures as with one thread, pieces that share their own work, groups of lanes."""

from __future__ import annotations

import os
import threading

import pytest
import torch

import torchmbd as mbd
from torchmbd.math.threads import GROUP, lane_groups, map_threads, run_blocks

COUNTS = (1, 2, 3)


@pytest.mark.parametrize("count", COUNTS)
def test_every_block_is_made_once_and_the_first_failure_ends_it(count: int) -> None:
    made: list[int] = []

    def run(begin: int, end: int, _: int) -> int:
        made.extend(range(begin, end))
        return 2 if begin <= 5 < end else 0

    assert run_blocks(lambda begin, end, _: made.extend(range(begin, end)), 50, count) == 0
    assert sorted(made) == list(range(50))
    made.clear()
    assert run_blocks(run, 50, count) == 2
    assert len(made) == len(set(made))


def test_no_block_is_nothing_to_do() -> None:
    assert run_blocks(lambda begin, end, scratch: 1, 0) == 0
    assert map_threads(abs, []) == []


@pytest.mark.parametrize("count", COUNTS)
def test_an_exception_in_any_thread_reaches_the_caller_when_all_have_ended(count: int) -> None:
    begun: list[int] = []
    ended: list[int] = []

    def run(begin: int, end: int, _: int) -> None:
        begun.append(begin)
        if len(begun) == count:  # the last of them to begin
            ended.append(begin)
            raise ArithmeticError("block")
        while len(begun) < count:
            threading.Event().wait(1e-3)
        threading.Event().wait(0.01)
        ended.append(begin)

    with pytest.raises(ArithmeticError, match="block"):
        run_blocks(run, 50, count)
    assert sorted(ended) == sorted(begun)


def test_a_child_process_has_threads_of_its_own() -> None:
    assert run_blocks(lambda begin, end, _: None, 8, 2) == 0
    if (child := os.fork()) == 0:
        made: list[int] = []
        run_blocks(lambda begin, end, _: made.extend(range(begin, end)), 8, 2)
        os._exit(int(sorted(made) != list(range(8))))
    _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == 0


@pytest.mark.parametrize("lanes", [1, GROUP, GROUP + 1, 5 * GROUP, 5 * GROUP + 3])
def test_groups_are_nearly_equal_and_hold_every_lane_once(lanes: int) -> None:
    sizes = [group.stop - group.start for group in lane_groups(lanes)]
    assert max(sizes) <= GROUP
    assert max(sizes) - min(sizes) <= 1
    assert [k for group in lane_groups(lanes) for k in range(lanes)[group]] == list(range(lanes))


@pytest.mark.parametrize("count", COUNTS)
def test_members_are_mapped_in_their_order_without_derivatives(count: int) -> None:
    x = torch.arange(20.0, requires_grad=True)
    with mbd.threads(count):
        squares = map_threads(lambda a, b: a * b, list(x), list(x))
    assert torch.stack(squares).tolist() == [k * k for k in range(20)]
    assert not any(y.requires_grad for y in squares)


def test_members_are_mapped_in_the_inference_mode_of_the_caller() -> None:
    with torch.inference_mode(), mbd.threads(2):
        x = torch.zeros(20)
        map_threads(lambda k: x[k : k + 1].add_(k), range(20))
    assert x.tolist() == list(range(20))


def test_a_piece_divides_the_threads_that_its_team_leaves() -> None:
    teams: list[int] = []

    def run(begin: int, end: int, _: int) -> None:
        callers = set()
        run_blocks(lambda begin, end, _: callers.add(threading.get_ident()), 8)
        teams.append(len(callers))

    with mbd.threads(2):
        run_blocks(run, 8)
    assert set(teams) == {1}
