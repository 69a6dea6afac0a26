"""Linear stress states: equilibrium, their displacements in any material, their work on sides, bending along medians."""

import pytest
import torch
from torch.func import jacfwd
from torch.testing import assert_close

from torchmbd.fem.elements.quad_membrane import bending, displacements, side_work, stresses
from torchmbd.fem.elements.quad_shape import middle

CELL = torch.tensor([[[-0.6, -0.4], [0.7, -0.5], [0.4, 0.8], [-0.5, 0.1]]], dtype=torch.float64)
PLACE = torch.tensor([0.3, -0.7], dtype=torch.float64)
S = torch.tensor([[0.9, -0.2, 0.4], [-0.2, 1.7, -0.3], [0.4, -0.3, 2.6]], dtype=torch.float64)


def stress(p):
    return stresses(p[None, None])[0, 0]


def moved(p):
    """(u, v, theta) of the states at one place: the first corner of a cell that begins there."""
    return displacements(p.expand(1, 4, 2), S)[0, :3]


def test_states_are_in_equilibrium():
    slope = jacfwd(stress)(PLACE)  # [component, state, direction]
    assert (slope[0, :, 0] + slope[2, :, 1] == 0).all()
    assert (slope[2, :, 0] + slope[1, :, 1] == 0).all()
    assert torch.linalg.matrix_rank(slope.movedim(1, 0).flatten(1)) == 4


def test_displacements_have_the_strains_of_the_material():
    slope = jacfwd(moved)(PLACE)
    strain = torch.stack([slope[0, :, 0], slope[1, :, 1], slope[0, :, 1] + slope[1, :, 0]])
    assert_close(strain, S @ stress(PLACE))
    assert_close(moved(PLACE)[2], 0.5 * (slope[1, :, 0] - slope[0, :, 1]))


@pytest.mark.thorough
def test_work_is_that_of_the_tractions_on_sides_that_bend_as_parabolas():
    generator = torch.Generator().manual_seed(5)
    u = torch.randn(4, 3, generator=generator, dtype=torch.float64)
    x, total, steps = CELL[0], torch.zeros(4, dtype=torch.float64), 400
    for i in range(4):
        j = (i + 1) % 4
        side = x[j] - x[i]
        length = side.norm()
        n = torch.stack([side[1], -side[0]]) / length
        for k in range(steps):
            s = (k + 0.5) / steps
            bow = 0.5 * length * s * (1 - s) * (u[j, 2] - u[i, 2]) * n
            xx, yy, xy = stress(x[i] + s * side)
            traction = torch.stack([xx * n[0] + xy * n[1], xy * n[0] + yy * n[1]])
            total += length / steps * (((1 - s) * u[i, :2] + s * u[j, :2] + bow) @ traction)
    assert_close(side_work(CELL)[0] @ u.flatten(), total, rtol=1e-4, atol=1e-4)


def test_bending_pulls_fibers_along_a_median():
    medians = middle(CELL).jacobian[:, 0]
    result = stress(PLACE) @ bending(medians)[0]
    for k, e in enumerate(medians[0]):
        across = e[0] * PLACE[1] - e[1] * PLACE[0]
        assert_close(result[:, k], torch.stack([e[0] ** 2, e[1] ** 2, e[0] * e[1]]) * across)
