"""Exact reference of a prismatic beam: its first-order equations along x, integrated by the matrix exponential.

State (u, f): displacement and rotation, force and moment of the section; with E f = (0, e_x cross F),

    u' = E' u + S f            kinematics of a shear-flexible beam
    f' = -E f - omega^2 M u    equilibrium with inertia
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.linalg import expm

from tests.sections.section_cases import general_section
from torchmbd.elements.beam_section import GivenSection

E = np.zeros((6, 6))
E[4, 2], E[5, 1] = -1.0, 1.0


def coupled_section() -> GivenSection:
    """All 21 stiffnesses at work, eccentric center of mass, products of inertia; density 1600 kg/m3."""
    made = general_section()
    return GivenSection(made.stiffness().detach(), 1600.0 * made.mass())


def transfer(K: torch.Tensor, M: torch.Tensor, length: float, omega: float = 0.0) -> np.ndarray:
    """State at the end from the state at the start."""
    S = np.linalg.inv(K.numpy())
    return expm(length * np.block([[E.T, S], [-(omega**2) * M.numpy(), -E]]))


def tip_flexibility(K: torch.Tensor, length: float) -> np.ndarray:
    """Displacements at the free end of a cantilever for unit forces and moments there."""
    T = transfer(K, torch.zeros(6, 6), length)
    return T[:6, 6:] @ np.linalg.inv(T[6:, 6:])


def cantilever_residual(K: torch.Tensor, M: torch.Tensor, length: float, omega: float) -> float:
    """Zero at the circular frequencies of a cantilever: smallest over largest singular value of the end condition."""
    free = transfer(K, M, length, omega)[6:, 6:]
    d = np.sqrt(np.diag(K.numpy()))
    return float(np.linalg.det(free / d[:, None] * d))
