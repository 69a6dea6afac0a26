"""Exact beams that several tests share."""

from __future__ import annotations

import math

import torch
from torch import Tensor

import torchmbd as mbd


def matrix(*diagonal: float) -> Tensor:
    return torch.diag(torch.tensor(diagonal, dtype=torch.float64))


PLANE = matrix(1.0, 1.0, 1.0, 2e-4, 1e-4, 1e-4)  # mass per length


def given(*diagonal: float, mass: Tensor = PLANE) -> mbd.GivenSection:
    """A section without couplings: E A, G A_y, G A_z, G J, E I_y, E I_z."""
    return mbd.GivenSection(matrix(*diagonal), mass)


def coupled() -> Tensor:
    """A stiffness in which all strains are coupled."""
    A = torch.randn(6, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    size = torch.tensor([30.0, 10.0, 10.0, 1.0, 1.0, 1.0], dtype=torch.float64).sqrt()
    return (A @ A.T + 6.0 * torch.eye(6, dtype=torch.float64)) * size[:, None] * size


def bend(elements: int) -> mbd.ExactBeam:
    """Bathe's bend: 45 degrees of a circle of 100, section 1 x 1, E = 1e7, G = 5e6; torsion as Simo and Vu-Quoc have it."""
    section = given(1e7, 5e6, 5e6, 5e6 / 6.0, 1e7 / 12.0, 1e7 / 12.0)
    return mbd.ExactBeam("bend", mbd.BeamLine.arc(100.0, math.pi / 4.0, elements), section)


def twisted(elements: int) -> mbd.ExactBeam:
    """The twisted beam of BeamDyn: 10 m, 90 degrees, section 0.5 x 0.25 m of E = 200 GPa, G = 79.3 GPa."""
    twist = torch.linspace(0.0, math.pi / 2.0, elements + 1, dtype=torch.float64)
    section = given(25e9, 8.2604167e9, 8.2604167e9, 0.141872656e9, 0.520833e9, 0.130208333e9)
    line = mbd.BeamLine.straight(10.0, elements)
    return mbd.ExactBeam("blade", line, section, twist=torch.stack([twist[:-1], twist[1:]], 1))
