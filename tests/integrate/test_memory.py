"""Memory that a motion takes: estimated as it is, refused where it is not there, and batches that fit."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.refused import refused
from tests.study.rod_model import build
from torchmbd.errors import InputError
from torchmbd.integrate import memory

# A process of its own for each, as the peak never falls: lanes, steps, sensitivities, cells along the rod.
CASES = [(256, 300, False, 4), (128, 300, True, 4), (48, 2, True, 60), (1, 20_000, False, 4)]
PEAK = """
import resource, sys, warnings
import torch, torchmbd as mbd
from tests.study.rod_model import build
from torchmbd.integrate.memory import motion_bytes
warnings.simplefilter("ignore")
lanes, steps, slopes, cells = map(int, sys.argv[1:])
peak = lambda: 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

def motion(system, lanes, steps):
    angles = torch.linspace(0.1, 1.5, 2 * lanes, dtype=torch.float64).reshape(lanes, 2)
    designs, way = {"rod.laminate.angles": angles}, "forward" if slopes else "none"
    found = mbd.simulate(system, 1e-5 * steps, steps=steps, gradients=way, designs=designs)
    return found.q, found.v, found.lam

motion(build(cells=cells), 8, 60)
before = peak()
system = build(cells=cells)
motion(system, lanes, steps)
print((peak() - before) / motion_bytes(system, lanes, steps, 2 * slopes))
"""


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=str)
def test_the_estimate_is_what_a_motion_takes(case):
    command = [sys.executable, "-c", PEAK, *(str(int(x)) for x in case)]
    root = Path(__file__).parents[2]
    result = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True).stdout
    assert 0.4 <= float(result) <= 1.5


def test_a_motion_of_a_thousand_million_steps_is_refused():
    system = build()
    for make in (
        lambda: mbd.simulate(system, 0.01, steps=10**9),
        lambda: mbd.simulate(system, 0.01, steps=10**9, phases=[mbd.Phase(until=0.005), mbd.Phase()]),
        lambda: mbd.simulate(system, 0.01, steps=10**9, method="rk4"),
        lambda: mbd.Problem(system, 0.01, mbd.Integral(mbd.StrainEnergy("rod")), steps=10**9),
    ):
        with refused("steps", 1000000000):
            make()


@pytest.mark.thorough
def test_default_steps_that_do_not_fit_are_refused():
    with refused("steps"):
        mbd.simulate(build(), 1e6)


def test_what_is_said_to_fit_fits(monkeypatch):
    monkeypatch.setattr(memory, "available_memory", lambda: 1e9)
    system = build()
    with refused("steps") as caught:
        memory.require_memory(system, 1, 500_000)
    most = int(re.search(r"must be at most (\d+)\.", str(caught.value))[1])  # pyright: ignore[reportOptionalSubscript]
    memory.require_memory(system, 1, most)
    with pytest.raises(InputError):
        memory.require_memory(system, 1, int(1.2 * most))


@pytest.mark.thorough
def test_lanes_that_do_not_fit_are_refused(monkeypatch):
    monkeypatch.setattr(memory, "available_memory", lambda: 1e9)
    designs = {"rod.laminate.angles": torch.zeros(20_000, 2, dtype=torch.float64)}
    with refused("designs"):
        mbd.simulate(build(), 0.01, steps=60, designs=designs)


@pytest.mark.thorough
def test_a_body_that_does_not_fit_is_refused(monkeypatch):
    monkeypatch.setattr(memory, "available_memory", lambda: 1e5)
    with refused("system"):
        mbd.simulate(build(), 0.01, steps=60)


@pytest.mark.thorough
def test_a_problem_evaluates_any_number_of_designs_in_batches_that_fit(monkeypatch):
    problem = mbd.Problem(build(), 0.002, mbd.Integral(mbd.StrainEnergy("rod")), steps=24, gradients="forward")
    X = np.linspace(-1.0, 1.0, 22).reshape(11, 2)
    expected = problem.evaluate(X, True)
    one = memory.lane_bytes(problem.system, 24, 2)
    installed = memory._tables(problem.system) + 4.0 * (3.5 * one + memory._work(24))
    monkeypatch.setattr(memory, "installed_memory", lambda: installed)
    sizes = []
    motions = problem._motions

    def counted(X, *others, **options):
        sizes.append(len(X))
        return motions(X, *others, **options)

    monkeypatch.setattr(problem, "_motions", counted)
    result = problem.evaluate(X, True)
    assert sizes == [3, 3, 3, 2]
    for a, b in zip(result, expected, strict=True):
        assert a.objective == pytest.approx(b.objective, rel=1e-9)
        np.testing.assert_allclose(a.objective_gradient, b.objective_gradient, rtol=1e-6)


def test_tables_of_bodies_that_are_there_anyway_do_not_cut_a_batch_to_one_design(monkeypatch):
    """They take half of the memory, as curved shells may; a batch has its share of the other half."""
    system = build()
    bare = memory.lanes_at_once(system, 24)
    monkeypatch.setattr(memory, "table_bytes", lambda nodes, parts: 0.5 * memory.installed_memory())
    assert memory.lanes_at_once(system, 24) == pytest.approx(0.5 * bare, rel=0.1)


@pytest.mark.thorough
def test_twenty_thousand_starts_are_never_one_batch(monkeypatch):
    problem = mbd.Problem(build(), 0.002, mbd.Integral(mbd.StrainEnergy("rod")), bounds=(-1.5, 1.5), steps=8)
    sizes = []

    def evaluate(X, gradients):
        sizes.append(len(X))
        raise KeyboardInterrupt

    monkeypatch.setattr(problem, "evaluate", evaluate)
    assert mbd.optimization.multistart(problem, starts=mbd.optimization.sobol(20_000, seed=1)).interrupted
    assert sizes == [64]
