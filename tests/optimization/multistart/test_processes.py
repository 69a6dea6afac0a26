"""Batches shared out among processes: the same answers, whatever becomes of the processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import torchmbd as mbd
from torchmbd.optimization import Evaluation
from torchmbd.optimization.multistart.processes import Processes


class Overflow(Exception):
    """As a user may have it."""


class Bowl:
    """A sum of squares about a center that a closure holds, and who evaluated it."""

    def __init__(self, center: float):
        self.start, self.lower, self.upper = np.array([0.5, 0.5]), -np.ones(2), np.ones(2)
        self.names = ["x", "y"]
        self.center = lambda: center  # not to be had by pickle
        self.seen: list[int] = []

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[Evaluation]:
        self.seen.append(len(X))
        if X.max() >= 3.0:
            raise Overflow(f"a bowl is full at {X.max():g}")
        pid = np.array([-float(os.getpid())])  # a constraint that always holds
        return [
            Evaluation(float(((x - self.center()) ** 2).sum()), pid, 2 * (x - self.center()), 0 * x[None]) for x in X
        ]


@pytest.fixture(scope="module")
def shared():
    with Processes(Bowl(0.25), 2) as problem:
        problem.wait()
        yield problem


def test_a_batch_is_shared_out_in_order(shared):
    X = np.linspace(-1, 1, 14).reshape(7, 2)
    found = shared.evaluate(X, True)
    assert [e.objective for e in found] == [e.objective for e in Bowl(0.25).evaluate(X, True)]
    assert -float(os.getpid()) not in {float(e.constraints[0]) for e in found}
    assert shared.problem.seen == []  # nothing was evaluated here


def test_all_else_is_the_problem_s_own(shared):
    assert shared.start is shared.problem.start
    with pytest.raises(AttributeError, match="period"):
        _ = shared.period


def test_one_design_stays_here(shared):
    (found,) = shared.evaluate(np.zeros((1, 2)), True)
    assert float(found.constraints[0]) == -os.getpid()


def test_an_optimizer_does_not_notice(shared):
    starts = mbd.sobol(6, seed=3)
    together, alone = (mbd.multistart(problem, "slsqp", starts) for problem in (shared, Bowl(0.25)))
    assert [r.value for r in together.results] == [r.value for r in alone.results]
    assert together.converged == 6


def test_when_a_process_dies_the_caller_goes_on():
    with Processes(Once(), 2) as problem:
        X = np.full((2, 2), 0.5)
        with pytest.warns(UserWarning, match=r"a process that evaluates designs ended"):
            found = problem.evaluate(X, False)
        assert [float(e.constraints[0]) for e in found] == [-os.getpid()] * 2
        assert len(problem.evaluate(X, False)) == 2


class Once(Bowl):
    """Kills every process but the one that made it."""

    def __init__(self) -> None:
        super().__init__(0.0)
        self.maker = os.getpid()

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[Evaluation]:
        if os.getpid() != self.maker and not gradients:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().evaluate(X, gradients)


def test_an_error_of_the_problem_is_the_caller_s(shared):
    with pytest.raises(Overflow, match="a bowl is full at 3"):
        shared.evaluate(np.full((2, 2), 3.0), False)
    assert len(shared.evaluate(np.zeros((2, 2)), False)) == 2


class Locked(Bowl):
    """Its errors, and what it is said to hold, cannot travel."""

    def evaluate(self, X: np.ndarray, gradients: bool) -> list[Evaluation]:
        error = Overflow("nothing fits")
        error.args = (*error.args, threading.Lock())
        raise error


def test_an_error_that_cannot_travel_is_told(capfd):
    """Also where the first evaluation, which nobody asked for, has it: no process says so, or ends."""
    with Processes(Locked(0.0), 2) as problem, pytest.raises(RuntimeError, match=r"Overflow: .*nothing fits"):
        problem.evaluate(np.zeros((2, 2)), False)
    assert "Exception in initializer" not in capfd.readouterr().err


def test_a_problem_that_cannot_travel_is_refused():
    bowl = Bowl(0.0)
    bowl.center = threading.Lock()  # pyright: ignore[reportAttributeAccessIssue]
    with pytest.raises(mbd.InputError, match="cannot be sent to other processes: cannot pickle"):
        Processes(bowl, 2)


SCRIPT = """
import copy, sys, time
from tests.optimization.multistart.test_processes import Bowl
from torchmbd.optimization.multistart.processes import Processes

if __name__ == "__main__":
    shared = Processes(Bowl(0.0), 2)
    shared.wait()
    copy.copy(shared)
    print(*(begun.result() for begun in shared._begun), flush=True)
    time.sleep(60)
"""


def test_a_caller_that_is_killed_leaves_nobody_behind(tmp_path):
    (tmp_path / "script.py").write_text(SCRIPT)
    root = Path(__file__).parents[2]
    environment = os.environ | {"PYTHONPATH": str(root)}
    with subprocess.Popen([sys.executable, tmp_path / "script.py"], env=environment, stdout=subprocess.PIPE) as caller:
        assert caller.stdout is not None
        workers = [Path("/proc") / pid for pid in caller.stdout.readline().decode().split()]
        assert len(workers) == 2
        assert all(worker.exists() for worker in workers)
        caller.kill()
    for _ in range(100):
        if not any(worker.exists() for worker in workers):
            return
        time.sleep(0.1)
    pytest.fail(f"still there: {workers}")


def test_nobody_waits_for_what_is_under_way_after_ctrl_c():
    def interrupted() -> None:
        with Processes(Bowl(0.0), 2) as problem:
            problem.wait()
            problem._pool.submit(time.sleep, 60)
            raise KeyboardInterrupt

    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert time.monotonic() - began < 60  # of the sleep


@pytest.mark.parametrize("count", [0, -1, True, 1.5, "two"])
def test_a_count_that_is_none(count):
    with pytest.raises(mbd.InputError, match=r"count of processes is .*; allowed: a positive integer"):
        Processes(Bowl(0.0), count)


@pytest.mark.slow
def test_a_script_that_no_process_can_import():
    """One from the standard input: its processes end at once, and nobody waits for what is sent to them."""
    text = """
import torchmbd as mbd
from tests.mechanisms import pendulum
problem = mbd.Problem(pendulum(), 0.002, mbd.Integral(mbd.StrainEnergy("rod")), steps=4)
with mbd.Processes(problem, 2) as processes:
    print(len(processes.evaluate([[0.1, 0.2], [0.3, -0.1]], False)))
"""
    done = subprocess.run([sys.executable, "-"], input=text, capture_output=True, text=True, timeout=300, check=True)
    assert done.stdout.split() == ["2"]
    assert "a process that evaluates designs ended" in done.stderr
