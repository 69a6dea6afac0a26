"""Frequencies of a body on supports: supports, status, lanes, derivatives, also where frequencies coincide."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.testing import assert_close

import torchmbd as mbd
from tests.refused import ANY, refused
from torchmbd.fem.elements import Assembly, Beams, GivenElements
from torchmbd.math.sparse import SparseMatrix
from torchmbd.multibody.statics import VibrationCase

CARBON = mbd.Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=5.36e9, nu12=0.23, density=1586.0)


def panel(cells: tuple[int, int] = (4, 3), kind: str = "quad") -> mbd.FlexibleBody:
    laminate = mbd.Laminate(CARBON, [0.3, -0.5, 1.0], [1e-3, 2e-3, 1.5e-3])
    mesh = mbd.mesh.rectangle(1.0, 0.7, cells, kind)
    return mbd.FlexibleBody.plate("panel", mesh, laminate, modes=2, reference="left_edge")


def tube(elements: int = 4) -> mbd.FlexibleBody:
    section = mbd.sections.tube(0.03, CARBON, [0.3, -0.3, -0.3, 0.3], 5e-4)
    return mbd.FlexibleBody.beam("tube", mbd.BeamLine.straight(1.0, elements), section, modes=2, reference="start")


def richardson(f: Callable[[Tensor], Tensor], x: Tensor, h: float) -> Tensor:
    def central(h: float) -> Tensor:
        steps = h * torch.eye(x.numel(), dtype=x.dtype).unflatten(1, x.shape)
        return torch.stack([(f(x + e) - f(x - e)) / (2.0 * h) for e in steps], -1).unflatten(-1, x.shape)

    return (4.0 * central(h / 2.0) - central(h)) / 3.0


EDGES = {"left_edge": "u1 u2 u3 phi1", "right_edge": "u3", "top_edge": "u3"}


class Frequencies(nn.Module):
    def __init__(self, body: mbd.FlexibleBody, supports: Any, number: int) -> None:
        super().__init__()
        self.body, self.case, self.number = body, VibrationCase(body, supports), number

    def forward(self) -> Tensor:
        return self.case(self.number).frequencies


def of_parameter(model: nn.Module, name: str) -> tuple[Any, Tensor]:
    """What a module returns as a function of one of its parameters, and the value of this."""
    x = dict(model.named_parameters())[name].detach().clone()
    return lambda x: torch.func.functional_call(model, {name: x}, ()), x


def check_gradients(model: nn.Module, name: str, step: float) -> None:
    f, x = of_parameter(model, name)
    reverse, forward = torch.func.jacrev(f)(x), torch.func.jacfwd(f)(x)
    with torch.no_grad():
        expected = richardson(f, x, step)
    scale = float(expected.abs().max())
    assert_close(forward, reverse, rtol=0.0, atol=1e-9 * scale)
    assert_close(reverse, expected, rtol=0.0, atol=1e-6 * scale)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["quad", "triangle"])
@pytest.mark.parametrize(("name", "step"), [("angles", 1e-2), ("thickness", 2e-5)])
@pytest.mark.parametrize("supports", [EDGES, {}])
def test_gradients_of_plates(kind, name, step, supports):
    check_gradients(Frequencies(panel(kind=kind), supports, 3), f"body.laminate.{name}", step)


@pytest.mark.thorough
def test_gradients_of_a_beam_by_angles_and_nodes():
    section = mbd.sections.tube(0.03, CARBON, [0.3, 0.3, -0.2], 5e-4)
    nodes = torch.tensor([[0.0, 0.0, 0.0], [0.3, 0.01, 0.0], [0.7, 0.0, -0.05], [1.0, 0.0, 0.0]], dtype=torch.float64)
    line = mbd.BeamLine(nn.Parameter(nodes))
    body = mbd.FlexibleBody.beam("beam", line, section, modes=2, reference=0, mass="consistent")
    model = Frequencies(body, {0: "u1 u2 u3 phi1", 3: (None, 0.0, 0, None, None, None)}, 1)
    check_gradients(model, "body.line.nodes", 1e-3)
    name = next(name for name, _ in model.named_parameters() if name.endswith("angles"))
    check_gradients(model, name, 1e-2)


@pytest.mark.thorough
def test_the_sparse_and_the_dense_way_have_the_same_gradients(monkeypatch):
    f, x = of_parameter(Frequencies(panel((8, 6)), EDGES, 3), "body.laminate.angles")
    sparse = f(x), torch.func.jacrev(f)(x), torch.func.jacfwd(f)(x)
    monkeypatch.setattr("torchmbd.fem.reduction.cut.SMALL", 1000)
    assert_close(sparse, (f(x), torch.func.jacrev(f)(x), torch.func.jacrev(f)(x)), rtol=1e-9, atol=1e-9)


@pytest.mark.thorough
def test_coinciding_frequencies_of_a_tube_have_the_mean_of_their_derivatives():
    model = Frequencies(tube(), {"start": "u1 u2 u3 phi1", "end": "u2 u3"}, 3)  # the third of a pair, too
    frequencies = model()
    assert_close(frequencies[0], frequencies[1], rtol=1e-6, atol=0.0)
    f, x = of_parameter(model, next(name for name, _ in model.named_parameters() if name.endswith("angles")))
    reverse, forward = torch.func.jacrev(f)(x), torch.func.jacfwd(f)(x)
    scale = float(reverse.abs().max())
    assert_close(forward, reverse, rtol=0.0, atol=1e-9 * scale)
    assert_close(reverse[0], reverse[1], rtol=0.0, atol=1e-7 * scale)
    with torch.no_grad():
        expected = richardson(lambda x: f(x)[:2].mean(), x, 1e-2)
    assert_close(reverse[0], expected, rtol=0.0, atol=1e-6 * scale)


def test_lanes_are_designs():
    f, x = of_parameter(Frequencies(panel(), EDGES, 2), "body.laminate.angles")
    angles = torch.stack([x, torch.tensor([0.0, 0.9, 0.2], dtype=torch.float64)])
    each = torch.stack([f(x) for x in angles])
    assert_close(f(angles), each, rtol=1e-10, atol=0.0)
    assert_close(torch.func.vmap(f)(angles), each, rtol=1e-10, atol=0.0)
    slopes = torch.func.jacrev(lambda x: f(x).sum(0))(angles)  # [number, lane, angle]
    assert_close(slopes[:, 1], torch.func.jacrev(f)(angles[1]), rtol=1e-8, atol=1e-8)


def test_a_second_derivative_is_refused():
    f, x = of_parameter(Frequencies(panel((2, 2)), EDGES, 1), "body.laminate.angles")
    with pytest.raises(NotImplementedError, match="second derivatives of modes"):
        torch.func.hessian(lambda x: f(x)[0])(x)


def test_reference_nodes_are_clamped_without_supports():
    body = panel()
    kept = body.structure()["Kr"].detach()
    assert_close(mbd.natural_frequencies(body).frequencies[0].detach(), kept[0, 0].sqrt() / (2.0 * torch.pi))
    named, by_default = (mbd.natural_frequencies(body, supports, 2) for supports in ({"left_edge": "all"}, None))
    assert_close(named.frequencies, by_default.frequencies)
    assert_close(named.shapes, by_default.shapes)


def test_shapes_are_those_of_the_supports():
    result = mbd.natural_frequencies(panel(), EDGES, number=2)
    assert result.status == "ok"
    assert not result.shapes.requires_grad
    assert not bool(result.shapes[list(panel().mesh.node_sets["top_edge"]), 2].any())
    assert_close(result.shapes[:, :3].flatten(0, 1).abs().amax(0), torch.ones(2, dtype=torch.float64))


@pytest.mark.parametrize("cells", [(2, 2), (12, 8)])
def test_rigid_motions_of_a_free_body_are_left_out(cells):
    body = panel(cells)
    result = mbd.natural_frequencies(body, {}, number=3)
    assert result.status == "six rigid motions of the free body are left out"
    assert result.frequencies[0].item() > 10.0
    mass = body.assembly.masses()
    momentum = (mass.mass[:, None, None] * result.shapes[mass.ends[:, 0], :3]).sum(0).detach()
    assert float(momentum.abs().max()) < 1e-8 * float(mass.mass.sum())


@pytest.mark.parametrize("supports", [{"left_edge": "u3"}, {0: "u1 u2 u3"}, {"left_edge": "u1 u2 phi1 phi2 phi3"}])
@pytest.mark.parametrize("cells", [(2, 2), (12, 8)])
def test_a_movable_body_is_refused(supports, cells):
    with refused("panel.supports", ANY, "a frequency is zero"):
        mbd.natural_frequencies(panel(cells), supports)


def test_the_node_of_a_zero_frequency_is_that_of_the_design_that_has_it():
    """A rod of two elements, whose inner one does not resist twist in the second design."""
    stiffness = torch.diag(torch.tensor([2e5, 1e5, 1e5, 20.0, 30.0, 40.0], dtype=torch.float64))
    mass = torch.diag(torch.tensor([2.0, 2, 2, 3e-3, 1e-3, 2e-3], dtype=torch.float64))
    line, section = mbd.BeamLine.straight(1.0, 2), lambda: mbd.GivenSection(stiffness, mass)
    parts = {"inner": Beams(line, section(), elements=[0]), "outer": Beams(line, section(), elements=[1])}
    limp = stiffness.clone()
    limp[3, 3] *= 1e-15
    f, _ = of_parameter(Frequencies(mbd.FlexibleBody("rod", line, parts, 2, reference=0), None, 1), "body.inner.matrix")
    with refused("rod.supports", ANY, "lane 1 is zero", "about x"):
        f(torch.stack([stiffness, limp]))


def test_a_body_that_is_hardly_stiff_is_not_taken_for_movable():
    film = mbd.Laminate(CARBON, [0.3], [3e-4])
    body = mbd.FlexibleBody.plate("film", mbd.mesh.rectangle(12.0, 1.0, (20, 2)), film, modes=1, reference="left_edge")
    assert 0.0 < mbd.natural_frequencies(body).frequencies.item() < 3e-3


def test_springs_between_beams_vibrate():
    """A spring along its beam: frequencies need no stress, which springs do not give."""
    K = torch.zeros(12, 12, dtype=torch.float64)
    K[2, 2] = K[8, 8] = 100.0
    K[2, 8] = K[8, 2] = -100.0
    mesh = mbd.BeamLine.straight(1.0, 1)
    spring = GivenElements(
        mesh, [torch.arange(12)[None]], [K[None]], torch.arange(2), torch.ones(2, dtype=torch.float64)
    )
    section = mbd.sections.tube(0.03, CARBON, [0.3], 5e-4)
    body = mbd.FlexibleBody("link", mesh, {"beam": Beams(mesh, section), "spring": spring}, 1, reference=0)
    assert mbd.natural_frequencies(body).frequencies.item() > 0.0


@pytest.mark.parametrize(
    ("change", "path"),
    [
        ({"body": "rod"}, "body"),
        ({"supports": 3}, "panel.supports"),
        ({"supports": {"lef": "all"}}, "node"),
        ({"supports": {"left_edge": "u4"}}, "panel.supports.left_edge"),
        (
            {"supports": {"left_edge": (0.0, 0.1, None, 0.0, 0.0, 0.0)}},
            "panel.supports.0",
        ),
        ({"number": 0}, "number"),
        ({"number": 1000}, "number"),
        ({"number": 1.5}, "number"),
        ({"number": 49, "supports": {}}, "number"),
    ],
)
def test_wrong_arguments_are_named(change, path):
    arguments: dict[str, Any] = {"body": panel((2, 2))} | change
    with refused(path):
        mbd.natural_frequencies(**arguments)


def test_bodies_of_matrices_are_refused():
    line = mbd.BeamLine.straight(1.0, 1)
    assembly = Assembly(line, {"beam": Beams(line, mbd.sections.tube(0.03, CARBON, [0.3], 5e-4))})
    K, M = (x.dense().detach() for x in (assembly.stiffness(), assembly.mass()) if isinstance(x, SparseMatrix))
    body = mbd.FlexibleBody.from_matrices("bar", M, K, line.nodes, modes=1)
    with refused("bar"):
        mbd.natural_frequencies(body)
