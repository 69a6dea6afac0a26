"""Nodes of beams as design variables: a length, the nodes themselves, and torch functions of parameters."""

from __future__ import annotations

import copy
import pickle
from functools import partial

import pytest
import torch
from torch import Tensor, nn
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import GRAVITY, box, tensor
from tests.refused import refused
from tests.sensitivity.number_cases import GROUND, beam, check, check_native, hung, number, ply

pytestmark = pytest.mark.usefixtures("compiled")

V = mbd.variable
BENT = tensor(0.0, 0.0, 0.0, 0.1, 0.0, 0.0, 0.2, 0.05, 0.0, 0.25, 0.1, 0.05, 0.3, 0.1, 0.1).reshape(5, 3)


class Bow(nn.Module):
    """A line that rises by `height` over `length`."""

    def __init__(self, length: nn.Parameter):
        super().__init__()
        self.length, self.height = length, nn.Parameter(tensor(0.03)[0])

    def forward(self) -> Tensor:
        s = torch.linspace(0.0, 1.0, 5, dtype=torch.float64)
        return torch.stack([self.length * s, self.height * s * s, 0.0 * s], -1)


def section() -> mbd.sections.Section:
    return mbd.sections.strip(0.02, ply(), mbd.deg([20, -50]), V(1e-3), cells=(3, 1))


def arm(line: mbd.BeamLine) -> mbd.System:
    """On a hinge, with a body on a spring at its end."""
    system = hung(beam(section(), line=line, orientation=(0.0, 1.0, 0.3)), "start")
    (rod,) = system.bodies
    ball = box("ball", position=(0.4, 0.1, 0.2))
    spring = mbd.SpringDamper(rod.at("end", offset=(0.0, 0.0, 0.02)), ball.at(0.1, 0.0, 0.0), stiffness=20.0)
    return mbd.System([rod, ball], system.joints, [spring], gravity=GRAVITY)


LINES = {
    "length": lambda: mbd.BeamLine.straight(V(0.3), elements=4),
    "nodes": lambda: mbd.BeamLine(nn.Parameter(BENT.clone())),
    "module": lambda: mbd.BeamLine(Bow(V(0.3))),
}
NAMES = {"length": ["length"], "nodes": ["nodes"], "module": ["length", "height"]}


@pytest.mark.thorough
@pytest.mark.parametrize("case", LINES)
def test_gradients(case):
    names = [f"rod.line.{name}" for name in NAMES[case]]
    check(arm(LINES[case]()), [*names, "rod.section.thickness"], f=partial(number, steps=24), iterations=(14, 10))


@pytest.mark.thorough
def test_both_backends(native):
    check_native(arm(LINES["module"]()), ["rod.line.length", "rod.line.height"])


@pytest.mark.thorough
def test_a_design_is_a_body_of_its_own():
    """A lane moves as the body that is built with its length; places, mass and section forces with it."""
    system, own = arm(LINES["length"]()), arm(mbd.BeamLine.straight(0.33, elements=4))
    both = mbd.simulate(system, 0.02, steps=6, designs={"rod.line.length": tensor(0.3, 0.33)})
    alone = mbd.simulate(own, 0.02, steps=6)
    a, b = both.body("rod"), alone.body("rod")
    for x, y in ((a.nodes, b.nodes), (a.at("end").acceleration, b.at("end").acceleration), (a.mass, b.mass)):
        assert_close(x[1], y[0], rtol=1e-8, atol=1e-9)
    forces = [mbd.SectionHistory(motion, "rod").forces() for motion in (both, alone)]
    assert_close(forces[0][1], forces[1][0], rtol=1e-6, atol=1e-7 * float(forces[1].abs().max().detach()))


@pytest.mark.thorough
def test_closed_forms_of_a_cantilever():
    """Mass grows with the length, the frequency with its power -2 where the section is slender."""
    line = mbd.BeamLine.straight(V(1.0), elements=16)
    metal = mbd.GivenSection.isotropic(7e10, 0.3, 2700.0, 1e-4, 1e-9, 2e-9, 2e-9)
    rod = mbd.FlexibleBody.beam("rod", line, metal, modes=2, reference="start")
    system = mbd.System([rod], [mbd.Fixed(GROUND.at(), rod.at("start"))])
    motion = mbd.simulate(system, 1e-3, steps=2)
    L = system.get_parameter("rod.line.length")
    (mass,) = torch.autograd.grad(mbd.Mass()(motion).sum(), L, retain_graph=True)
    first = mbd.Frequency("rod")(motion)
    (by,) = torch.autograd.grad(first.sum(), L)
    assert_close(mass, tensor(0.27)[0], rtol=1e-12, atol=0)
    assert_close(by, -2.0 * first[0].detach(), rtol=2e-3, atol=0)


@pytest.mark.thorough
def test_one_length_serves_the_body_and_a_joint_beside_it():
    """A closed loop follows: the shared parameter is one variable."""
    L = V(0.3)
    rod = beam(section(), line=mbd.BeamLine.straight(L, elements=2))
    stick = box("stick", position=tuple((rod.axes @ tensor(0.15, 0.0, 0.0)).tolist()), axes=rod.axes)
    joints = [
        mbd.Revolute(GROUND.at(), rod.at("start"), name="foot"),
        mbd.Spherical(rod.at("end"), stick.at(L, 0.0, 0.0), name="tip"),
    ]
    system = mbd.System([rod, stick], joints, gravity=GRAVITY)
    assert [n for n, _ in system.named_parameters() if n.endswith(("length", ".x"))] == ["rod.line.length"]
    check(system, ["rod.line.length"])


@pytest.mark.thorough
def test_a_system_is_copied_and_pickled():
    system = arm(LINES["length"]())
    for again in (copy.deepcopy(system), pickle.loads(pickle.dumps(system))):
        again.get_parameter("rod.line.length").data.mul_(1.1)
        result = mbd.simulate(again, 0.01, steps=3).body("rod").nodes
        expected = mbd.simulate(system, 0.01, steps=3, designs={"rod.line.length": tensor(0.33)}).body("rod").nodes
        assert_close(result, expected, rtol=0, atol=1e-10)


def test_what_is_refused():
    computed = 2.0 * nn.Parameter(BENT.clone())
    with refused("nodes"):
        mbd.BeamLine(computed)
    with refused("nodes"):
        mbd.BeamLine(nn.Linear(1, 1).requires_grad_(False).apply(lambda m: setattr(m, "forward", lambda: 1.0)))
    with refused("nodes"):
        mbd.BeamLine(nn.Parameter(BENT[:2].clone()), middles=[[0.05, 0.01, 0.0]])
    rod = beam(section(), line=mbd.BeamLine.straight(V(0.3), elements=4))
    with refused("rod.node"):
        rod.at([0, 1])
    system = arm(LINES["length"]())
    with refused("rod.line.length"):
        mbd.simulate(system, 0.01, steps=2, designs={"rod.line.length": tensor(-0.1)})
