"""The slider-crank with a beam for a rod: one stiffened body against a chain of eight, whose frames turn with the beam.

At 124.8 rad/s the inertia of slider and rod pulls and pushes with a tenth of the Euler load: without stiffening the peak of the
strain energy is 39 % too large. The chain needs no stiffening to converge; it has it here, which makes it converge faster.
"""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch

import torchmbd as mbd
from torchmbd.examples.slider_crank import CRANK, DEPTH, DURATION, ROD, SLIDER_MASS, SPEED, THICKNESS


def peak(count: int, stiffening: bool) -> float:
    """Largest strain energy of a rod of so many bodies [J]."""
    b, h = DEPTH, THICKNESS
    section = mbd.GivenSection.isotropic(
        E=16e9, nu=0.3, density=1586.0, area=b * h, Iyy=b * h**3 / 12, Izz=h * b**3 / 12, J=b * h**3 / 3
    )
    length, ground = ROD / count, mbd.Ground()
    rods = [
        mbd.FlexibleBody.beam(
            f"rod{k}",
            mbd.BeamLine.straight(length, 8 if count == 1 else 2),
            section,
            modes=4 if count == 1 else 3,
            position=(CRANK + length * (k + 0.5), 0, 0),
            orientation=(0, 0, 1),
            reference="center" if count == 1 else "start",
            reduction="craig-bampton",
            interface=("start", "end") if count == 1 else ("end",),
            stiffening=stiffening,
        )
        for k in range(count)
    ]
    crank = mbd.RigidBody("crank", mass=0.1, inertia=(1e-4, 1e-4, 1e-4))
    slider = mbd.RigidBody("slider", SLIDER_MASS, (1e-4, 1e-4, 1e-4), position=(CRANK + ROD, 0, 0))
    joints = [
        mbd.Revolute(ground.at(), crank.at(), axis="z"),
        mbd.Drive(ground, crank, axis="z", speed=SPEED),
        mbd.Spherical(crank.at(CRANK, 0, 0), rods[0].at("start")),
        *(mbd.Fixed(a.at("end"), b.at("start")) for a, b in pairwise(rods)),
        mbd.Universal(rods[-1].at("end"), slider.at(), axes="yz"),
        mbd.Prismatic(ground.at(), slider.at(), axis="x"),
    ]
    system = mbd.System([crank, *rods, slider], joints, truncation=None)
    motion = mbd.simulate(system, DURATION, steps=1200, backend="native").require_ok()
    return float(torch.stack([motion.body(rod.name).strain_energy[0] for rod in rods]).sum(0).max())


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore:body 'rod")
def test_one_stiffened_body_is_a_chain(native: None):
    chain, one, linear = peak(8, True), peak(1, True), peak(1, False)
    assert one == pytest.approx(chain, rel=2e-2)
    assert linear > 1.3 * chain
