"""A lane that fails has nan in its rows, and no derivative: in both modes, with torch.func.vmap and without."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import GRAVITY, plate

STIFFNESS = "spring.stiffness"
MANY = torch.tensor([300.0, 1e22, 500.0], dtype=torch.float64)  # the second spring overflows
WAYS = ("reverse", "forward")


@pytest.fixture(scope="module")
def system() -> mbd.System:
    ground, rod = mbd.Ground(), plate("rod", 2, position=(0.3, 0.0, 0.0))
    spring = mbd.SpringDamper(
        ground.at(0.1, 0.2, 0.3), rod.at("right"), stiffness=mbd.variable(300.0), rest=0.1, name="spring"
    )
    joint = mbd.Revolute(ground.at(0.15, 0.0, 0.0), rod.at("left"), axis="y")
    return mbd.System([rod], [joint], [spring], gravity=GRAVITY)


def simulated(system: mbd.System, x: Tensor, way: str) -> mbd.Trajectory:
    return mbd.simulate(system, 0.0015, steps=3, designs={STIFFNESS: x}, gradients=way, iterations=(4, 2))


def numbers(motion: mbd.Trajectory) -> Tensor:
    """Of everything that a motion has [lanes, n]."""
    rod = motion.body("rod")
    reaction = motion.reaction(motion.system.joints[0].name).force
    parts = (motion.q, motion.v, motion.a, motion.lam, rod.nodes, reaction, motion.energies.stored, rod.strain_energy)
    return torch.stack([x.flatten(1).square().sum(1) for x in parts], 1)


@pytest.fixture(scope="module")
def slopes(system) -> Tensor:
    """Of the lanes that do not fail, each by itself [2, n]."""
    return torch.stack([torch.func.jacrev(lambda x: numbers(simulated(system, x, "reverse"))[0])(x) for x in MANY[::2]])


@pytest.mark.thorough
@pytest.mark.parametrize("way", WAYS)
def test_reverse_mode(system, slopes, way):
    """All rows of all lanes in one call, and under vmap each lane by itself."""

    def lane(x: Tensor) -> Tensor:
        return numbers(simulated(system, x, way))[0]

    values = torch.vmap(lane)(MANY)
    assert values.isnan().all(1).tolist() == [False, True, False]
    whole = torch.func.jacrev(lambda x: numbers(simulated(system, x, way)).sum(0))(MANY).T
    for result in (whole, torch.vmap(torch.func.jacrev(lane))(MANY)):
        assert result[1].tolist() == [0.0] * result.shape[1]
        assert_close(result[::2], slopes, rtol=1e-6, atol=1e-9)


@pytest.mark.thorough
@pytest.mark.parametrize("way", WAYS)
def test_forward_mode(system, slopes, way):
    """Rows and responses of a failed lane have no tangent; what torch makes of nan is nan, and of no other lane."""
    motion = simulated(system, MANY, way)
    assert [status.startswith("failed") for status in motion.status] == [False, True, False]
    ones = torch.ones_like(MANY)
    measures = [mbd.Integral(mbd.StrainEnergy("rod")), mbd.Max(mbd.StrainEnergy("rod"))]

    def shown(x: Tensor) -> tuple[Tensor, ...]:
        result = simulated(system, x, way)
        return result.q, result.a, result.lam, *(measure(result) for measure in measures)

    for y, dy in zip(*torch.func.jvp(shown, (MANY,), (ones,)), strict=True):
        assert bool(y[1].isnan().any())
        assert not bool(dy[1].any())
        assert bool(dy[0].any())
        assert bool(dy.isfinite().all())
    by = torch.vmap(torch.func.jacfwd(lambda x: numbers(simulated(system, x, way))[0]))(MANY)
    assert_close(by[::2], slopes, rtol=1e-6, atol=1e-9)
    inside = torch.vmap(torch.func.jacfwd(lambda x: torch.stack([m(simulated(system, x, way))[0] for m in measures])))
    assert inside(MANY)[1].tolist() == [0.0, 0.0]


@pytest.mark.thorough
@pytest.mark.parametrize("way", WAYS)
def test_a_failed_lane_is_nan_under_vmap_from_its_failure_on(system, way):
    """As without vmap."""
    alone = simulated(system, MANY, way)
    result = torch.vmap(lambda x: simulated(system, x, way).q[0])(MANY)
    assert bool(result[1].isnan().any())
    assert torch.equal(result.isnan(), alone.q.isnan())
