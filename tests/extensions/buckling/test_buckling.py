"""Buckling of a body: loads, supports, status, derivatives, also where factors coincide."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.testing import assert_close

import torchmbd as mbd
from tests.multibody.statics.test_vibrations import CARBON, check_gradients, panel, richardson, tube
from tests.refused import ANY, refused
from torchmbd.extensions.buckling import eigenproblem
from torchmbd.extensions.buckling.buckling import BucklingCase
from torchmbd.extensions.buckling.nodal_loads import spread
from torchmbd.fem.elements import Beams, GivenElements


class Factors(nn.Module):
    def __init__(self, body: mbd.FlexibleBody, loads: Any, number: int, supports: Any = None) -> None:
        super().__init__()
        self.body, self.case, self.number = body, BucklingCase(body, loads, supports), number

    def forward(self) -> Tensor:
        return self.case(self.number).factors


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["quad", "triangle"])
@pytest.mark.parametrize(("name", "step"), [("angles", 1e-2), ("thickness", 2e-5)])
def test_gradients_through_the_stress_state(kind, name, step):
    check_gradients(Factors(panel(kind=kind), {"right_edge": (-1e3, 300.0, 0.0)}, 2), f"body.laminate.{name}", step)


@pytest.mark.thorough
def test_gradients_of_a_beam_with_imposed_displacement():
    section = mbd.sections.tube(0.03, CARBON, [0.3, 0.3, -0.2], 5e-4)
    body = mbd.FlexibleBody.beam("beam", mbd.BeamLine.straight(1.0, 3), section, modes=2, reference="start")
    supports = {"start": "all", "end": (-1e-3, 0.0, None, 0.0, None, None)}
    name = next(name for name, _ in Factors(body, {}, 1, supports).named_parameters() if name.endswith("angles"))
    check_gradients(Factors(body, {}, 1, supports), name, 1e-2)


@pytest.mark.thorough
def test_gradients_by_the_nodes_of_a_beam_whose_loads_are_spread():
    section = mbd.sections.tube(0.03, CARBON, [0.3, 0.3, -0.2], 5e-4)
    nodes = torch.tensor([[0.0, 0.0, 0.0], [0.3, 0.01, 0.0], [0.7, 0.0, -0.02], [1.0, 0.0, 0.0]], dtype=torch.float64)
    line = mbd.BeamLine(nn.Parameter(nodes[:, :]))
    body = mbd.FlexibleBody.beam("beam", line, section, modes=2, reference=0)
    model = Factors(body, {(0, 1, 2, 3): (-1e3, 0.0, 50.0)}, 1)
    check_gradients(model, "body.line.nodes", 1e-3)


@pytest.mark.thorough
@pytest.mark.extensions
def test_gradients_by_steered_fibers():
    mesh = mbd.mesh.rectangle(1.0, 0.7, (4, 3), "quad")
    field = mbd.fibers.FiberField(mesh, controls=(3, 1))
    angles = torch.tensor([[0.3, -0.5], [0.5, -0.2], [0.0, 0.4]], dtype=torch.float64)
    laminate = mbd.fibers.SteeredLaminate(CARBON, angles, [1e-3, 2e-3], field)
    body = mbd.FlexibleBody.plate("panel", mesh, laminate, modes=2, reference="left_edge")
    check_gradients(Factors(body, {"right_edge": (-1e3, 300.0, 0.0)}, 1), "body.laminate.angles", 1e-2)


@pytest.mark.thorough
def test_coinciding_factors_of_a_tube_have_the_mean_of_their_derivatives():
    model = Factors(tube(), {"end": (-1.0, 0.0, 0.0)}, 2)
    factors = model()
    assert_close(factors[0], factors[1], rtol=1e-6, atol=0.0)
    name = next(name for name, _ in model.named_parameters() if name.endswith("angles"))
    x = dict(model.named_parameters())[name].detach().clone()

    def mean(x: Tensor) -> Tensor:
        return torch.func.functional_call(model, {name: x}, ()).mean(0, keepdim=True)

    reverse = torch.func.jacrev(lambda x: torch.func.functional_call(model, {name: x}, ()))(x)
    assert_close(reverse[0], reverse[1], rtol=1e-6, atol=1e-9 * float(reverse.abs().max()))
    with torch.no_grad():
        expected = richardson(mean, x, 1e-2)
    assert_close(reverse[:1], expected, rtol=0.0, atol=1e-6 * float(expected.abs().max()))


@pytest.mark.thorough
def test_lanes_are_designs():
    model = Factors(panel(), {"right_edge": (-1e3, 0.0, 0.0)}, 2)
    angles = torch.tensor([[0.3, -0.5, 1.0], [0.0, 0.9, 0.2]], dtype=torch.float64)

    def f(x: Tensor) -> Tensor:
        return torch.func.functional_call(model, {"body.laminate.angles": x}, ())

    assert_close(f(angles), torch.stack([f(x) for x in angles]), rtol=1e-10, atol=0.0)


@pytest.mark.thorough
@pytest.mark.parametrize("cells", [(4, 3), (12, 8)])
def test_loads_that_only_stiffen_have_no_factor(cells):
    ply = mbd.Ply(E1=70e9, E2=70e9, G12=35e9, G13=35e9, G23=35e9, nu12=0.0, density=2700.0)
    mesh = mbd.mesh.rectangle(1.0, 0.7, cells, "quad")
    body = mbd.FlexibleBody.plate("panel", mesh, mbd.Laminate(ply, [0.0], [1e-3]), modes=2, reference="left_edge")
    result = mbd.buckling.linear_buckling(body, {"right_edge": (1e3, 0.0, 0.0)}, number=2)
    assert torch.isinf(result.factors).all()
    assert result.status.startswith("no buckling")
    assert not bool(result.shapes.any())
    system = mbd.System([body], [mbd.Fixed(mbd.Ground().at(), body.at("left_edge"))])
    limit = mbd.buckling.BucklingFactor("panel", {"right_edge": (1e3, 0.0, 0.0)}) >= 2.0
    problem = mbd.Problem(system, 1e-3, mbd.Mass("panel"), [limit], steps=2, variables=["panel.laminate.angles"])
    [evaluation] = problem.evaluate(problem.start[None], True)
    assert "buckling factor of panel is infinite" in evaluation.status


@pytest.mark.thorough
def test_the_sparse_and_the_dense_way_agree(monkeypatch):
    loads = {"right_edge": (-1e3, 300.0, 0.0)}
    dense = mbd.buckling.linear_buckling(panel((8, 6)), loads, number=3)
    monkeypatch.setattr(eigenproblem, "SMALL", 10)
    sparse = mbd.buckling.linear_buckling(panel((8, 6)), loads, number=3)
    assert dense.status == sparse.status == "ok"
    assert_close(sparse.factors, dense.factors, rtol=1e-9, atol=0.0)
    assert_close(sparse.shapes.abs(), dense.shapes.abs(), rtol=0.0, atol=1e-6)
    assert float(dense.shapes[:, :3].abs().max()) == pytest.approx(1.0)


def test_loads_are_spread_over_edges_areas_and_elements():
    mesh = mbd.mesh.rectangle(1.0, 0.6, (2, 3), "quad")
    edge = list(mesh.node_sets["right_edge"])
    total = torch.tensor([6.0, 0.0, 12.0], dtype=torch.float64)
    result = spread(mesh, edge, total, mesh.nodes)
    assert_close(result.sum(0)[:3], total)
    assert_close(result[edge, 0].sort().values, torch.tensor([1.0, 1.0, 2.0, 2.0], dtype=torch.float64))
    ends = result[sorted(edge, key=lambda i: float(mesh.nodes[i, 1]))][[0, -1], 3:]
    assert_close(ends, torch.tensor([[1.0, 0.0, -0.5], [-1.0, 0.0, 0.5]], dtype=torch.float64) * 4.0 * 0.2 / 12.0)
    whole = spread(mesh, range(len(mesh.nodes)), total, mesh.nodes)[:, 0]
    assert float(whole.max()) == pytest.approx(4 * float(whole.min()))
    assert_close(spread(mesh, [0], total, mesh.nodes)[0, :3], total)
    rod = mbd.BeamLine.straight(2.0, 4)
    line = spread(rod, range(5), total, rod.nodes)  # fixed ends take q L^2 / 12
    assert_close(line[[0, 2, -1], 4], torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64) * 6.0 * 0.25 / 12.0)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"body": "rod"}, ("body", "rod")),
        ({"loads": 3.0}, ("panel.loads", 3.0)),
        ({"loads": {"right_edge": (1.0, 2.0)}}, ("panel.loads.right_edge", (1.0, 2.0))),
        ({"loads": {"right_edge": (0.0, 0.0, 0.0)}}, ("panel.loads", {"right_edge": (0.0, 0.0, 0.0)})),
        ({"loads": {"rihgt": (0.0, 0.0, 1.0)}}, ("node", "rihgt")),
        ({"supports": {}}, ("panel.supports", {})),
        ({"supports": {"left_edge": "u4"}}, ("panel.supports.left_edge", "u4")),
        ({"supports": {"left_edge": "u3"}}, ("panel.supports", ANY, "do not hold the body")),
        (
            {"supports": {"left_edge": "all", 0: (1.0, None, None, None, None, None)}},
            ("panel.supports", ANY, "u1 of node 0"),
        ),
        ({"number": 0}, ("number", 0)),
    ],
)
def test_wrong_arguments_are_named(change, fault):
    arguments: dict[str, Any] = {"body": panel((2, 2)), "loads": {"right_edge": (-1.0, 0.0, 0.0)}} | change
    with refused(*fault):
        mbd.buckling.linear_buckling(**arguments)


def test_bodies_without_known_stress_are_refused():
    K = torch.eye(12, dtype=torch.float64)[None]
    mesh = mbd.BeamLine.straight(1.0, 1)
    spring = GivenElements(mesh, [torch.arange(12)[None]], [K], torch.arange(2), torch.ones(2, dtype=torch.float64))
    section = mbd.sections.tube(0.03, CARBON, [0.3], 5e-4)
    body = mbd.FlexibleBody("link", mesh, {"beam": Beams(mesh, section), "spring": spring}, 1, reference=0)
    with refused("link.spring"):
        mbd.buckling.linear_buckling(body, {1: (-1.0, 0.0, 0.0)})


def test_a_design_without_stiffness_is_a_failed_evaluation():
    """Lamination parameters that no stack has: the plate's matrix is not definite, and a search goes on with other designs."""
    laminate = mbd.lamination.LaminationParameters(
        mbd.examples.carbon(), 2e-3, membrane=[0, 0, 0, 0], bending=[0, 0, 0, 0], checked=False
    )
    mesh = mbd.mesh.rectangle(0.5, 0.3, cells=(4, 3))
    panel = mbd.FlexibleBody.plate("panel", mesh, laminate, modes=1, reference="left_edge")
    system = mbd.System([panel], [mbd.Fixed(mbd.Ground().at(), panel.at("left_edge"))])
    edges = {
        "left_edge": "u1 u3",
        "right_edge": "u3",
        "bottom_edge": "u3",
        "top_edge": "u3",
        "corner_left_bottom": "u2 u3",
    }
    buckling = mbd.buckling.BucklingFactor("panel", {"right_edge": (-3e3, 0, 0)}, edges)
    problem = mbd.Problem(
        system, 1e-3, minimize=-1.0 * buckling, variables=["panel.laminate.bending"], bounds=(-1, 1), steps=2
    )
    sound, failed = problem.evaluate(np.array([[0.0, 0.0, 0.0, 0.0], [0.9, 0.0, -1.0, 0.0]]), False)
    assert sound.ok
    assert "do not hold the body" in failed.status or "not positive definite" in failed.status
