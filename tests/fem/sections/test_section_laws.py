"""What holds for every section: equilibrium, energy, change of axes, mass, invariance to numbering and to kind of element."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.fem.sections.section_cases import ANBA, AS4, general_section, scaled
from torchmbd.fem import sections
from torchmbd.fem.sections import Section, SectionMesh, warping
from torchmbd.fem.sections.orthotropic import strain_rotation


@pytest.fixture(scope="module")
def made() -> Section:
    return general_section()


def test_stresses_are_in_equilibrium_with_the_forces(made):
    """All six resultants, although only four were imposed: shear forces come out of equilibrium alone."""
    g = made.geometry
    to_wall = strain_rotation(made.angles.detach())[g.layer, None].mT
    for load in torch.eye(6, dtype=torch.float64):
        wall = to_wall @ made.stress(load).stress[..., None].detach()
        assert_close(g.resultant(wall)[..., 0], load, rtol=0, atol=1e-10)


def test_energy_of_stresses_is_that_of_the_matrix(made):
    load = torch.tensor([30.0, -20.0, 10.0, 0.4, 0.3, -0.5], dtype=torch.float64)
    result = made.stress(load)
    energy = (made.geometry.weight * (result.strain * result.stress).sum(-1)).sum() / 2
    assert_close(energy, load @ torch.linalg.inv(made.stiffness()) @ load / 2, rtol=1e-9, atol=0)


def test_stiffness_is_symmetric_and_positive(made):
    K = made.stiffness().detach()
    assert_close(scaled(K), scaled(K).T, rtol=0, atol=1e-12)
    assert float(torch.linalg.eigvalsh(scaled(K)).min()) > 1e-3


def test_reactions_at_the_held_nodes_are_zero(made):
    g = made.geometry
    D = made._wall_stiffness.detach()
    _, strain, stress = (x.detach() for x in made.unit_fields())
    classical = [0, 3, 4, 5]  # without shear, warping stresses balance themselves
    reaction = g.warp_force(stress[..., classical])
    size = g.warp_force(g.stress(D, g.rigid_strain(torch.eye(6, dtype=torch.float64)))).abs().max() * strain.abs().max()
    assert float(reaction.abs().max()) < 1e-11 * float(size)


def test_where_the_section_is_held_does_not_matter(made, monkeypatch):
    """Other nodes hold the rigid motions: the same matrix and the same stresses."""
    monkeypatch.setattr(warping, "_held_freedoms", lambda yz: [0, 1, 2, 3 * len(yz) - 1])
    other = Section(made.mesh, ANBA, made.angles.detach())
    assert other.problem.held.tolist() != made.problem.held.tolist()
    assert_close(scaled(other.stiffness().detach()), scaled(made.stiffness().detach()), rtol=0, atol=1e-10)
    load = [30.0, -20.0, 10.0, 0.4, 0.3, -0.5]
    one, two = (s.stress(load).stress.detach() for s in (made, other))
    assert_close(one, two, rtol=0, atol=1e-8 * float(one.abs().max()))


@pytest.mark.thorough
def test_five_thousand_elements():
    """A fine box against a coarse one: nothing is lost in the factorization of 50,000 freedoms."""
    coarse, fine = (
        sections.box(0.953, 0.53, AS4, mbd.deg([-15.0] * 6), 0.005, cells=cells)
        for cells in ((20, 12, 1), (266, 150, 1))
    )
    assert len(fine.mesh.layer) == 4992
    assert_close(scaled(fine.stiffness().detach()), scaled(coarse.stiffness().detach()), rtol=0, atol=2e-3)


@pytest.mark.parametrize(("shift", "turn"), [((0.02, -0.03), 0.0), ((0.0, 0.0), 0.7), ((-0.01, 0.04), 2.1)])
def test_change_of_axes(made, shift, turn):
    """K and mass transform with the origin and the turn of the section's axes."""
    c, s = torch.cos(torch.tensor(turn, dtype=torch.float64)), torch.sin(torch.tensor(turn, dtype=torch.float64))
    R = torch.stack([torch.stack([c, -s]), torch.stack([s, c])])
    move = torch.tensor(shift, dtype=torch.float64)
    mesh = SectionMesh(made.mesh.nodes @ R.T + move, made.mesh.elements, made.mesh.layer)
    moved = Section(mesh, ANBA, made.angles.detach())
    rotation = torch.block_diag(torch.ones(1, 1, dtype=torch.float64), R)
    arm = torch.tensor([[0, -move[1], move[0]], [move[1], 0, 0], [-move[0], 0, 0]], dtype=torch.float64)
    W = torch.zeros(6, 6, dtype=torch.float64)  # forces about the new origin from those about the old one
    W[:3, :3] = W[3:, 3:] = rotation
    W[3:, :3] = arm @ rotation
    assert_close(scaled(moved.stiffness().detach()), scaled(W @ made.stiffness().detach() @ W.T), rtol=0, atol=1e-9)
    assert_close(scaled(moved.mass()), scaled(W @ made.mass() @ W.T), rtol=0, atol=1e-12)
    for center in ("shear_center", "tension_center"):
        assert_close(getattr(moved, center)(), R @ getattr(made, center)() + move, rtol=0, atol=1e-9)


def test_numbering_does_not_matter(made):
    order = torch.randperm(len(made.mesh.nodes), generator=torch.Generator().manual_seed(1))
    place = order.argsort()
    mesh = SectionMesh(made.mesh.nodes[order], [place[e] for e in made.mesh.elements], made.mesh.layer)
    other = Section(mesh, ANBA, made.angles.detach())
    assert_close(scaled(other.stiffness().detach()), scaled(made.stiffness().detach()), rtol=0, atol=1e-10)


def test_kinds_of_elements_converge_to_one_matrix():
    """An unbalanced strip by 8-node and 6-node elements, and mixed kinds in one mesh."""
    angles = mbd.deg([30.0, -50.0])
    made = sections.strip(0.02, AS4, angles, 4e-3, cells=(12, 4))
    reference = scaled(made.stiffness().detach())
    quads = made.mesh.elements[0]
    a, b, c, d, ab, bc, cd, da = quads.T
    nodes, middles = made.mesh.nodes, made.mesh.nodes[quads[:, :4]].mean(1)
    m = len(nodes) + torch.arange(len(quads))
    lower, upper = torch.stack([a, b, c, ab, bc, m], 1), torch.stack([c, d, a, cd, da, m], 1)
    nodes = torch.cat([nodes, middles])
    triangles = SectionMesh(nodes, torch.cat([lower, upper]), made.mesh.layer.repeat(2), 0.0)
    square = scaled(Section(triangles, AS4, angles).stiffness().detach())
    assert_close(square, reference, rtol=0, atol=3e-4)
    half = len(quads) // 2
    kept = torch.cat([torch.arange(len(made.mesh.nodes)), m[half:]])
    number = torch.full((len(nodes),), -1)
    number[kept] = torch.arange(len(kept))
    blocks = [quads[:half], number[torch.cat([lower[half:], upper[half:]])]]
    layer = torch.cat([made.mesh.layer[:half], made.mesh.layer[half:].repeat(2)])
    mixed = Section(SectionMesh(nodes[kept], blocks, layer, 0.0), AS4, angles)
    assert_close(scaled(mixed.stiffness().detach()), reference, rtol=0, atol=3e-4)


def test_mass_is_that_of_quadrature(made):
    M, g = made.mass(), made.geometry
    y, z = g.points.unbind(-1)
    assert_close(M[0, 0], g.weight.sum(), rtol=1e-12, atol=0)  # density 1
    assert_close(M[0, 4], (g.weight * z).sum(), rtol=1e-12, atol=0)
    assert_close(M[0, 5], -(g.weight * y).sum(), rtol=1e-12, atol=0)
    assert_close(M[4, 5], -(g.weight * y * z).sum(), rtol=1e-12, atol=1e-18)
    assert_close(M[3, 3], M[4, 4] + M[5, 5], rtol=1e-12, atol=0)


def test_a_force_in_a_list_keeps_the_gradients_of_its_tensors():
    section = mbd.sections.rectangle(0.02, 0.01, mbd.Ply.isotropic(210e9, 0.3, 7850.0), cells=(2, 2))
    moment = mbd.variable(1.0)
    largest = section.stress([0.0, 0.0, 0.0, 0.0, moment, 0.0]).stress[..., 0].max()
    (slope,) = torch.autograd.grad(largest, [moment])
    assert float(slope) == pytest.approx(float(largest), rel=1e-12)
    with pytest.raises(mbd.InputError) as error:
        section.stress([0.0, 0.0, 0.0, 0.0, "1 N m", 0.0])
    assert (error.value.path, error.value.value) == (("force",), [0.0, 0.0, 0.0, 0.0, "1 N m", 0.0])
