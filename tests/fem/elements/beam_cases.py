"""Exact reference of a prismatic beam: its first-order equations along x, integrated by the matrix exponential.

State (u, f): displacement and rotation, force and moment of the section; with E f = (0, e_x cross F),

    u' = E' u + S f            kinematics of a shear-flexible beam
    f' = -E f - omega^2 M u    equilibrium with inertia
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from tests.fem.sections.section_cases import general_section
from torchmbd.fem.elements.beam_section import GivenSection

E = np.zeros((6, 6))
E[4, 2], E[5, 1] = -1.0, 1.0


def coupled_section() -> GivenSection:
    """All 21 stiffnesses at work, eccentric center of mass, products of inertia; density 1600 kg/m3."""
    result = general_section()
    return GivenSection(result.stiffness().detach(), 1600.0 * result.mass())


def transfer(K: torch.Tensor, M: torch.Tensor, length: float, omega: float = 0.0) -> np.ndarray:
    """State at the end from the state at the start."""
    S = np.linalg.inv(K.numpy())
    return expm(length * np.block([[E.T, S], [-(omega**2) * M.numpy(), -E]]))


def tip_flexibility(K: torch.Tensor, length: float) -> np.ndarray:
    """Displacements at the free end of a cantilever for unit forces and moments there."""
    T = transfer(K, torch.zeros(6, 6), length)
    return T[:6, 6:] @ np.linalg.inv(T[6:, 6:])


def twisted_flexibility(K: torch.Tensor, length: float, root: float, tip: float) -> np.ndarray:
    """The same of a section whose axes turn evenly about the line, from the angle at the root to that at the tip [rad]."""
    S = np.linalg.inv(K.numpy())

    def rate(x: float, state: np.ndarray) -> np.ndarray:
        angle = root + (tip - root) * x / length
        c, s = np.cos(angle), np.sin(angle)
        R = np.kron(np.eye(2), [[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
        whole = np.block([[E.T, R @ S @ R.T], [np.zeros((6, 6)), -E]])
        return (whole @ state.reshape(12, 12)).ravel()

    T = solve_ivp(rate, (0.0, length), np.eye(12).ravel(), "DOP853", rtol=1e-12, atol=1e-16).y[:, -1].reshape(12, 12)
    return T[:6, 6:] @ np.linalg.inv(T[6:, 6:])


def cantilever_residual(K: torch.Tensor, M: torch.Tensor, length: float, omega: float) -> float:
    """Zero at the circular frequencies of a cantilever: smallest over largest singular value of the end condition."""
    free = transfer(K, M, length, omega)[6:, 6:]
    d = np.sqrt(np.diag(K.numpy()))
    return float(np.linalg.det(free / d[:, None] * d))
