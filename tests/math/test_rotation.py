"""Rotations against the matrix exponential and cross products of torch, in any direction and up to half a turn."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm_frechet
from torch.testing import assert_close

from tests.mechanisms import cross_matrix, tensor, turned
from torchmbd.math import rotation
from torchmbd.math.pair import Pair
from torchmbd.math.rotation import euler_parameters


def single(f):
    """A function of the motion stage on single vectors: its arguments carry a lane axis."""
    return lambda *x: f(*(y[..., None] for y in x))[..., 0]


rotation_matrix, exponential, skew, axial = map(
    single, (rotation.rotation_matrix, rotation.exponential, rotation.skew, rotation.axial)
)
quaternion_product, euler_rates = single(rotation.quaternion_product), single(rotation.euler_rates)

vectors = st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3).map(lambda x: tensor(*x))
unit_quaternions = (
    st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4)
    .map(lambda x: tensor(*x))
    .filter(lambda p: float(p.norm()) > 0.1)
    .map(lambda p: p / p.norm())
)


@pytest.mark.thorough
@given(unit_quaternions)
def test_matrix_is_a_rotation(p):
    A = rotation_matrix(p)
    assert_close(A.T @ A, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-14)
    assert float(torch.linalg.det(A)) == pytest.approx(1.0, abs=1e-14)


@pytest.mark.thorough
@given(unit_quaternions)
def test_matrix_is_the_form_of_the_header(p):
    """A wrong sign in the table of coefficients transposes a rotation and still passes orthogonality."""
    e0, e = p[0], p[1:]
    expected = (2 * e0**2 - 1) * torch.eye(3, dtype=torch.float64) + 2 * (torch.outer(e, e) + e0 * cross_matrix(e))
    assert_close(rotation_matrix(p), expected, rtol=0, atol=1e-14)


@pytest.mark.thorough
@given(unit_quaternions, unit_quaternions)
def test_product_composes_rotations(p, d):
    composed = rotation_matrix(quaternion_product(p, d))
    assert_close(composed, rotation_matrix(p) @ rotation_matrix(d), rtol=0, atol=1e-14)


@pytest.mark.thorough
@given(vectors)
def test_exponential_is_the_matrix_exponential(delta):
    p = exponential(delta)
    assert float(p.norm()) == pytest.approx(1.0, abs=1e-14)
    assert_close(rotation_matrix(p), turned(*delta.tolist()), rtol=0, atol=1e-13)


@pytest.mark.thorough
@given(unit_quaternions)
def test_euler_parameters_come_back(p):
    back = euler_parameters(rotation_matrix(p))
    assert_close(back, p if back @ p > 0 else -p, rtol=0, atol=1e-13)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.6, -0.8, 0), (0, 0.6, 0.8), (-0.6, 0, 0.8)])
@pytest.mark.parametrize("angle", [math.pi, math.pi - 1e-9, math.pi / 2, 1e-9, 0.0])
def test_euler_parameters_at_half_turns_and_near_none(axis, angle):
    """The usual formula by the trace divides by zero at half a turn."""
    A = turned(*(angle * x for x in axis))
    assert_close(rotation_matrix(euler_parameters(A)), A, rtol=0, atol=1e-14)


@pytest.mark.thorough
@given(unit_quaternions, vectors)
def test_rates_belong_to_body_axes(p, omega):
    """dA/dt = A ~omega; with ground axes it would be ~omega A."""
    _, rate = torch.func.jvp(rotation_matrix, (p,), (euler_rates(p, omega),))
    assert_close(rate, rotation_matrix(p) @ cross_matrix(omega), rtol=0, atol=1e-13)


@pytest.mark.thorough
@given(vectors, vectors)
def test_skew_and_axial(x, b):
    assert_close(skew(x) @ b, torch.linalg.cross(x, b), rtol=0, atol=1e-14)
    assert_close(axial(torch.outer(x, b)), torch.linalg.cross(b, x), rtol=0, atol=1e-14)


SIZES = [0.0, 1e-160, 1e-30, 1e-12, 1e-8, 1e-5, 1e-3, 0.1, 1.0, 3.1]


@pytest.mark.parametrize("size", SIZES)
def test_tangent_of_the_exponential(size):
    """Through zero and tiny rotations: sin(n)/n has no division that could lose its slope."""
    delta, turn = size * tensor(0.48, -0.6, 0.64), tensor(0.3, 0.5, -0.7)
    both = rotation.exponential(Pair.of(delta[:, None, None], turn[:, None, None]))
    slope = torch.from_numpy(expm_frechet(cross_matrix(delta), cross_matrix(turn))[1])
    A = rotation.rotation_matrix(both)
    assert_close(A.value[..., 0, 0], turned(*delta.tolist()), rtol=0, atol=1e-13)
    assert_close(A.tangent[..., 0, 0], slope, rtol=0, atol=1e-12)


@pytest.mark.parametrize("size", SIZES)
def test_gradient_of_the_exponential_in_reverse_mode(size):
    delta = (size * tensor(0.48, -0.6, 0.64)).requires_grad_()
    A = rotation_matrix(exponential(delta)).flatten()
    gradient = torch.stack([torch.autograd.grad(x, delta, retain_graph=True)[0] for x in A])
    at = cross_matrix(delta.detach())
    slopes = [expm_frechet(at, cross_matrix(e))[1].ravel() for e in torch.eye(3, dtype=torch.float64)]
    assert_close(gradient, torch.from_numpy(np.stack(slopes, 1)), rtol=0, atol=1e-12)
