"""Exact beams that become warmer or wetter: closed forms, finite turns, stability, frequencies, gradients, bad input."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.fem.exact_beam.cases import PLANE, coupled
from tests.mechanisms import tensor
from tests.refused import refused

E, ALPHA, AREA, I = 210e9, 12e-6, 1e-4, 8e-10
LENGTH = 0.5
CARBON = mbd.Ply(128e9, 10.1e9, 5.36e9, 5.36e9, 3.6e9, 0.23, 1586.0, alpha1=-0.3e-6, alpha2=28e-6, beta1=0.0, beta2=0.4)


def metal(alpha: Any = ALPHA) -> Any:
    return mbd.GivenSection.isotropic(E, 0.3, 7850.0, AREA, I, 2.0 * I, 2.0 * I, alpha=alpha)


def bar(elements: int = 4, section: Any = None, **options: Any) -> mbd.ExactBeam:
    return mbd.ExactBeam("bar", mbd.BeamLine.straight(LENGTH, elements), section or metal(), **options)


def test_a_free_bar_and_a_free_arc_grow():
    """Every place of an arc is scaled by 1 + alpha T: its angle stays, its radius grows. Nothing is stressed."""
    arc = mbd.ExactBeam("arc", mbd.BeamLine.arc(0.3, 2.0, 4), metal(), orientation=(0.0, 0.0, 1.0))
    for beam in (bar(), arc):
        state = beam.equilibrium(temperature=150.0)
        assert state.status == "ok"
        assert_close(state.nodes, beam.mesh.nodes * (1.0 + ALPHA * 150.0), rtol=0, atol=1e-12)
        assert float(state.forces.abs().max()) < 1e-9 * E * AREA * ALPHA * 150.0


def test_a_bar_between_walls_is_pressed():
    """N = -E A alpha T, of an element that alone is warm as of half of it."""
    state = bar().equilibrium(temperature=20.0, supports={"start": "all", "end": "all"})
    assert_close(state.forces[..., 0], tensor(-E * AREA * ALPHA * 20.0).expand(4, 2), rtol=1e-9, atol=0)
    assert float(state.reactions[-1, 0]) == pytest.approx(-E * AREA * ALPHA * 20.0, rel=1e-9)
    half = bar().equilibrium(temperature=[40.0, 0.0, 40.0, 0.0], supports={"start": "all", "end": "all"})
    assert_close(half.forces, state.forces, rtol=1e-9, atol=1e-6)


@pytest.mark.parametrize("elements", [4, 7])
def test_a_gradient_rolls_a_beam_up_to_a_circle(elements):
    """The curvature is alpha times the gradient; along y it bends the other way. A quarter is a quarter of a circle."""
    g = 2.0 * math.pi / (LENGTH * ALPHA)
    for change in ("gradient", "gradient_y"):
        arguments: Any = {change: g}
        state = bar(elements).equilibrium(**arguments)
        assert state.status == "ok"
        assert_close(state.nodes[-1], torch.zeros(3, dtype=torch.float64), rtol=0, atol=1e-9)
        assert_close(state.rotations[-1], torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-9)
        assert float(state.forces.abs().max()) < 1e-9 * E * I / LENGTH
    radius = LENGTH / (0.5 * math.pi)
    place = bar(elements).equilibrium(gradient=g / 4.0, gradient_y=0.0).nodes[-1]
    assert_close(place, tensor(radius, 0.0, -radius), rtol=0, atol=1e-9)
    place = bar(elements).equilibrium(gradient_y=g / 4.0).nodes[-1]
    assert_close(place, tensor(radius, -radius, 0.0), rtol=0, atol=1e-9)


def test_small_changes_move_an_offset_beam_as_linear_elements_do():
    """Sections off the line and twisted, an L in space; finite displacements differ by their squares."""
    nodes = tensor(0.0, 0.0, 0.0, 0.2, 0.0, 0.0, 0.4, 0.0, 0.0, 0.4, 0.15, 0.1, 0.4, 0.3, 0.2).reshape(5, 3)
    options: dict = {"orientation": (0.1, 0.3, 1.0), "twist": 0.3, "offset": (0.01, -0.02)}
    changes: Any = {"temperature": 2e-2, "gradient": 0.3, "gradient_y": -0.2}
    exact = mbd.ExactBeam("bar", mbd.BeamLine(nodes), metal(), **options).equilibrium(**changes)
    line = mbd.BeamLine(nodes)
    body = mbd.FlexibleBody.beam("bar", line, metal(), 1, reference="start", expansion=True, **options)
    hold = mbd.Fixed(mbd.Ground().at(), body.at("start"))
    system = mbd.System([body], [hold], [mbd.Temperature(body, **changes)], truncation=None)
    w = mbd.equilibrium(system).body("bar").w[0, 0]
    linear = (body.structure()["psi"] @ w).detach()[:, :3]
    moved = exact.nodes - nodes
    assert_close(moved, linear, rtol=0, atol=1e-5 * float(linear.abs().max()))
    assert float(exact.forces.abs().max()) < 1e-6 * E * AREA * ALPHA * 2e-2


def test_a_twisted_beam_of_one_element_is_that_of_many():
    """The strains in turning axes are uniform, so a free beam is a screw motion whatever its division."""
    section = mbd.sections.strip(0.02, CARBON, mbd.deg([30, 60]), thickness=0.25e-3)
    ends = [bar(n, section, offset=(0.003, -0.002)).equilibrium(temperature=-60.0) for n in (2, 9)]
    assert all(state.status == "ok" for state in ends)
    assert_close(ends[0].nodes[-1], ends[1].nodes[-1], rtol=0, atol=1e-10)
    assert float(ends[0].nodes[-1, 2].detach()) > 0.1  # it curls
    strain = section.free_strain("temperature")
    assert float(strain[4]) * -60.0 * LENGTH < -0.9


def test_a_table_of_sections_expands_with_their_mean():
    """The coefficient is linear along the bar, whatever the stiffness."""
    table = mbd.SectionTable([0.0, 1.0], [metal(10e-6), metal(30e-6)])
    state = bar(3, table).equilibrium(temperature=100.0)
    assert float(state.nodes[-1, 0]) == pytest.approx(LENGTH * (1.0 + 20e-6 * 100.0), rel=1e-12)
    first = float(state.nodes[1, 0]) / (LENGTH / 3.0) - 1.0
    assert first == pytest.approx(100.0 * (10e-6 + 20e-6 / 6.0), rel=1e-9)


def test_moisture_swells_plies():
    section = mbd.sections.rectangle(0.01, 0.005, CARBON, cells=(2, 2))
    state = bar(2, section).equilibrium(moisture=0.01)
    grown = 0.01 * float(section.free_strain("moisture")[0].detach())
    assert float(state.nodes[-1, 0]) == pytest.approx(LENGTH * (1.0 + grown), rel=1e-12)


@pytest.mark.thorough
def test_a_warm_beam_between_hinges_buckles_and_vibrates_more_slowly():
    """At E A alpha T = P_E = pi^2 E I / L^2, where f^2 = (1 - P / P_E) of that without load."""
    euler = math.pi**2 * I / (LENGTH**2 * AREA * ALPHA)
    hinges = {"start": "u1 u2 u3 phi1 phi3", "end": "u1 u2 u3 phi1 phi3"}
    beam = bar(24)
    state = beam.equilibrium(temperature=1.5 * euler, supports=hinges)
    assert state.status.startswith("unstable")
    assert float(state.factor) == pytest.approx(1.0 / 1.5, rel=3e-3)
    (cold, _), (warm, _) = (beam.frequencies(1, supports=hinges, temperature=x) for x in (0.0, 0.5 * euler))
    assert float(warm[0] / cold[0]) ** 2 == pytest.approx(0.5, abs=3e-3)


class Response(torch.nn.Module):
    """Numbers of a curved beam of coupled sections under changes and a force, with a coefficient of expansion."""

    def __init__(self) -> None:
        super().__init__()
        x = torch.linspace(0.0, 1.0, 5, dtype=torch.float64)
        self.line = mbd.BeamLine(torch.stack([x, 0.1 * x**2, 0.0 * x], 1))
        self.alpha = torch.nn.Parameter(tensor(ALPHA).reshape(()))
        section = mbd.sections.strip(0.02, CARBON, mbd.deg([30, 60]), thickness=1e-3, cells=(4, 1))
        self.strip = mbd.ExactBeam("strip", self.line, section, twist=0.2, offset=(0.01, 0.0))

    def forward(self, change: Tensor, gradient: Tensor, load: Tensor) -> Tensor:
        supports = {"start": "all", "end": "u2"}
        state = self.strip.equilibrium({"end": load}, temperature=change, gradient=gradient, supports=supports)
        assert state.status == "ok"
        return torch.cat([state.nodes[-2:].flatten(), 1e-2 * state.forces[1].flatten(), 1e-2 * state.reactions[-1]])


@pytest.mark.thorough
def test_gradients_forward_reverse_and_by_differences():
    model = Response()
    angles = model.get_parameter("strip.section.angles").detach().clone()
    point = (angles, tensor(-20.0, 5.0, 10.0, -30.0), tensor(800.0).reshape(()), tensor(0.0, 0.1, 0.2))

    def numbers(theta: Tensor, *loads: Tensor) -> Tensor:
        return torch.func.functional_call(model, {"strip.section.angles": theta}, loads)

    places = tuple(range(len(point)))
    forward = torch.func.jacfwd(numbers, argnums=places)(*point)
    reverse = torch.func.jacrev(numbers, argnums=places)(*point)
    sizes = (1e-4, 1e-2, 1.0, 1e-3)
    for k, (a, b) in enumerate(zip(forward, reverse, strict=True)):
        assert_close(a, b, rtol=1e-8, atol=1e-8 * float(a.abs().max()))
        way = sizes[k] * torch.linspace(1.0, 2.0, max(point[k].numel(), 1), dtype=torch.float64).reshape(point[k].shape)

        def moved(s: float, k: int = k, way: Tensor = way) -> Tensor:
            return numbers(*(x + s * way if i == k else x for i, x in enumerate(point))).detach()

        difference = (8.0 * (moved(1.0) - moved(-1.0)) - (moved(2.0) - moved(-2.0))) / 12.0
        along = (a * way).flatten(1).sum(1) if way.dim() else a * way
        assert_close(along, difference, rtol=0, atol=1e-6 * float(difference.abs().max()))


def test_the_coefficient_is_a_design_variable():
    """Tip of a free bar, L alpha T: its derivative is L T."""
    beam = bar(3, metal(mbd.variable(ALPHA)))
    place = beam.equilibrium(temperature=30.0).nodes[-1, 0]
    (slope,) = torch.autograd.grad(place, beam.get_parameter("section.alpha"))
    assert float(slope) == pytest.approx(LENGTH * 30.0, rel=1e-9)


def test_bad_changes_are_named():
    bare: Callable[[], mbd.ExactBeam] = lambda: bar(2, mbd.GivenSection(coupled(), PLANE))  # noqa: E731
    for beam, changes, path in (
        (bar(), {"temperature": float("nan")}, "temperature"),
        (bar(), {"temperature": [1.0, 2.0]}, "temperature"),
        (bar(), {"gradient": "hot"}, "gradient"),
        (bar(), {"moisture": 0.1}, "coefficient of moisture expansion"),
        (bare(), {"temperature": 1.0}, "alpha"),
    ):
        arguments: dict[str, Any] = changes
        with refused(path):
            beam.equilibrium(**arguments)
    assert bare().equilibrium(temperature=0.0).status == "ok"
