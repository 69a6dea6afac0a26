"""What a user may keep in a file or send to another process comes back as it was: pickle, torch.save, copy."""

from __future__ import annotations

import copy
import io
import pickle
from typing import Any

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.mechanisms import pendulum

ENERGY = mbd.Integral(mbd.StrainEnergy("rod"))
GIVEN: dict[str, Any] = {"duration": 0.01, "steps": 5, "bounds": mbd.deg([-90, 90])}


def saved(thing: Any) -> Any:
    file = io.BytesIO()
    torch.save(thing, file)
    file.seek(0)
    return torch.load(file, weights_only=False)


WAYS = {"pickle": lambda x: pickle.loads(pickle.dumps(x)), "torch": saved, "copy": copy.deepcopy}


@pytest.fixture(scope="module")
def system() -> mbd.System:
    return pendulum()


@pytest.fixture(params=WAYS)
def again(request):
    return WAYS[request.param]


def test_systems_and_motions(system, again):
    motion = mbd.simulate(system, 0.01, steps=5, gradients="forward")
    for result in (again(motion), mbd.simulate(again(system), 0.01, steps=5, gradients="forward")):
        assert torch.equal(result.q, motion.q)
        assert torch.equal(result.dq_db, motion.dq_db)
        assert torch.equal(ENERGY(result).detach(), ENERGY(motion).detach())


@pytest.mark.parametrize("backend", ["eager", "native"])
def test_motions_after_a_gradient(system, again, backend, request):
    """The adjoint keeps its solvers for further rows: native ones hold a library, which no file can hold."""
    if backend == "native":
        request.getfixturevalue("native")
    motion = mbd.simulate(system, 0.01, steps=5, backend=backend)
    ENERGY(motion).sum().backward()
    system.zero_grad()
    result = again(motion)
    assert torch.equal(result.q, motion.q.detach())
    assert torch.equal(ENERGY(result), ENERGY(motion).detach())


def test_a_copied_system_has_numbers_of_its_own(system, again):
    other, place = again(system), "rod.laminate.angles"
    with torch.no_grad():
        other.get_parameter(place).add_(0.1)
    assert not torch.equal(other.get_parameter(place), system.get_parameter(place))
    other.load_state_dict(system.state_dict())  # and takes those of another: joints close anew
    a, b = (mbd.simulate(x, 0.01, steps=2).q for x in (other, system))
    assert torch.equal(a, b)


def problems(system: mbd.System) -> list[Any]:
    problem = mbd.Problem(system, minimize=ENERGY, subject_to=[ENERGY <= "initial"], **GIVEN)
    two = {"energy": ENERGY, "frequency": mbd.Frequency("rod")}
    return [
        problem,
        mbd.Differences(problem),
        mbd.optimization.RobustProblem(problem, 0.02),
        mbd.Tradeoff(system, minimize=two, **GIVEN),
    ]


@pytest.mark.thorough("copy", "torch")
@pytest.mark.parametrize("k", range(4))
def test_problems(system, again, k):
    problem = problems(system)[k]
    one, other = (p.evaluate(np.array([p.start]), True)[0] for p in (problem, again(problem)))
    values = ("values", "gradients") if k == 3 else ("objective", "objective_gradient")
    for name in values:
        assert np.array_equal(getattr(one, name), getattr(other, name))


def test_results_and_starts(system, again):
    problem = problems(system)[0]
    for starts in (mbd.optimization.sobol(2, seed=3), mbd.optimization.latin_hypercube(2, seed=3)):
        assert np.array_equal(again(starts).points(problem), starts.points(problem))
    study = mbd.optimization.multistart(problem, "slsqp", mbd.optimization.sobol(2, seed=3), max_iterations=1)
    result = again(study)
    assert [r.value for r in result.results] == [r.value for r in study.results]
    assert torch.equal(result.results[0].motion.q, study.results[0].motion.q)
