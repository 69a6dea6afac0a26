"""Laws that every shell element keeps, on random cells: rigid modes, rotation, numbering, material direction, mass.

Constant states on irregular meshes, mixed ones too: tests/fem/elements/test_plate_patch.py.
"""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from tests.fem.elements.plate_cases import CARBON, GENERAL, KINDS, irregular, moved, rotation, turned
from torchmbd.fem.elements import ELEMENTS, MASSES, PlateMatrices, Plates
from torchmbd.fem.elements.facet import facets
from torchmbd.fem.elements.inner_forces import CellForces
from torchmbd.fem.materials import IsotropicMean, Laminate
from torchmbd.fem.mesh import Mesh

NUMBER = st.floats(-1, 1)
THICK = Laminate(CARBON, GENERAL.angles.detach(), 50 * GENERAL.thickness.detach())
SHAPES = {"triangle": [[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], "quad": [[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]}


@st.composite
def cell(draw):
    """A cell of any kind in general position: corners moved, sheared, stretched; quadrilaterals are warped."""
    kind = draw(st.sampled_from(sorted(ELEMENTS)))
    p = torch.tensor(SHAPES[kind], dtype=torch.float64)
    move = torch.tensor(draw(st.lists(NUMBER, min_size=p.numel(), max_size=p.numel())), dtype=torch.float64)
    stretch, shear = draw(st.floats(0.4, 2.5)), draw(st.floats(-0.5, 0.5))
    spread = torch.tensor([0.2, 0.2, 0.05], dtype=torch.float64)
    p = (p + spread * move.reshape(p.shape)) @ torch.tensor([[stretch, 0, 0], [shear, 1, 0], [0, 0, 1.0]]).double()
    return of(kind, p @ rotation(draw(st.integers(0, 99))).T)


def of(kind, nodes, corners=None):
    corners = torch.arange(len(nodes))[None] if corners is None else corners
    return Mesh(nodes, corners) if kind == "triangle" else Mesh(nodes, quads=corners)


def kind_of(mesh):
    return "triangle" if len(mesh.triangles) else "quad"


def direction(mesh, angle=0.4):
    """A direction in the plane of the first cell, from its first side."""
    side = mesh.nodes[1] - mesh.nodes[0]
    return math.cos(angle) * side + math.sin(angle) * torch.linalg.cross(mesh.normals[0], side)


def dense(mesh, along, laminate=GENERAL):
    return PlateMatrices(mesh, laminate, along).stiffness(laminate.entries().detach()).dense()


def close(K, other):
    assert_close(K, other, rtol=1e-9, atol=1e-11 * float(K.abs().max()))


@pytest.mark.thorough
@given(mesh=cell())
@settings(max_examples=40, deadline=None)
def test_exactly_six_motions_are_free(mesh):
    size = float((mesh.nodes[1] - mesh.nodes[0]).norm())
    n = len(mesh.nodes)
    scale = torch.tensor([1.0, 1, 1, 1 / size, 1 / size, 1 / size], dtype=torch.float64).repeat(n)
    K = dense(mesh, direction(mesh), THICK) * scale * scale[:, None]
    x = mesh.nodes - mesh.nodes.mean(0)
    rigid = torch.zeros(n, 6, 6, dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64)
    rigid[:, :3, :3], rigid[:, 3:, 3:] = eye, eye
    rigid[:, :3, 3:] = torch.linalg.cross(eye.expand(n, 3, 3), x[:, None].expand(n, 3, 3)).mT
    rigid = rigid.reshape(6 * n, 6) / scale[:, None]
    assert (K @ rigid).abs().max() < 1e-10 * K.abs().max() * rigid.abs().max()
    values = torch.linalg.eigvalsh(K)
    assert values[0] > -1e-12 * values[-1]
    assert values[6] > 1e-6 * values[-1]


@given(mesh=cell(), seed=st.integers(0, 10**6))
@settings(max_examples=25, deadline=None)
def test_turning_the_body_turns_the_stiffness(mesh, seed):
    R = rotation(seed)
    T = torch.block_diag(*[R] * (2 * len(mesh.nodes)))
    K = dense(mesh, direction(mesh))
    close(T @ K @ T.T, dense(turned(mesh, R), R @ direction(mesh)))


@given(mesh=cell(), shift=st.sampled_from([1, 2, 3]))
@settings(max_examples=25, deadline=None)
def test_the_first_corner_is_as_good_as_the_second(mesh, shift):
    kind = kind_of(mesh)
    other = of(kind, mesh.nodes, mesh.cells[kind].roll(shift, 1))
    close(dense(mesh, direction(mesh)), dense(other, direction(mesh)))


@given(mesh=cell())
@settings(max_examples=25, deadline=None)
def test_looking_from_below_reverses_the_stack(mesh):
    """The other winding turns the normal over: mirrored angles, top ply first."""
    below = of(kind_of(mesh), mesh.nodes, mesh.cells[kind_of(mesh)].flip(1))
    angles, t = GENERAL.angles.detach(), GENERAL.thickness.detach()
    stack = Laminate(CARBON, -angles.flip(0), t.flip(0))
    close(dense(mesh, direction(mesh)), dense(below, direction(mesh), stack))


@given(mesh=cell(), angle=st.floats(-3, 3))
@settings(max_examples=25, deadline=None)
def test_turning_the_direction_is_turning_every_ply(mesh, angle):
    """With the shear stiffness that is a tensor: that of equal energy belongs to the laminate's own axes."""
    one, other = (
        Laminate(CARBON, GENERAL.angles.detach() + turn, GENERAL.thickness.detach(), shear_correction=5 / 6)
        for turn in (0.0, angle / 2)
    )
    close(dense(mesh, direction(mesh, 0.4 + angle / 2), one), dense(mesh, direction(mesh, 0.4), other))


@pytest.mark.parametrize("kind", KINDS)
def test_numbering_of_nodes_does_not_matter(kind):
    mesh = turned(irregular(1.0, 0.6, (4, 3), kind=kind), rotation(3))
    order = torch.from_numpy(np.random.default_rng(0).permutation(len(mesh.nodes)))
    place = torch.argsort(order)
    other = Mesh(mesh.nodes[order], place[mesh.triangles], quads=place[mesh.quads])
    K, L = dense(mesh, (1.0, 0.2, 0.1)), dense(other, (1.0, 0.2, 0.1))
    rows = (6 * order[:, None] + torch.arange(6)).flatten()
    close(K[rows][:, rows], L)


@pytest.mark.parametrize("kind", KINDS)
def test_stiffness_scales_with_size_as_dimensions_say(kind):
    """Twice the plate, twice the thickness: K_uu doubles, K_u_phi has a factor 4, K_phi_phi 8."""
    small = irregular(1.0, 0.6, (2, 2), kind=kind)
    large = moved(small, 2 * small.nodes)
    double = Laminate(CARBON, GENERAL.angles.detach(), 2 * GENERAL.thickness.detach())
    powers = torch.tensor([0.0, 0, 0, 1, 1, 1]).repeat(len(small.nodes)).double()
    factor = 2.0 ** (1 + powers + powers[:, None])
    close(factor * dense(small, (1.0, 0, 0)), dense(large, (1.0, 0, 0), double))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("cells", [(1, 1), (4, 3)])
def test_free_plate_has_six_rigid_modes(cells, kind):
    values = torch.linalg.eigvalsh(dense(turned(irregular(1.0, 0.6, cells, kind=kind), rotation(4)), (1.0, 0.2, 0.1)))
    assert (values[:6].abs() < 1e-13 * values[-1]).all()
    assert values[6] > 1e-9 * values[-1]


@given(mesh=cell())
@settings(max_examples=25, deadline=None)
def test_stiffness_is_the_energy_of_its_strains(mesh):
    """Rows of the basis and matrices of the cells, against E' C E with the whole 8 x 8 law, summed point by point.

    Inner forces are strains here: eps = eps_mean + S sigma V (w + w of kappa) - S B (kappa - kappa_mean), where V is any matrix
    that gives forces alone their energy; so the coupling with bending has to be as it should.
    """
    s = GENERAL.stiffness()
    A, B = s.A.detach(), s.B.detach()
    C = torch.block_diag(torch.cat([torch.cat([s.A, s.B], 1), torch.cat([s.B, s.D], 1)], 0), s.As).detach()
    kind = kind_of(mesh)
    result = ELEMENTS[kind](facets(mesh, direction(mesh), kind=kind), IsotropicMean.of(GENERAL))
    K = sum(float(w) * E.mT @ C @ E for w, E in zip(result.weight[0], result.at[0], strict=True))
    if result.forces is not None:
        S, sigma, bent = torch.linalg.inv(A), result.forces.states[0], result.forces.curvature[0]
        G = CellForces(result.forces).law(A, 0 * B)[0, :4, :4]
        V = torch.linalg.solve(torch.linalg.cholesky((sigma.mT @ S @ sigma).sum(0)).mT, torch.linalg.cholesky(G).mT)
        w = result.forces.work[0] + (sigma.mT @ S @ B @ bent).sum(0)
        eps = S @ (sigma @ V @ w - B @ bent)
        more = eps.mT @ A @ eps + eps.mT @ B @ bent + bent.mT @ B @ eps  # D of bent is in K
        K = K + float(result.forces.area) * more.sum(0)
    close(dense(mesh, direction(mesh)), K)


@pytest.mark.parametrize("mass", MASSES)
@pytest.mark.parametrize("kind", KINDS)
def test_mass_points_keep_mass_and_center(mass, kind):
    """And, if consistent, the moments of inertia of a flat plate of 0.7 x 0.5 m, whatever the mesh."""
    mesh = irregular(0.7, 0.5, (4, 3), kind=kind)
    points = Plates(mesh, GENERAL, mass=mass).masses()
    m, x = points.mass.detach(), mesh.nodes[points.ends].mean(1)
    total = float(GENERAL.mass_per_area.detach()) * 0.35
    assert float(m.sum()) == pytest.approx(total, rel=1e-12)
    assert (m > 0).all()
    assert (abs(m @ x) < 1e-12 * total).all()
    if mass == "consistent":
        assert (m @ x**2 / total)[:2].tolist() == pytest.approx([0.49 / 12, 0.25 / 12], rel=1e-12)
