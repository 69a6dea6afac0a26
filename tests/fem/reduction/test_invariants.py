"""Inertia invariants against direct sums over the nodes, written as loops."""

import pytest
import torch

from tests.refused import refused
from torchmbd.fem.reduction import inertia_invariants

LANES, NODES, MODES = 2, 5, 3


@pytest.fixture
def body() -> tuple[torch.Tensor, ...]:
    make = torch.Generator().manual_seed(11)
    x = torch.randn(NODES, 3, generator=make, dtype=torch.float64)
    mass = torch.rand(LANES, NODES, generator=make, dtype=torch.float64)
    rotary = torch.rand(LANES, NODES, generator=make, dtype=torch.float64)
    psi = torch.randn(LANES, NODES, 6, MODES, generator=make, dtype=torch.float64)
    return x, mass, rotary, psi


def nodal_sums(x, mass, rotary, psi):
    """One lane, term by term."""
    t, r = psi[:, :3], psi[:, 3:]
    sums = {
        "mass": torch.zeros(()),
        "S0": torch.zeros(3),
        "S1": torch.zeros(3, MODES),
        "P0": torch.zeros(3, 3),
        "C0": torch.zeros(3, 3, MODES),
        "C1": torch.zeros(3, 3, MODES, MODES),
        "mu": torch.zeros(()),
        "R1": torch.zeros(3, MODES),
        "R2": torch.zeros(3, 3, MODES, MODES),
    }
    sums = {name: value.double() for name, value in sums.items()}
    for k in range(NODES):
        sums["mass"] += mass[k]
        sums["mu"] += rotary[k]
        for i in range(3):
            sums["S0"][i] += mass[k] * x[k, i]
            for a in range(MODES):
                sums["S1"][i, a] += mass[k] * t[k, i, a]
                sums["R1"][i, a] += rotary[k] * r[k, i, a]
            for j in range(3):
                sums["P0"][i, j] += mass[k] * x[k, i] * x[k, j]
                for a in range(MODES):
                    sums["C0"][i, j, a] += mass[k] * t[k, i, a] * x[k, j]
                    for b in range(MODES):
                        sums["C1"][i, j, a, b] += mass[k] * t[k, i, a] * t[k, j, b]
                        sums["R2"][i, j, a, b] += rotary[k] * r[k, i, a] * r[k, j, b]
    return sums


def test_every_invariant_is_its_nodal_sum(body):
    x, mass, rotary, psi = body
    batched = inertia_invariants(x, mass, rotary, psi)
    for lane in range(LANES):
        expected = nodal_sums(x, mass[lane], rotary[lane], psi[lane])
        assert set(batched) == set(expected)
        single = inertia_invariants(x, mass[lane], rotary[lane], psi[lane])
        for name, value in expected.items():
            torch.testing.assert_close(batched[name][lane], value, rtol=1e-12, atol=1e-13, msg=name)
            torch.testing.assert_close(single[name], value, rtol=1e-12, atol=1e-13, msg=name)


@pytest.mark.thorough
def test_derivatives_forward_and_reverse(body):
    x, mass, rotary, psi = (a.requires_grad_() for a in body)
    assert torch.autograd.gradcheck(
        lambda *a: tuple(inertia_invariants(*a).values()), (x, mass, rotary, psi), check_forward_ad=True
    )


def test_a_mass_that_only_one_lane_shares_broadcasts(body):
    x, mass, rotary, psi = body
    shared = inertia_invariants(x, mass[0], rotary[0], psi)
    repeated = inertia_invariants(x, mass[:1].expand(LANES, -1), rotary[:1].expand(LANES, -1), psi)
    for name, value in shared.items():
        torch.testing.assert_close(value.expand_as(repeated[name]), repeated[name])


def test_wrong_shapes_are_named(body):
    x, mass, rotary, psi = body
    with refused("x"):
        inertia_invariants(x, mass[..., :-1], rotary, psi)
