"""GXBeam's notebook of sensitivities: a cantilever under a tip moment M = lambda pi E I / L, at lambda = 1.

    u_x / L = sin(a) / a - 1,  u_y / L = (1 - cos(a)) / a,  a = pi lambda        in closed form: du/dlambda = -L, -2 L / pi

T. McDonnell, A. Ning, GXBeam.jl, docs/src/literate/sensitivities.jl: du/dlambda = -12.025539968259286, -7.659921842013467
inches of a beam of 12 inches in 16 elements. Ours bend into arcs exactly; GXBeam's are midpoint rules in Wiener and
Milenkovic's parameters c = 4 tan(angle / 4), whose error with the square of the elements' length is the whole difference.
"""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd

LENGTH, E, SIDE = 12.0, 30e6, 1.0  # inches, lb / in2; units that agree are as good as those of SI
INERTIA = SIDE**4 / 12.0
PUBLISHED = torch.tensor([-12.025539968259286, -7.659921842013467], dtype=torch.float64)


def tip(beam: mbd.ExactBeam, load: Tensor) -> Tensor:
    """Displacement of the tip in the plane [2] under lambda []."""
    moment = load * math.pi * E * INERTIA / LENGTH
    state = beam.equilibrium({"end": torch.cat([load.new_zeros(5), moment[None]])})
    assert state.status == "ok"
    return state.nodes[-1, :2] - load.new_tensor([LENGTH, 0.0])


def midpoints(load: Tensor, elements: int) -> Tensor:
    """The same by GXBeam's elements: c_2 - c_1 = h kappa (1 + c^2 / 16), u_2 - u_1 = h (cos(angle) - 1, sin(angle)) at the mean
    c = (c_1 + c_2) / 2."""
    h, c, u = LENGTH / elements, 0.0 * load, load.new_zeros(2)
    bend = h * load * math.pi / LENGTH
    for _ in range(elements):
        # bend m^2 / 16 - 2 m + 2 c + bend = 0 of the mean m
        mean = (1.0 - torch.sqrt(1.0 - bend / 16.0 * (2.0 * c + bend))) / (bend / 16.0)
        angle, c = 4.0 * torch.atan(mean / 4.0), 2.0 * mean - c
        u = u + h * torch.stack([angle.cos() - 1.0, angle.sin()])
    return u


def test_sensitivities_of_the_tip():
    EA, EI = E * SIDE**2, E * INERTIA
    K, mass = torch.diag(torch.tensor([EA, EA, EA, EI, EI, EI], dtype=torch.float64)), torch.eye(6, dtype=torch.float64)
    section = mbd.GivenSection(K, mass)  # neither shear nor twist nor mass take part
    beam = mbd.ExactBeam("cantilever", mbd.BeamLine.straight(LENGTH, 16), section)
    one = torch.tensor(1.0, dtype=torch.float64)
    exact = torch.tensor([-1.0, -2.0 / math.pi], dtype=torch.float64) * LENGTH
    u = tip(beam, one)
    assert_close(u, torch.tensor([-LENGTH, 2.0 * LENGTH / math.pi], dtype=torch.float64), rtol=1e-9, atol=0.0)
    for transform in (torch.func.jacrev, torch.func.jacfwd):
        assert_close(transform(lambda x: tip(beam, x))(one), exact, rtol=1e-9, atol=0.0)
    assert_close(exact, PUBLISHED, rtol=3e-3, atol=0.0)


def test_the_published_numbers_are_those_of_16_elements_and_converge_to_the_closed_form():
    one = torch.tensor(1.0, dtype=torch.float64)
    slopes = {n: torch.func.jacrev(lambda x, n=n: midpoints(x, n))(one) for n in (16, 32, 64)}
    assert_close(slopes[16], PUBLISHED, rtol=1e-9, atol=0.0)
    exact = torch.tensor([-LENGTH, -2.0 * LENGTH / math.pi], dtype=torch.float64)
    for coarse, fine in ((16, 32), (32, 64)):
        assert ((slopes[coarse] - exact) / (slopes[fine] - exact)).tolist() == pytest.approx([4.0, 4.0], rel=1e-2)
