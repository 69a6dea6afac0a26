"""Stacks of zones that share their plies: found again where they exist, as good as all others of a small case, refusals."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.extensions.lamination.test_stack_recovery import asked
from tests.refused import refused

QUARTERS = mbd.deg([0, 45, 90, -45])


def is_blended(thin: list[float], thick: list[float]) -> bool:
    """Whether a stack is another one without some of its plies."""
    left = iter(thick)
    return all(any(abs(one - two) < 1e-12 for two in left) for one in thin)


def half(angles: list[float]) -> list[float]:
    return angles[: (len(angles) + 1) // 2]


@pytest.mark.thorough
@pytest.mark.parametrize(
    "stacks",
    [
        {"root": [45, 0, -45, 90, 90, -45, 0, 45], "middle": [45, 0, 90, 90, 0, 45], "tip": [45, 90, 90, 45]},
        {"one": [0, 90, 45, 90, 0], "two": [0, 45, 0], "three": [0, 90, 45, 90, 0]},
        {"a": [0, 45, 90, -45, 0], "b": [0, 90, -45, 0], "c": [0, 90]},
    ],
)
def test_stacks_that_exist_are_found(stacks):
    zones = {name: asked(list(map(float, degrees))) for name, degrees in stacks.items()}
    result = mbd.lamination.recover_blended_stacks(zones, {name: len(x) for name, x in stacks.items()}, QUARTERS)
    for name, degrees in stacks.items():
        assert result[name].distance < 1e-9
        assert torch.tensor(result[name].angles).rad2deg().tolist() == pytest.approx(degrees)
        assert float(result[name].laminate.total_thickness) == pytest.approx(1.25e-4 * len(degrees))


@pytest.mark.thorough
def test_all_stacks_of_a_small_case():
    """Three zones of 6, 4 and 2 plies from three angles, parameters of no such stacks: no blend is nearer."""
    allowed = mbd.deg([0, 45, 90])
    expected = {"a": [30, 60, -15, -15, 60, 30], "b": [10, 75, 75, 10], "c": [50, 50]}
    zones = {name: asked(list(map(float, degrees))) for name, degrees in expected.items()}
    plies, areas = {"a": 6, "b": 4, "c": 2}, {"a": 3.0, "b": 2.0, "c": 1.0}
    result = mbd.lamination.recover_blended_stacks(zones, plies, allowed, areas=areas)
    assert is_blended(half(result["b"].angles), half(result["a"].angles))
    assert is_blended(half(result["c"].angles), half(result["b"].angles))

    def distance(name: str, stack: tuple[float, ...]) -> float:
        angles = torch.tensor([*stack, *stack[::-1]], dtype=torch.float64)
        z = np.linspace(-1, 1, len(angles) + 1)
        V = torch.stack([(2 * angles).cos(), (2 * angles).sin(), (4 * angles).cos(), (4 * angles).sin()], 1).numpy()
        sets = np.stack([(np.diff(z**k) / 2) @ V for k in (1, 2, 3)])
        asked_for = np.stack([x.detach().numpy() for x in zones[name].sets()])
        return float(np.sqrt(((sets - asked_for) ** 2).sum() / 12.0))

    total = sum(areas.values())
    best = min(
        sum(areas[n] / total * distance(n, s) ** 2 for n, s in (("a", guide), ("b", two), ("c", one)))
        for guide in itertools.product(allowed.tolist(), repeat=3)
        for two in itertools.combinations(guide, 2)
        for one in itertools.combinations(two, 1)
    )
    assert sum(areas[n] / total * result[n].distance ** 2 for n in areas) == pytest.approx(best, rel=1e-9)


@pytest.mark.thorough
def test_rules_of_every_zone():
    zones = {
        name: mbd.lamination.LaminationParameters(mbd.examples.carbon(), n * 1e-4, [0.3, 0.2, 0, 0])
        for name, n in (("a", 12), ("b", 8))
    }
    rules = mbd.lamination.LaminationRules(symmetric=True, balanced=True)
    result = mbd.lamination.recover_blended_stacks(zones, {"a": 12, "b": 8}, QUARTERS, rules)
    assert not result["a"].broken
    assert not result["b"].broken
    assert is_blended(half(result["b"].angles), half(result["a"].angles))


def test_bad_input_is_named():
    carbon, flat = mbd.examples.carbon(), [0.0, 0.0, 0.0, 0.0]
    plain, coupled = (
        mbd.lamination.LaminationParameters(carbon, 1e-3, flat),
        mbd.lamination.LaminationParameters(carbon, 1e-3, flat, coupling=flat),
    )
    steel = mbd.lamination.LaminationParameters(mbd.Ply.isotropic(210e9, 0.3, 7850.0), 1e-3, flat)
    for given, path in [
        (({}, {}), "laminates"),
        (({"a": plain}, {"b": 4}), "plies"),
        (({"a": plain, "b": coupled}, {"a": 4, "b": 4}), "laminates"),
        (({"a": plain, "b": plain}, {"a": 4, "b": 3}), "plies"),
        (({"a": plain}, {"a": 0}), "plies"),
        (({"a": 3}, {"a": 4}), "a.laminate"),
        (({"a": plain, "b": steel}, {"a": 4, "b": 4}), "laminates"),
    ]:
        with refused(path):
            mbd.lamination.recover_blended_stacks(*given, QUARTERS)
    with refused("a.area", -1.0):
        mbd.lamination.recover_blended_stacks({"a": plain}, {"a": 4}, QUARTERS, areas={"a": -1.0})
    with refused("seed", -1):
        mbd.lamination.recover_blended_stacks({"a": plain}, {"a": 4}, QUARTERS, seed=-1)
    with refused("weights", 3.0):
        mbd.lamination.recover_blended_stacks({"a": plain}, {"a": 4}, QUARTERS, weights=3.0)
