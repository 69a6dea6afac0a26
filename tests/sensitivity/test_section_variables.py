"""Dimensions of sections as design variables: walls, widths, heights and radii."""

from __future__ import annotations

import math

import pytest
import torch
from torch import nn
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import tensor
from tests.refused import refused
from tests.sensitivity.number_cases import beam, check, check_native, hung, ply
from torchmbd.fem.sections import Section

V = mbd.variable
METAL = mbd.sections.Orthotropic.isotropic(7e9, 0.3, 2700.0)
ANGLES = mbd.deg([20, -50])
STRENGTH = mbd.Strength(2e6, 1.2e6, 5e4, 2e5, 7e4)

SECTIONS = {
    "strip": lambda: mbd.sections.strip(V(0.02), ply(), ANGLES, V(1e-3), cells=(3, 1)),
    "rectangle": lambda: mbd.sections.rectangle(V(0.02), V(0.01), ply(), ANGLES, cells=(3, 2)),
    "box": lambda: mbd.sections.box(
        V(0.02),
        V(0.012),
        ply(strength=STRENGTH),
        nn.Parameter(ANGLES),
        nn.Parameter(tensor(1e-3, 2e-3)),
        cells=(3, 2, 1),
    ),
    "tube": lambda: mbd.sections.tube(V(0.01), ply(), ANGLES, V(1e-3), cells=(8, 1)),
    "circle": lambda: mbd.sections.circle(V(0.01), ply(), 0.3, cells=(1, 1)),
    "i_section": lambda: mbd.sections.i_section(
        V(0.02), V(0.03), ply(), dict.fromkeys(("top", "web", "bottom"), (0.3,)), V(1e-3), cells=(2, 3, 1)
    ),
    "c_section": lambda: mbd.sections.c_section(V(0.02), V(0.03), ply(), ANGLES, V(1e-3), cells=(2, 1)),
    "hat_section": lambda: mbd.sections.hat_section(V(0.03), V(0.012), V(0.02), ply(), (0.3,), V(1e-3), cells=(2, 1)),
    "t_section": lambda: mbd.sections.t_section(
        V(0.02), V(0.03), ply(), {"top": (0.3,), "web": (0.1,)}, V(1e-3), cells=(2, 1)
    ),
}
BENT = [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.2, 0.05, 0.0], [0.25, 0.1, 0.05], [0.3, 0.1, 0.1]]


def dimensions(section: Section) -> list[str]:
    return [name for name, _ in section.named_parameters() if name != "angles"]


@pytest.mark.thorough
@pytest.mark.parametrize("case", SECTIONS)
def test_a_section_of_other_dimensions_is_that_section(case):
    """Forward and reverse by every dimension against differences; numbers are those of a section that is made anew."""
    made = SECTIONS[case]()
    given = {name: x.detach().clone() for name, x in made.named_parameters()}
    weights = torch.randn(3, 6, 6, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    for name in dimensions(made):
        for part in (Section.stiffness, Section.mass):

            def f(x: torch.Tensor, name: str = name, part=part) -> torch.Tensor:
                return _called(made, part, {name: x})

            x = given[name]
            forward = torch.func.jvp(f, (x,), (torch.ones_like(x),))[1]
            reverse = [torch.autograd.functional.vjp(f, x, W)[1].sum() for W in weights]
            h = 2e-3 * float(x.max())
            one, two, four = ((f(x + k * h) - f(x - k * h)) / (2.0 * k * h) for k in (1, 2, 4))
            first, second = (4.0 * one - two) / 3.0, (4.0 * two - four) / 3.0
            expected = (16.0 * first - second).detach() / 15.0
            scale = f(x).detach().diagonal().sqrt() / x.max()  # symmetric entries, of both units
            scale = scale * scale[:, None]
            for W, result in zip(weights, reverse, strict=True):
                assert_close(result, (W * forward).sum(), rtol=0, atol=1e-8 * float((W.abs() * scale).sum()))
            assert_close(forward / scale, expected / scale, rtol=0, atol=1e-6)
    for name, x in made.named_parameters():
        if name != "angles":
            x.data *= 1.1
    assert_close(made.stiffness(), _copied(made).stiffness(), rtol=1e-9, atol=1e-6)


def _copied(made: Section) -> Section:
    mesh = mbd.sections.SectionMesh(made.nodes.detach(), made.mesh.elements, made.mesh.layer, made.mesh.plane_angle)
    return Section(mesh, made._plies.layers, made.angles.detach())


class _Part(nn.Module):
    def __init__(self, section: Section, part):
        super().__init__()
        self.section, self.part = section, part

    def forward(self) -> torch.Tensor:
        return self.part(self.section)


def _called(section: Section, part, values: dict[str, torch.Tensor]) -> torch.Tensor:
    return torch.func.functional_call(_Part(section, part), {f"section.{k}": x for k, x in values.items()})


def test_closed_forms_of_a_tube():
    """Area and polar moment of a thin metal tube by radius and wall, on the mesh's chords."""
    result = mbd.sections.tube(V(0.02), METAL, [0.0], V(1e-3), cells=(96, 1))
    r, t = result.get_parameter("radius"), result.get_parameter("thickness")
    by = torch.autograd.grad(result.mass()[0, 0], (r, t))
    R, T = r.detach(), t.detach()
    assert_close(torch.stack(by), 2700.0 * 2.0 * math.pi * torch.stack([T, R - T]), rtol=2e-3, atol=0)
    by = torch.autograd.grad(result.stiffness()[3, 3], (r, t))
    G = 7e9 / 2.6
    expected = G * 2.0 * math.pi * torch.stack([R**3 - (R - T) ** 3, (R - T) ** 3])
    assert_close(torch.stack(by), expected, rtol=5e-3, atol=0)


@pytest.mark.thorough
@pytest.mark.parametrize("case", ["box", "tube"])
def test_gradients_of_a_motion(case):
    line = mbd.BeamLine(BENT)
    system = hung(beam(SECTIONS[case](), line=line), "start")
    check(system, [f"rod.section.{name}" for name in dimensions(system.body("rod").parts["section0"].section)])


@pytest.mark.thorough
def test_gradients_of_the_failure_index():
    def failing(system, designs, **options):
        motion = mbd.simulate(system, 0.02, steps=6, iterations=(8, 4), designs=designs, **options)
        return mbd.Mean(mbd.PlyFailure("rod"))(motion)

    system = hung(beam(SECTIONS["box"](), line=mbd.BeamLine(BENT)), "start")
    names = ["rod.section.width", "rod.section.thickness"]
    check(system, names, failing, steps=dict.fromkeys(names, 1e-4))


@pytest.mark.thorough
def test_both_backends(native):
    system = hung(beam(SECTIONS["tube"](), line=mbd.BeamLine(BENT)), "start")
    check_native(system, ["rod.section.radius", "rod.section.thickness"])


@pytest.mark.thorough
def test_a_problem_with_bounds_on_the_wall():
    system = hung(beam(SECTIONS["tube"](), line=mbd.BeamLine(BENT)), "start")
    name = "rod.section.thickness"
    bound = mbd.Frequency("rod") >= 0.9 * float(mbd.Frequency("rod")(mbd.simulate(system, 0.01, steps=2)))
    problem = mbd.Problem(
        system, 0.02, mbd.Mass("rod"), steps=6, variables=[name], bounds={name: (2e-4, 3e-3)}, subject_to=[bound]
    )
    result = mbd.optimize(problem, method="slsqp", max_iterations=4)
    assert result.x[0] < 0.9e-3
    assert result.value < 0.9 * problem.evaluate(problem.start[None], False)[0].objective


def test_walls_that_do_not_fit_are_refused():
    system = hung(beam(SECTIONS["tube"]()), "start")
    with refused("rod.section.thickness"):
        mbd.simulate(system, 0.01, steps=2, designs={"rod.section.thickness": tensor(-1e-3)})
    with refused("dimensions"):
        mbd.simulate(system, 0.01, steps=2, designs={"rod.section.thickness": tensor(6e-3)})
