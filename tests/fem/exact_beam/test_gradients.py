"""Derivatives of equilibria by all that they depend on: differences, forward, reverse, batches."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

import torchmbd as mbd
from tests.fem.exact_beam.cases import PLANE, coupled, given

N = 6
CURVED = torch.stack([x := torch.linspace(0.0, 1.0, N + 1, dtype=torch.float64), 0.1 * x**2, 0.0 * x], 1)
ARGUMENTS = ("stiffness", "twist", "nodes", "load", "follower", "line", "gravity", "spin")


class Response(nn.Module):
    """Numbers of an equilibrium of a beam."""

    def __init__(self) -> None:
        super().__init__()
        line = mbd.BeamLine(nn.Parameter(CURVED.clone()))
        twist = nn.Parameter(torch.zeros(N, 2, dtype=torch.float64))
        self.beam = mbd.ExactBeam("blade", line, mbd.GivenSection(coupled(), PLANE), twist=twist)

    def forward(self, load: Tensor, follower: Tensor, line: Tensor, gravity: Tensor, spin: Tensor) -> Tensor:
        state = self.beam.equilibrium({"end": load}, {3: follower}, line, gravity=gravity, spin=spin)
        assert state.status == "ok"
        weights = torch.arange(21.0, dtype=torch.float64).reshape(7, 3)
        turns = 10.0 * state.rotations[..., -1, 0, 1] + state.forces[..., 1, 1, :].sum(-1)
        return (state.nodes * weights).sum((-2, -1)) + turns + state.reactions[..., 0, 4]


RESPONSE = Response()


def response(K: Tensor, twist: Tensor, nodes: Tensor, *loads: Tensor) -> Tensor:
    values = {"beam.section.matrix": K, "beam.twist": twist, "beam.line.nodes": nodes}
    return torch.func.functional_call(RESPONSE, values, loads)


@pytest.fixture(scope="module")
def point() -> list[Tensor]:
    make = torch.Generator().manual_seed(2)
    sizes = ((N, 2), (6,), (6,), (3,), (3,), (3,))
    twist, *loads = (0.5 * torch.randn(*size, dtype=torch.float64, generator=make) for size in sizes)
    return [coupled(), twist, CURVED.clone(), *loads]


def difference(f: Callable[[float], Tensor], h: float) -> float:
    """Richardson's."""
    one, two = ((f(s * h) - f(-s * h)) / (2.0 * s * h) for s in (1.0, 2.0))
    return float((4.0 * one - two) / 3.0)


@pytest.mark.thorough
def test_all_derivatives_are_those_of_differences(point):
    leaves = [x.clone().requires_grad_() for x in point]
    gradients = torch.autograd.grad(response(*leaves), leaves)
    make = torch.Generator().manual_seed(7)
    for k, (name, gradient) in enumerate(zip(ARGUMENTS, gradients, strict=True)):
        way = torch.randn(gradient.shape, dtype=torch.float64, generator=make)
        way = way + way.T if name == "stiffness" else way

        def moved(s: float, k: int = k, way: Tensor = way) -> Tensor:
            return response(*(x + s * way if i == k else x for i, x in enumerate(point)))

        h = 1e-4 if name == "nodes" else 1e-3
        assert float((gradient * way).sum()) == pytest.approx(difference(moved, h), rel=1e-6), name


@pytest.mark.thorough
def test_forward_and_reverse_agree(point):
    reverse = torch.func.jacrev(response, argnums=(1, 3))(*point)
    forward = torch.func.jacfwd(response, argnums=(1, 3))(*point)
    for a, b in zip(reverse, forward, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-10)


@pytest.mark.thorough
def test_a_batch_of_designs_is_each_of_them(point):
    K, twist, nodes, load, *rest = point
    twists, loads = torch.stack([twist, 0.5 * twist]), torch.stack([load, -load])

    def one(twist: Tensor, load: Tensor) -> Tensor:
        return response(K, twist, nodes, load, *rest)

    torch.testing.assert_close(torch.func.vmap(one)(twists, loads)[1], one(twists[1], loads[1]))
    gradients = torch.func.vmap(torch.func.grad(one))(twists, loads)
    torch.testing.assert_close(gradients[1], torch.func.grad(one)(twists[1], loads[1]), rtol=1e-9, atol=1e-10)


@pytest.mark.thorough
def test_lanes_of_a_parameter(point):
    """Parameters may lead with lanes, as everywhere: a state for each."""
    section = given(1e4, 1e4, 1e4, 1.0, 1.0, 1.0)
    beam = mbd.ExactBeam("rod", mbd.BeamLine.straight(1.0, 4), section)
    with torch.no_grad():
        section.matrix.data = torch.stack([section.matrix, 2.0 * section.matrix])
    state = beam.equilibrium({"end": (0.0, 1e-3, 0.0)})
    assert state.nodes.shape == (2, 5, 3)
    assert state.factor.tolist() == [1.0, 1.0]
    assert (state.nodes[0, -1, 1] / state.nodes[1, -1, 1]).item() == pytest.approx(2.0, rel=1e-4)
    failed = beam.equilibrium({"end": (-3.6, 0.0, 0.0)})  # Euler: 2.5 and 4.9 N
    assert failed.status.startswith("unstable")
    assert bool(failed.nodes[0].isnan().all())
    assert bool(failed.nodes[1].isfinite().all())


@pytest.mark.thorough
def test_ply_angles():
    """Of a thin-walled composite box, bent far."""
    carbon = mbd.Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=3.6e9, nu12=0.23, density=1586.0)
    walls = {"top": [0.35], "right": [0.1], "bottom": [0.35], "left": [0.1]}
    section = mbd.sections.box(0.03, 0.01, carbon, walls, 5e-4, cells=(4, 2, 1))
    beam = mbd.ExactBeam("spar", mbd.BeamLine.straight(1.0, 6), section)

    def tip() -> Tensor:
        return beam.equilibrium({"end": (0.0, 0.0, 60.0)}).nodes[-1]

    y = tip()
    assert float(y[2]) > 0.2
    assert float(y[1].abs()) > 1e-3
    y.sum().backward()
    gradient = section.angles.grad
    assert gradient is not None

    def moved(s: float) -> Tensor:
        section.angles.data[0] = 0.35 + s
        return tip().sum().detach()

    assert gradient[0].item() == pytest.approx(difference(moved, 1e-3), rel=1e-6)


@pytest.mark.thorough
def test_loads_in_lists_keep_the_gradients_of_their_tensors():
    beam = mbd.ExactBeam("rod", mbd.BeamLine.straight(1.0, 4), given(*[1e3] * 3, *[1.0] * 3))
    force, gravity = mbd.variable(0.1), mbd.variable(-9.81)
    deflection = beam.equilibrium({"end": (0.0, force, 0.0)}, gravity=[0.0, gravity, 0.0]).nodes[-1, 1]
    together = torch.autograd.grad(deflection, [force, gravity])
    F, g = (torch.tensor([0.0, float(x.detach()), 0.0], dtype=torch.float64).requires_grad_() for x in (force, gravity))
    apart = torch.autograd.grad(beam.equilibrium({"end": F}, gravity=g).nodes[-1, 1], [F, g])
    assert [float(x) for x in together] == pytest.approx([float(x[1]) for x in apart], rel=1e-12)
    assert min(abs(float(x)) for x in together) > 1e-6
