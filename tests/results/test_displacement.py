"""The warning of large displacements: of a stiffened beam beyond its buckling load, not of one below it."""

from __future__ import annotations

import warnings

import pytest
import torch

import torchmbd as mbd
from torchmbd.results.displacement import displacement_ratios


def pushed(force: float) -> mbd.System:
    """A cantilever of Euler's load 74 N under a force at its end, along it and a little across."""
    stiffness = torch.diag(torch.tensor([2e5, 1e5, 1e5, 20.0, 30.0, 40.0], dtype=torch.float64))
    section = mbd.GivenSection(stiffness, torch.diag(torch.tensor([2.0, 2, 2, 3e-3, 1e-3, 2e-3])))
    body = mbd.FlexibleBody.beam(
        "arm", mbd.BeamLine.straight(1.0, 4), section, modes=4, reference="start", stiffening=True
    )
    push = mbd.Force(body.at("end"), (-force, 0.0, 0.01))
    return mbd.System([body], [mbd.Fixed(mbd.Ground().at(), body.at("start"))], [push], truncation=None)


@pytest.mark.thorough
def test_a_buckled_beam_is_named():
    with pytest.warns(UserWarning, match="body 'arm' is displaced by .* of its size"):
        motion = mbd.simulate(pushed(200.0), 0.6, steps=60, backend="eager", gradients="none")
    end = motion.body("arm").at("end").position[0, :, 2].abs().max()
    assert displacement_ratios(motion)["arm"].tolist() == [pytest.approx(0.84 * end.item(), rel=0.1)]


@pytest.mark.thorough
def test_below_the_buckling_load_nothing_is_said():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mbd.simulate(pushed(50.0), 0.6, steps=60, backend="eager", gradients="none")
        mbd.equilibrium(pushed(50.0))


@pytest.mark.thorough
def test_equilibria_under_transforms():
    system = pushed(1.0)
    K = dict(system.named_parameters())["arm.section.matrix"].detach()

    def tip(x: torch.Tensor) -> torch.Tensor:
        rest = mbd.equilibrium(system, designs={"arm.section.matrix": (K * x)[None]})
        return rest.body("arm").at("end").position[0, 0, 2]

    by = torch.func.jacfwd(tip)(torch.ones((), dtype=torch.float64))
    assert by.item() == pytest.approx(-tip(torch.ones((), dtype=torch.float64)).item(), rel=0.05)
