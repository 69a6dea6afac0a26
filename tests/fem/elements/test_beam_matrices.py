"""The beam element: rigid motions, symmetry, exact solutions in space with any number of elements, axes, derivatives."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.func import jacfwd, jacrev, vmap
from torch.testing import assert_close

from tests.fem.elements.beam_cases import coupled_section, tip_flexibility
from tests.mechanisms import turned
from tests.refused import refused
from torchmbd.fem.elements.beam import BeamMatrices, section_particles
from torchmbd.fem.elements.beam_line import BeamLine

DIRECTION, ACROSS = (0.3, -0.8, 0.52), (0.2, 0.7, -0.4)


def solved(line, K, force, orientation=ACROSS):
    """Displacements of all nodes of a cantilever under a force at its end, mesh axes."""
    matrices = BeamMatrices(line, orientation)
    stiffness = matrices.stiffness(K[None]).dense()[6:, 6:]
    load = torch.zeros(len(stiffness), dtype=torch.float64)
    load[-6:] = force
    return matrices, torch.linalg.solve(stiffness, load).reshape(-1, 6)


@pytest.mark.parametrize("elements", [1, 2, 7, 40])
def test_coupled_cantilever_is_exact(elements):
    """Full 6 x 6, any direction in space, any number of elements: tip flexibility to 1e-9 of the exact one."""
    K, length = coupled_section().stiffness(), 1.3
    matrices, _ = solved(BeamLine.straight(length, elements, DIRECTION), K, torch.ones(6).double())
    stiffness = matrices.stiffness(K[None]).dense()[6:, 6:]
    turn = torch.block_diag(matrices.axes[0], matrices.axes[0])
    result = turn @ torch.linalg.inv(stiffness)[-6:, -6:] @ turn.T
    exact = tip_flexibility(K, length)
    d = 1 / np.sqrt(np.diag(exact))
    assert np.abs((result.numpy() - exact) * d[:, None] * d).max() < 1e-9


def test_unequal_elements_and_forces_along_the_beam():
    K, length = coupled_section().stiffness(), 1.3
    axis = torch.tensor(DIRECTION, dtype=torch.float64) / torch.tensor(DIRECTION, dtype=torch.float64).norm()
    nodes = torch.tensor([0.0, 0.1, 0.15, 0.8, 1.3], dtype=torch.float64)[:, None] * axis
    load = torch.tensor([30.0, -50.0, 20.0, 4.0, -7.0, 5.0], dtype=torch.float64)
    matrices, u = solved(BeamLine(nodes), K, load)
    _, tip = solved(BeamLine.straight(length, 1, DIRECTION), K, load)
    assert_close(u[-1], tip[-1], rtol=1e-8, atol=0)
    forces = matrices.forces(K[None], torch.cat([torch.zeros(1, 6).double(), u])[..., None])[:, 1, :, 0]
    turn = torch.block_diag(matrices.axes[0], matrices.axes[0])
    for k, at in enumerate(nodes[1:]):
        arm = torch.linalg.cross(nodes[-1] - at, load[:3])
        exact = turn @ torch.cat([load[:3], load[3:] + arm])
        assert_close(forces[k], exact, rtol=0, atol=1e-7)


def test_rigid_motions_make_no_force():
    line = BeamLine([[0, 0, 0], [0.3, 0.1, 0], [0.5, 0.5, 0.2], [0.1, 0.6, 0.9]], [[0, 1], [1, 2], [3, 2]])
    K = BeamMatrices(line, ACROSS).stiffness(coupled_section().stiffness()[None]).dense()
    motion = torch.zeros(24, 6, dtype=torch.float64)
    for j in range(3):
        e = torch.eye(3, dtype=torch.float64)[j]
        motion[j::6, j] = 1.0
        for k, x in enumerate(line.nodes):
            motion[6 * k : 6 * k + 3, 3 + j] = torch.linalg.cross(e, x)
        motion[3 + j :: 6, 3 + j] = 1.0
    scale = K.diagonal().max()
    assert float((K @ motion).abs().max()) < 1e-13 * float(scale)
    assert_close(K, K.T, rtol=0, atol=1e-14 * float(scale))
    assert int((torch.linalg.eigvalsh(K) > 1e-9 * scale).sum()) == 18


def test_the_body_may_lie_anywhere():
    """Turned nodes and orientation: K turns with them."""
    K, R = coupled_section().stiffness()[None], turned(0.4, -1.1, 0.7)
    line = BeamLine([[0, 0, 0], [0.3, 0.1, 0], [0.5, 0.5, 0.2]])
    moved = BeamLine(line.nodes @ R.T + torch.tensor([1.0, 2.0, -0.5], dtype=torch.float64))
    here = BeamMatrices(line, ACROSS).stiffness(K).dense()
    there = BeamMatrices(moved, R @ torch.tensor(ACROSS, dtype=torch.float64)).stiffness(K).dense()
    turn = torch.block_diag(*[R] * 6)
    assert_close(there, turn @ here @ turn.T, rtol=0, atol=1e-12 * float(here.abs().max()))


def test_axes_follow_the_orientation():
    line = BeamLine([[0, 0, 0], [1.0, 0, 0], [1.0, 0, 2.0]])
    axes = BeamMatrices(line, (0.0, 1.0, 0.5)).axes
    r = 0.5 / np.hypot(1.0, 0.5)
    assert_close(axes[0], torch.tensor([[1, 0, 0], [0, 2 * r, r], [0, -r, 2 * r]], dtype=torch.float64))
    assert_close(axes[1], torch.tensor([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]], dtype=torch.float64))
    with refused("orientation"):
        BeamMatrices(line, (0.0, 0.0, 1.0))
    with refused("orientation"):
        BeamMatrices(line, (0.0, 1.0))


def test_particles_have_the_mass_of_the_section():
    """The sum over the particles of [1, -arm~; arm~, -arm~ arm~] is the mass of the elements, at their ends, in mesh axes."""
    M, line = coupled_section().mass(), BeamLine.straight(1.3, 3, DIRECTION)
    matrices = BeamMatrices(line, ACROSS)
    ends, arm, mass = matrices.particles(M[None])
    node = ends[:, 0]
    turn = torch.block_diag(matrices.axes[0], matrices.axes[0])
    for k, share in enumerate((0.5, 1.0, 1.0, 0.5)):
        total = torch.zeros(6, 6, dtype=torch.float64)
        for a, m in zip(arm[node == k], mass[node == k], strict=True):
            lever = torch.tensor([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]], dtype=torch.float64)
            motion = torch.cat([torch.eye(3).double(), -lever], dim=1)
            total += m * motion.T @ motion
        exact = turn.T @ M @ turn * share * 1.3 / 3
        d = exact.diagonal().rsqrt()
        assert float(((total - exact) * d[:, None] * d).abs().max()) < 1e-12


@pytest.mark.parametrize("change", [(3, 3, 1.5), (4, 4, 1e-9)])
def test_masses_of_no_plane_section_are_refused(change):
    M = coupled_section().mass().clone()
    M[change[0], change[1]] *= change[2]
    with refused("mass.0"):
        section_particles(M[None])


def test_derivatives_by_the_section_with_lanes():
    """Forward and reverse against differences, under vmap."""
    matrices = BeamMatrices(BeamLine.straight(1.3, 3, DIRECTION), ACROSS)
    K = coupled_section().stiffness()
    d = K.diagonal().sqrt()
    make = torch.Generator().manual_seed(0)
    change = torch.randn(2, 6, 6, generator=make, dtype=torch.float64)
    change = 0.02 * (change + change.mT) * d[:, None] * d
    weight = torch.randn(matrices.pattern.nnz, generator=make, dtype=torch.float64)

    def f(t):
        return matrices.values((K + t[0] * change[0] + t[1] * change[1])[None])

    t = torch.tensor([[0.3, -0.2], [-0.5, 0.7], [0.0, 0.1]], dtype=torch.float64)
    slopes = vmap(jacfwd(f))(t)
    h = 1e-4
    for lane in range(3):
        for a, e in enumerate(torch.eye(2, dtype=torch.float64) * h):
            near, far = f(t[lane] + e) - f(t[lane] - e), f(t[lane] + 2 * e) - f(t[lane] - 2 * e)
            rough = (8 * near - far) / (12 * h)
            assert_close(slopes[lane, :, a], rough, rtol=0, atol=1e-8 * float(rough.abs().max()))
    reverse = vmap(jacrev(lambda x: (weight * f(x)).sum()))(t)
    assert_close(reverse, torch.einsum("n,lna->la", weight, slopes), rtol=1e-9, atol=0)
    each = torch.stack([K + a * change[0] + b * change[1] for a, b in t])
    assert_close(matrices.values(each[:, None, None]), torch.stack([f(x) for x in t]), rtol=1e-11, atol=1e-6)
