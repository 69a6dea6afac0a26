"""Derivatives of the 6 x 6 matrix by the ply angles: differences, forward against reverse mode, lanes."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
from torch.func import functional_call, jacfwd, jacrev, jvp, vmap
from torch.testing import assert_close

import torchmbd as mbd
from tests.fem.sections.section_cases import AS4, general_section
from torchmbd.fem import sections
from torchmbd.fem.sections.saint_venant import compliance, unit_fields


@pytest.fixture(scope="module")
def made() -> sections.Section:
    return general_section()


def law(section):
    return lambda angles: functional_call(section, {"angles": angles})


def differences(f, x, h):
    """Central differences of fourth order; the new axis last."""
    columns = []
    for e in torch.eye(len(x), dtype=x.dtype) * h:
        near, far = f(x + e) - f(x - e), f(x + 2 * e) - f(x - 2 * e)
        columns.append((8 * near - far) / (12 * h))
    return torch.stack(columns, dim=-1)


@pytest.mark.thorough
def test_against_differences(made):
    """Each entry relative to the largest derivative of its kind (forces, couplings, moments)."""
    angles = made.angles.detach()
    exact, rough = jacfwd(law(made))(angles), differences(law(made), angles, 1e-3)
    K = made.stiffness().detach()
    scale = (K.diagonal()[:, None] * K.diagonal()).sqrt()[..., None]
    assert float(((exact - rough) / scale).abs().max()) < 1e-8  # the differences know 1e-9
    assert float(((exact - rough).abs() / (exact.abs() + 1e-3 * scale)).max()) < 1e-6
    assert float((exact / scale).abs().amax((0, 1)).min()) > 1e-3  # every angle acts


def test_closed_form_against_the_chain_of_solutions(made):
    """The adjoint formula of saint_venant.py against forward mode through the two warping problems."""
    D = made._wall_stiffness.detach()
    make = torch.Generator().manual_seed(7)
    change = torch.randn(D.shape, generator=make, dtype=torch.float64) * D.abs().amax()
    change = change + change.mT

    def chain(D):
        _, strain, stress = unit_fields(made.problem, made.geometry, D)
        return made.geometry.energy(strain, stress)

    short = jvp(lambda x: compliance(made.problem, D.new_zeros(0), x), (D,), (change,))[1]
    long = jvp(chain, (D,), (change,))[1]
    scale = long.diagonal().abs().sqrt()
    assert_close(short / scale / scale[:, None], long / scale / scale[:, None], rtol=0, atol=1e-10)


def test_forward_against_reverse_mode(made):
    angles = made.angles.detach()
    forward, reverse = jacfwd(law(made))(angles), jacrev(law(made))(angles)
    K = made.stiffness().detach()
    scale = (K.diagonal()[:, None] * K.diagonal()).sqrt()[..., None]
    assert_close(forward / scale, reverse / scale, rtol=0, atol=1e-11)


def test_backward_fills_the_gradient_of_the_parameter(made):
    made.angles.grad = None
    weights = torch.randn(6, 6, generator=torch.Generator().manual_seed(3), dtype=torch.float64) * 1e-3
    (weights * made.stiffness()).sum().backward()
    exact = torch.einsum("ij,ija->a", weights, jacfwd(law(made))(made.angles.detach()))
    assert_close(made.angles.grad, exact, rtol=1e-9, atol=1e-9 * float(exact.abs().max()))


@pytest.mark.thorough
def test_lanes(made):
    """Leading lanes, vmap, and derivatives under vmap are the loop over designs."""
    make = torch.Generator().manual_seed(5)
    angles = torch.randn(2, 3, len(made.angles), generator=make, dtype=torch.float64)
    each = torch.stack([torch.stack([law(made)(a) for a in row]) for row in angles]).detach()
    assert_close(law(made)(angles).detach(), each, rtol=1e-12, atol=1e-9)
    assert_close(vmap(vmap(law(made)))(angles), each, rtol=1e-12, atol=1e-9)
    slopes = torch.stack([jacfwd(law(made))(a) for a in angles[0]])
    assert_close(vmap(jacfwd(law(made)))(angles[0]), slopes, rtol=1e-9, atol=1e-6)
    assert_close(vmap(jacrev(law(made)))(angles[0]), slopes, rtol=1e-9, atol=1e-5)
    moved = jvp(law(made), (angles[0],), (torch.ones_like(angles[0]),))[1]
    assert_close(moved, slopes.sum(-1), rtol=1e-9, atol=1e-5)


@pytest.mark.thorough
def test_centers_and_stresses_have_derivatives():
    section = sections.box(0.05, 0.03, AS4, {w: [0.3 + k, -0.5] for k, w in enumerate(("top", "right", "bottom", "left"))},
                           1e-3, cells=(3, 2, 1))  # fmt: skip
    angles = section.angles.detach()

    def outputs(a):
        def call(name, *args):
            return functional_call(_Method(section, name, args), {"section.angles": a})

        stress = call("stress", [10.0, -3.0, 5.0, 0.7, 0.2, -0.4]).stress
        return torch.cat([call("shear_center"), call("tension_center"), stress.flatten() * 1e-3])

    exact = jacfwd(outputs)(angles)
    # Of sixth order: small steps leave rounding of 1e-8.
    rough = (16 * differences(outputs, angles, 5e-3) - differences(outputs, angles, 1e-2)) / 15
    assert_close(exact, rough, rtol=0, atol=1e-8 * float(exact.abs().max()))


class _Method(torch.nn.Module):
    """A method of a section as a module of its own, for functional_call."""

    def __init__(self, section, name, args):
        super().__init__()
        self.section, self.name, self.args = section, name, args

    def forward(self):
        return getattr(self.section, self.name)(*self.args)


def test_second_derivatives_are_refused(made):
    with pytest.raises(NotImplementedError, match="second derivatives"):
        jacfwd(jacfwd(law(made)))(made.angles.detach())


def test_a_used_section_is_copied_and_travels(made):
    K = made.stiffness().detach()
    for twin in (copy.deepcopy(made), pickle.loads(pickle.dumps(made))):
        assert_close(twin.stiffness().detach(), K, rtol=1e-13, atol=0)


def test_two_angles_of_one_wall_are_one_parameter():
    """A box wound around: the derivative by the shared angle is the sum over the walls."""
    wound = sections.box(0.05, 0.03, AS4, mbd.deg([20.0]), 2e-3, cells=(4, 3, 1))
    four = sections.box(
        0.05, 0.03, AS4, {w: mbd.deg([20.0]) for w in ("top", "right", "bottom", "left")}, 2e-3, cells=(4, 3, 1)
    )
    one, each = (jacfwd(law(s))(s.angles.detach()) for s in (wound, four))
    assert_close(one[..., 0], each.sum(-1), rtol=1e-9, atol=1e-7 * float(one.abs().max()))


@pytest.mark.thorough
def test_lanes_of_equal_and_of_other_designs():
    """Equal designs are analysed once; the gradient of each lane is its own, by wall thickness and angles."""
    section = sections.tube(0.02, AS4, mbd.deg([40.0, -20.0]), mbd.variable(1e-3), cells=(8, 1))
    x = torch.tensor([1.0e-3, 0.7, -0.35], dtype=torch.float64)

    def of(x):
        return functional_call(section, {"thickness": x[..., 0], "angles": x[..., 1:]})

    lanes = torch.stack([x, x * 1.05, x])
    each = torch.stack([jacfwd(of)(lane) for lane in lanes])
    scale = each.abs().amax((0, 1, 2))
    assert_close(vmap(jacrev(of))(lanes) / scale, each / scale, rtol=0, atol=1e-11)
    assert_close(vmap(jacfwd(of))(lanes) / scale, each / scale, rtol=0, atol=1e-11)
    own = torch.autograd.functional.jacobian(lambda y: of(y).sum(0), lanes)
    assert_close(own.movedim(-2, 0) / scale, each / scale, rtol=0, atol=1e-11)
