"""Forces of exact beams: rigid motions, work, derivatives, and small displacements."""

from __future__ import annotations

import math

import pytest
import torch

import torchmbd as mbd
from tests.fem.exact_beam.cases import PLANE, coupled, given
from torchmbd.fem.elements import Assembly, BeamLine, Beams
from torchmbd.fem.exact_beam.continuation import Continuation
from torchmbd.fem.exact_beam.data import BeamData, Topology
from torchmbd.fem.exact_beam.forces import element_forces, load_forces, residual, rotated, screw_forces, screws
from torchmbd.math.rigid_motion import exponential, hat

TREE = torch.tensor([[0, 1], [1, 2], [1, 3]])


@pytest.fixture
def state() -> tuple[BeamData, torch.Tensor, torch.Tensor]:
    """Any numbers of a net of three elements, and any places and rotations."""
    make = torch.Generator().manual_seed(1)

    def some(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, dtype=torch.float64, generator=make)

    S, A = some(3, 6, 6), some(4, 3, 3)
    parts = (
        exponential(0.3 * some(3, 3)),
        exponential(0.3 * some(3, 3)),
        some(4, 3),
        some(4, 6),
        some(4, 3, 3),
        some(4, 6),
    )
    mass = (some(4).abs(), some(4, 3), A @ A.mT)
    data = BeamData(
        S @ S.mT, 0.3 * some(3, 6), *parts, *mass, some(3), some(3), some(3), torch.zeros(4, 6), 0.1 * some(3, 6)
    )
    return data, some(4, 3), exponential(0.5 * some(4, 3))


def test_stiffness_is_the_derivative_of_the_residual(state):
    data, x, R = state
    topology = Topology(TREE, torch.arange(24), True)

    def moved(q: torch.Tensor) -> torch.Tensor:
        return residual(data, topology, x + q[:, :3], rotated(R, q[:, 3:]), 0.7)

    J = torch.func.jacfwd(moved)(torch.zeros(4, 6, dtype=torch.float64)).reshape(24, 24)
    K, _ = Continuation(topology, 4).stiffness(data, x, R, screw_forces(data, topology, x, R, 0.7), 0.7)
    torch.testing.assert_close(torch.from_numpy(K.toarray()), -J, rtol=1e-11, atol=1e-11)


def test_a_rigid_motion_of_any_size_turns_the_inner_forces_and_no_more(state):
    data, x, R = state
    topology = Topology(TREE, torch.arange(24), True)
    Q, shift = exponential(torch.tensor([2.0, -1.5, 4.0], dtype=torch.float64)), torch.tensor([3.0, -2.0, 7.0])
    before = element_forces(data, topology, x, R).unflatten(-1, (4, 3))
    after = element_forces(data, topology, x @ Q.T + shift, Q @ R).unflatten(-1, (4, 3))
    torch.testing.assert_close(after, before @ Q.T, rtol=1e-11, atol=1e-11)
    total = before[:, 0] + before[:, 2]
    assert float(total.abs().max()) < 1e-12 * float(before.abs().max())


def test_dead_forces_and_inertia_have_a_potential(state):
    data, x, R = state
    data = data._replace(follower=0.0 * data.follower, dead=torch.cat([data.dead[:, :3], 0.0 * x], 1))

    def potential(q: torch.Tensor) -> torch.Tensor:
        at, turn = x + q[:, :3], torch.linalg.matrix_exp(hat(q[:, 3:])) @ R
        W = hat(data.spin) @ hat(data.spin)
        arms = (turn @ data.first[..., None])[..., 0]
        moved = at - data.center
        dead = (data.dead[:, :3] * at).sum() + torch.einsum("nij,nji->", turn, data.arms)
        heavy = (data.gravity * (data.mass[:, None] * at + arms)).sum()
        second = turn @ data.second @ turn.mT
        spun = -0.5 * (torch.einsum("n,ni,ij,nj->", data.mass, moved, W, moved) + (W * second.sum(0)).sum())
        return dead + heavy + spun - (arms * (moved @ W)).sum()

    result = torch.func.grad(potential)(torch.zeros(4, 6, dtype=torch.float64))
    torch.testing.assert_close(load_forces(data, x, R, 1.0), result, rtol=1e-11, atol=1e-11)


def test_small_displacements_are_those_of_the_linear_element():
    """Of any section, offset and twist, along an arc; differences are of second order."""
    errors = []
    for n in (12, 24):
        result, expected, forces, own = small_displacements(n)
        errors.append([float((a - b).norm() / b.norm()) for a, b in ((result, expected), (forces, own))])
    assert max(errors[1]) < 2e-3
    assert errors[0][0] / errors[1][0] == pytest.approx(4.0, rel=0.1)


def small_displacements(n: int) -> tuple[torch.Tensor, ...]:
    """Of n elements, per load, and the section forces in the middle of the line; of the exact beam and of the linear one."""
    twist = torch.linspace(0.1, 0.6, n + 1, dtype=torch.float64)
    line, section = BeamLine.arc(1.0, 1.2, n), mbd.GivenSection(coupled(), PLANE)
    place = {"offset": (0.05, -0.02), "twist": torch.stack([twist[:-1], twist[1:]], 1)}
    beam = mbd.ExactBeam("arc", line, section, **place)
    tip = torch.tensor([1.0, -2.0, 3.0, 0.5, 0.3, -0.4], dtype=torch.float64)
    small = 1e-7
    result = beam.equilibrium({"end": small * tip})
    linear = Beams(line, section, **place)
    assembly = Assembly(line, {"beam": linear})
    K = assembly.stiffness().dense()[6:, 6:]
    load = torch.zeros(6 * n, dtype=torch.float64)
    load[-6:] = tip
    expected = torch.linalg.solve(K, load).reshape(n, 6)
    whole = torch.cat([torch.zeros(1, 6, dtype=torch.float64), expected])[:, :, None]
    forces = linear.section_forces(whole)[..., 0]
    return (result.nodes - line.nodes)[1:] / small, expected[:, :3], result.forces[n // 2, 0] / small, forces[n // 2, 0]


def test_the_beam_does_not_see_a_turned_world():
    """The same beam and loads in other axes: the same tip, rotated."""
    Q = exponential(torch.tensor([0.4, -1.1, 2.0], dtype=torch.float64))
    nodes = torch.tensor([[0.0, 0, 0], [0.4, 0.1, 0], [0.8, 0.3, 0.2], [1.2, 0.3, 0.5]], dtype=torch.float64)
    force, gravity = (torch.tensor(x, dtype=torch.float64) for x in ((1.0, 2.0, -1.0), (0.0, -3.0, 1.0)))
    section = mbd.GivenSection(coupled(), PLANE)
    y = torch.tensor([0.0, 1.0, 0.2], dtype=torch.float64)
    result = [
        mbd.ExactBeam("beam", mbd.BeamLine(nodes @ T.T), section, orientation=T @ y).equilibrium(
            {"end": T @ force}, follower_line_load=(0.0, 1.0, 0.3), gravity=T @ gravity
        )
        for T in (torch.eye(3, dtype=torch.float64), Q)
    ]
    assert [state.status for state in result] == ["ok", "ok"]
    torch.testing.assert_close(result[1].nodes, result[0].nodes @ Q.T, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(result[1].forces, result[0].forces, rtol=1e-8, atol=1e-9)


@pytest.mark.thorough
def test_tension_does_not_buckle_a_coarse_beam():
    """N h^2 = 40 E I: a string; a load across it gives a triangle."""
    beam = mbd.ExactBeam("string", mbd.BeamLine.straight(1.0, 20), given(1e7, 1e7, 1e7, 0.01, 0.01, 0.01))
    state = beam.equilibrium(
        {"end": (160.0, 0.0, 0.0), "center": (0.0, 1.0, 0.0)}, supports={"start": "u1 u2 u3 phi1 phi2", "end": "u2 u3"}
    )
    assert state.status == "ok"
    assert state.nodes[10, 1].item() == pytest.approx(0.25 / 160.0, rel=4e-2)


def test_forces_have_a_potential(state):
    """U of the header, by automatic differentiation."""
    data, x, R = state
    topology = Topology(TREE, torch.arange(24), True)

    def energy(q: torch.Tensor) -> torch.Tensor:
        l, _, _ = screws(data, topology, x + q[:, :3], rotated(R, q[:, 3:]))
        d = (l - data.screws - data.free)[..., None]
        return 0.5 * (d.mT @ data.stiffness @ d).sum()

    result = torch.func.grad(energy)(torch.zeros(4, 6, dtype=torch.float64))
    expected = torch.zeros_like(result).index_add(0, TREE.flatten(), element_forces(data, topology, x, R).reshape(6, 6))
    torch.testing.assert_close(result, expected, rtol=1e-10, atol=1e-10)


def test_one_element_rolls_up_exactly_and_forces_are_those_of_statics():
    beam = mbd.ExactBeam("rod", mbd.BeamLine.straight(1.0, 1), given(1e6, 1e6, 1e6, 1.0, 1.0, 1.0))
    state = beam.equilibrium({"end": (0.0, 0.0, 0.0, 0.0, 0.0, 2.0)})
    expected = torch.tensor([math.sin(2.0) / 2.0, (1.0 - math.cos(2.0)) / 2.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(state.nodes[-1], expected, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(state.forces[0, :, 5], torch.tensor([2.0, 2.0], dtype=torch.float64))


def test_section_forces_balance_the_load():
    beam = mbd.ExactBeam("rod", mbd.BeamLine.straight(1.0, 5), given(1e5, 1e5, 1e5, 2.0, 1.0, 3.0))
    load = torch.tensor([1.0, 2.0, 4.0], dtype=torch.float64)
    state = beam.equilibrium({"end": load})
    assert state.status == "ok"
    torch.testing.assert_close(state.forces[0, 0, :3], load, rtol=1e-9, atol=1e-9)  # the clamped end keeps its axes
    torch.testing.assert_close(state.forces[0, 0, 3:], torch.linalg.cross(state.nodes[-1], load), rtol=1e-9, atol=1e-9)
