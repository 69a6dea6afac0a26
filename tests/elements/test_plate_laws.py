"""Laws that any plate element keeps, on random triangles: rigid modes, rotation, numbering, material direction."""

import math

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from tests.elements.plate_cases import CARBON, GENERAL, irregular, rotation, turned
from torchmbd.elements import PlateMatrices
from torchmbd.materials import Laminate
from torchmbd.mesh import Mesh

COORDINATE = st.floats(-1, 1)
CORNERS = st.lists(st.tuples(COORDINATE, COORDINATE, COORDINATE), min_size=3, max_size=3)
THICK = Laminate(CARBON, GENERAL.angles.detach(), 50 * GENERAL.thickness.detach())


def triangle(corners):
    p = torch.tensor(corners, dtype=torch.float64)
    double_area = torch.linalg.cross(p[1] - p[0], p[2] - p[0]).norm()
    longest = max((p[i] - p[i - 1]).norm() for i in range(3))
    assume(longest > 0.05 and double_area > 0.2 * longest**2)
    return Mesh(p, [[0, 1, 2]])


def direction(mesh, angle=0.4):
    """A direction in the plane of the first triangle, from its first side."""
    side = mesh.nodes[1] - mesh.nodes[0]
    return math.cos(angle) * side + math.sin(angle) * torch.linalg.cross(mesh.normals[0], side)


def dense(mesh, along, laminate=GENERAL):
    return PlateMatrices(mesh, laminate, along).stiffness(laminate.entries().detach()).dense()


def close(K, other):
    assert_close(K, other, rtol=1e-9, atol=1e-11 * float(K.abs().max()))


@given(corners=CORNERS)
@settings(max_examples=40, deadline=None)
def test_exactly_six_motions_are_free(corners):
    mesh = triangle(corners)
    size = float((mesh.nodes[1] - mesh.nodes[0]).norm())
    scale = torch.tensor([1.0, 1, 1, 1 / size, 1 / size, 1 / size], dtype=torch.float64).repeat(3)
    K = dense(mesh, direction(mesh), THICK) * scale * scale[:, None]
    x = mesh.nodes - mesh.nodes.mean(0)
    rigid = torch.zeros(3, 6, 6, dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64)
    rigid[:, :3, :3], rigid[:, 3:, 3:] = eye, eye
    rigid[:, :3, 3:] = torch.linalg.cross(eye.expand(3, 3, 3), x[:, None].expand(3, 3, 3)).mT
    rigid = rigid.reshape(18, 6) / scale[:, None]
    assert (K @ rigid).abs().max() < 1e-10 * K.abs().max() * rigid.abs().max()
    values = torch.linalg.eigvalsh(K)
    assert values[0] > -1e-12 * values[-1]
    assert values[6] > 1e-6 * values[-1]


@given(corners=CORNERS, seed=st.integers(0, 10**6))
@settings(max_examples=25, deadline=None)
def test_turning_the_body_turns_the_stiffness(corners, seed):
    mesh, R = triangle(corners), rotation(seed)
    T = torch.block_diag(*[R] * 6)
    K = dense(mesh, direction(mesh))
    close(T @ K @ T.T, dense(turned(mesh, R), R @ direction(mesh)))


@given(corners=CORNERS, shift=st.sampled_from([1, 2]))
@settings(max_examples=25, deadline=None)
def test_the_first_corner_is_as_good_as_the_second(corners, shift):
    mesh = triangle(corners)
    other = Mesh(mesh.nodes, mesh.triangles.roll(shift, 1))
    close(dense(mesh, direction(mesh)), dense(other, direction(mesh)))


@given(corners=CORNERS)
@settings(max_examples=25, deadline=None)
def test_looking_from_below_reverses_the_stack(corners):
    """The other winding turns the normal over: mirrored angles, top ply first."""
    mesh = triangle(corners)
    below = Mesh(mesh.nodes, mesh.triangles.flip(1))
    angles, t = GENERAL.angles.detach(), GENERAL.thickness.detach()
    stack = Laminate(CARBON, -angles.flip(0), t.flip(0))
    close(dense(mesh, direction(mesh)), dense(below, direction(mesh), stack))


@given(corners=CORNERS, angle=st.floats(-3, 3))
@settings(max_examples=25, deadline=None)
def test_turning_the_direction_is_turning_every_ply(corners, angle):
    mesh = triangle(corners)
    plies = Laminate(CARBON, GENERAL.angles.detach() + angle / 2, GENERAL.thickness.detach())
    close(dense(mesh, direction(mesh, 0.4 + angle / 2)), dense(mesh, direction(mesh, 0.4), plies))


def test_numbering_of_nodes_does_not_matter():
    mesh = turned(irregular(1.0, 0.6, (4, 3)), rotation(3))
    order = torch.from_numpy(np.random.default_rng(0).permutation(len(mesh.nodes)))
    place = torch.argsort(order)
    other = Mesh(mesh.nodes[order], place[mesh.triangles])
    K, L = dense(mesh, (1.0, 0.2, 0.1)), dense(other, (1.0, 0.2, 0.1))
    rows = (6 * order[:, None] + torch.arange(6)).flatten()
    close(K[rows][:, rows], L)


def test_stiffness_scales_with_size_as_dimensions_say():
    """Twice the plate, twice the thickness: K_uu doubles, K_u_phi has a factor 4, K_phi_phi 8."""
    small = irregular(1.0, 0.6, (2, 2))
    large = Mesh(2 * small.nodes, small.triangles)
    double = Laminate(CARBON, GENERAL.angles.detach(), 2 * GENERAL.thickness.detach())
    powers = torch.tensor([0.0, 0, 0, 1, 1, 1]).repeat(len(small.nodes)).double()
    factor = 2.0 ** (1 + powers + powers[:, None])
    close(factor * dense(small, (1.0, 0, 0)), dense(large, (1.0, 0, 0), double))


@pytest.mark.parametrize("cells", [(1, 1), (4, 3)])
def test_free_plate_has_six_rigid_modes(cells):
    values = torch.linalg.eigvalsh(dense(turned(irregular(1.0, 0.6, cells), rotation(4)), (1.0, 0.2, 0.1)))
    assert (values[:6].abs() < 1e-13 * values[-1]).all()
    assert values[6] > 1e-9 * values[-1]
