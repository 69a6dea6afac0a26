"""BeamElement: an arc in closed form, gradients by its stiffness on both backends, and what it refuses."""

from __future__ import annotations

import pytest
import torch
from torch import nn
from torch.testing import assert_close

import torchmbd as mbd
from tests.multibody.equations.test_beams import SECTION, chain, coupled
from tests.refused import refused

GROUND = mbd.Ground()


def tip(**given) -> mbd.RigidBody:
    return mbd.RigidBody("tip", 1.0, (0.01, 0.01, 0.01), position=(0.5, 0, 0), **given)


@pytest.mark.thorough
def test_rolls_up_to_an_arc():
    """A moment M turns one element of length L by M L / E I, 0.6 rad: the tip of an arc."""
    body, angle = tip(), 0.6
    strip = mbd.BeamElement(GROUND.at(), body.at(), SECTION.stiffness() / 0.5)
    moment = angle * float(SECTION.stiffness()[5, 5]) / 0.5
    rest = mbd.equilibrium(mbd.System([body], [], [strip, mbd.Torque(body.at(), (0, 0, moment))]))
    radius = torch.tensor(0.5 / angle, dtype=torch.float64)
    turned = torch.tensor([angle], dtype=torch.float64)
    expected = radius * torch.cat([turned.sin(), 1.0 - turned.cos(), torch.zeros(1, dtype=torch.float64)])
    assert_close(rest.body("tip").r[0, 0], expected, atol=1e-9, rtol=0)


def place(K: torch.Tensor, backend: str, gradients: str = "auto") -> torch.Tensor:
    system = chain(1e-3, nn.Parameter(coupled()))
    motion = mbd.simulate(system, 0.2, steps=40, designs={"first.stiffness": K}, backend=backend, gradients=gradients)
    return motion.body("c").r[:, -1]


@pytest.mark.thorough
@pytest.mark.parametrize("backend", ["eager", "native"])
def test_gradients_by_stiffness(backend):
    K, h = coupled(), 1e-3
    along = torch.zeros(6, 6, dtype=torch.float64)
    along[5, 5], along[0, 4], along[4, 0] = 1.0, 0.5, 0.5
    near = torch.stack([K - 2 * h * 10 * along, K - h * 10 * along, K + h * 10 * along, K + 2 * h * 10 * along])
    x = place(near, backend, "none")
    expected = (8.0 * (x[2] - x[1]) - (x[3] - x[0])) / (12.0 * h * 10)
    for gradients in ("forward", "reverse"):
        design = K[None].clone().requires_grad_()
        result = [torch.autograd.grad(y, design, retain_graph=True)[0] for y in place(design, backend, gradients)[0]]
        by = torch.stack([(g[0] * along).sum() for g in result])
        assert_close(by, expected, rtol=1e-6, atol=1e-6 * float(expected.abs().max()))


@pytest.mark.thorough
def test_refusals():
    K = SECTION.stiffness()
    with refused("beamelement_ground_tip.stiffness"):
        mbd.BeamElement(GROUND.at(), tip().at(), torch.diag(torch.tensor([1.0, 1, 1, -1, 1, 1])))
    with refused("beamelement_ground_tip.stiffness"):
        mbd.BeamElement(GROUND.at(), tip().at(), K + torch.ones(6, 6).triu(1))
    with refused("beamelement_ground_tip.damping"):
        mbd.BeamElement(GROUND.at(), tip().at(), K, damping=-1.0)
    with refused("beamelement_ground_tip"):
        mbd.BeamElement(GROUND.at(), tip().at(mbd.variable(0.1)), K)
    with refused("beamelement_ground_arm"):
        mbd.BeamElement(GROUND.at(), mbd.examples.arm().body("arm").at("right"), K)


def test_it_holds_a_body_and_its_stiffness_is_no_number_of_a_law():
    """The body is not listed as free, and the data of the motion have the stiffness once."""
    body, stiffness = tip(), nn.Parameter(coupled())
    system = mbd.System([body], [], [mbd.BeamElement(GROUND.at(), body.at(), stiffness, name="strip")])
    assert system.describe().separate == ()
    assert "law strip" not in system.dynamics().data
