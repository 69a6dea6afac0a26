"""Membrane forces that vary over a cell: exact bending of any laminate, relief of unsymmetric stacks, derivatives."""

import numpy as np
import pytest
import torch
from torch.func import functional_call, jacrev, jvp, vmap
from torch.testing import assert_close

from tests.fem.elements.plate_cases import (
    CARBON,
    GENERAL,
    freedoms,
    irregular,
    mapped,
    rotation,
    solved,
    stiffness,
    turned,
)
from torchmbd.fem.elements import PlateMatrices
from torchmbd.fem.elements.inner_forces import CellForces, zero_mean_functions
from torchmbd.fem.elements.quad_membrane import displacements, membrane
from torchmbd.fem.elements.quad_shape import gauss
from torchmbd.fem.materials import Laminate
from torchmbd.math.angles import deg

PLATE = PlateMatrices(turned(irregular(0.5, 0.3, (3, 2), kind="mixed"), rotation(7)), GENERAL, (1.0, 0.3, -0.2))
ALONE = torch.ones(1, 4, dtype=torch.bool)
RECTANGLE = torch.tensor([[[-0.9, -0.4], [0.9, -0.4], [0.9, 0.4], [-0.9, 0.4]]], dtype=torch.float64)


def forces(corners):
    return CellForces(membrane(corners, gauss(corners), 0.3, torch.zeros(1, dtype=torch.float64), ALONE).forces)


def test_a_rectangle_in_bending_has_the_energy_of_its_material():
    """Both ways, and a mixture: stresses y and x, strains that no isotropic cell could have."""
    A = GENERAL.stiffness().A.detach()
    S = torch.linalg.inv(A)
    inner = forces(RECTANGLE)
    size = inner.inner_forces.area.sqrt()
    amount = S.new_tensor([1.0, -0.3, 0.0, 0.0])
    u = (displacements(RECTANGLE / size, S)[0] @ amount).unflatten(0, (4, 3))
    w = inner.inner_forces.work[0] @ (u * torch.stack([size, size, torch.ones_like(size)], dim=-1)).flatten()
    # Means of y^2 and x^2; that of x y is 0.
    squares = torch.tensor([0.4**2, 0.9**2], dtype=torch.float64) / 3 / size**2
    exact = (amount[:2] ** 2 * squares * S.diagonal()[:2]).sum()
    assert_close(w @ inner.law(A[None], 0 * A[None])[0, :4, :4] @ w, exact, rtol=1e-12, atol=0.0)


def test_amounts_of_three_functions_are_all_that_varies():
    """Without mean, and the mean of a product is the sum of products: with any weights."""
    weight = torch.tensor([[0.2, 0.7, 0.4, 0.3]], dtype=torch.float64)
    T, one = zero_mean_functions(weight)[0], torch.ones(4, dtype=torch.float64)
    a, b = torch.randn(2, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    share = weight[0] / 1.6
    assert_close(T @ one, torch.zeros(3, dtype=torch.float64), rtol=0, atol=1e-15)
    assert_close((T @ a) @ (T @ b), share @ (a * b) - (share @ a) * (share @ b))


def test_chosen_numbers_are_those_of_the_whole():
    entries = GENERAL.entries().detach()
    chosen = torch.tensor([3, 700, 701, 3, 55])
    whole = PLATE.values(entries)
    assert_close(PLATE.values(entries, chosen), whole[chosen])
    assert_close(PLATE.values(entries), whole)


@pytest.mark.thorough
def test_lanes_and_tangents_of_all_angles():
    angles = torch.tensor([[0.1, 0.2, -0.3], [1.0, -1.2, 0.4]], dtype=torch.float64)

    def values(theta):
        return PLATE.stiffness(functional_call(GENERAL, {"angles": theta}, ())).values

    both = values(angles)
    for lane, theta in enumerate(angles):
        assert_close(both[lane], values(theta), rtol=1e-12, atol=1e-13 * float(both.abs().max()))
        slopes = vmap(lambda e, at=theta: jvp(values, (at,), (e,))[1])(torch.eye(3, dtype=torch.float64))
        assert_close(jacrev(values)(theta).T, slopes, rtol=1e-10, atol=1e-12 * float(slopes.abs().max()))
        step = 1e-5 * torch.eye(3, dtype=torch.float64)
        differences = torch.stack([(values(theta + h) - values(theta - h)) / 2e-5 for h in step])
        assert_close(slopes, differences, rtol=0, atol=1e-8 * float(slopes.abs().max()))


def tip(cells, kind, laminate):
    """Mean deflection of a strip of 0.6 x 0.1, clamped at one end, under a force at the other."""
    mesh = mapped(cells, lambda s, t: (0.6 * s, 0.1 * t, 0.0), kind)
    end = mesh.node_set("right_edge")
    share = np.ones(len(end))
    share[[0, -1]] = 0.5
    load = np.zeros(6 * len(mesh.nodes))
    load[freedoms(end, [2])] = share / share.sum()
    K = stiffness(PlateMatrices(mesh, laminate), laminate)
    return load @ solved(K, load, freedoms(mesh.node_set("left_edge")))


@pytest.mark.parametrize("angles", [(0, 45, 90, -45), (20, 70), (0, 90)])
def test_the_middle_of_unsymmetric_strips_gives_way(angles):
    """Six cells, bending that varies along each: triangles need 60 x 10 for it. Without relief the first has 2 % too little."""
    laminate = Laminate(CARBON, deg(angles), 2e-3 / len(angles))
    assert tip((6, 1), "quad", laminate) == pytest.approx(tip((60, 10), "triangle", laminate), rel=0.01)
