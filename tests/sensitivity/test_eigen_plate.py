"""Square simply supported angle-ply plates at 45 degrees, where modes (1, 2) and (2, 1) have one frequency."""

import itertools
import math

import pytest
import torch
from torch.func import functional_call, jacfwd, jacrev, jvp, vmap

from torchmbd.fem.elements import PlateMatrices
from torchmbd.fem.materials import Laminate, Ply
from torchmbd.fem.mesh import rectangle
from torchmbd.fem.reduction import eigenpair_branches, eigenpairs, modal_basis
from torchmbd.math.sparse import SparseMatrix

CARBON = Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=5.36e9, nu12=0.23, density=1586.0)
AT = torch.tensor([math.pi / 4], dtype=torch.float64)
ONE = torch.ones(1, dtype=torch.float64)
N_MODES = 4


GLASS = Ply(E1=38.6e9, E2=8.27e9, G12=4.14e9, G13=4.14e9, G23=3.4e9, nu12=0.26, density=1800.0)
# ply, pairs of layers theta / -theta, side [m], thickness of a layer [m], cells
PLATES = {
    "carbon, two layers": (CARBON, 1, 0.3, 2e-3, 8),
    "glass, four layers, thick": (GLASS, 2, 0.5, 8e-3, 6),
}


@pytest.fixture(scope="module", params=PLATES)
def plate(request):
    """From [theta] to K and M of the free freedoms; edges hold the deflection and both in-plane displacements."""
    ply, pairs, side, thickness, cells = PLATES[request.param]
    mesh = rectangle(side, side, (cells, cells), "triangle")  # whose fourth mode is single
    laminate = Laminate(ply, [math.pi / 4, -math.pi / 4] * pairs, thickness)
    matrices = PlateMatrices(mesh, laminate)
    edge = {i for name, nodes in mesh.node_sets.items() if name.endswith("_edge") for i in nodes}
    keep = [6 * i + f for i in range(len(mesh.nodes)) for f in range(6) if i not in edge or f > 2]
    pattern, positions = matrices.pattern.restrict(keep)
    mass = matrices.lumped_mass(laminate.mass_per_area, laminate.rotary_inertia_per_area)[keep].detach()

    def of_angle(theta):
        angles = torch.cat([theta, -theta] * pairs)
        return SparseMatrix(
            pattern, matrices.values(functional_call(laminate, {"angles": angles}, ()), positions)
        ), mass

    return of_angle


def central(function, h: float) -> torch.Tensor:
    """Central difference at AT, two steps extrapolated."""
    coarse, fine = ((function(AT + s) - function(AT - s)) / (2 * s) for s in (h, h / 2))
    return (4 * fine - coarse) / 3


def one_sided(function, h: float) -> torch.Tensor:
    """Difference to the right, four steps extrapolated."""
    table = [(function(AT + s) - function(AT)) / s for s in (h, h / 2, h / 4, h / 8)]
    for power in (1, 2, 3):
        table = [(2**power * b - a) / (2**power - 1) for a, b in itertools.pairwise(table)]
    return table[0]


@pytest.mark.thorough
def test_the_pair_is_repeated_and_its_slopes_are_one_sided_differences(plate):
    def values(theta):
        return eigenpairs(*plate(theta), N_MODES).values

    at = values(AT)
    assert (at[2] - at[1]) / at[1] < 1e-10
    slopes = jvp(values, (AT,), (ONE,))[1]
    assert slopes[2] > 0.01 * at[2]
    torch.testing.assert_close(slopes[1], -slopes[2], rtol=1e-7, atol=0)  # theta and 90 degrees - theta are one plate
    expected = one_sided(values, 1e-2)
    torch.testing.assert_close(slopes[1:3], expected[1:3], rtol=1e-6, atol=0)
    result = eigenpair_branches(plate, AT, ONE, N_MODES)
    assert result.split.tolist()[:3] == [0, 1, 1]
    torch.testing.assert_close(result.value_slopes, slopes, rtol=1e-7, atol=1e-7 * at[2].item())


@pytest.mark.thorough
def test_branches_continue_the_modes_across_the_crossing(plate):
    result = eigenpair_branches(plate, AT, ONE, N_MODES)
    M = plate(AT)[1]

    def shape(theta, i):
        vectors = eigenpairs(*plate(theta), N_MODES).vectors
        overlap = (result.vectors[:, i] * M) @ vectors
        j = int(overlap.abs().argmax())
        return vectors[:, j] * torch.sign(overlap[j])

    for i in (1, 2):
        difference = central(lambda theta, i=i: shape(theta, i), 2e-2)
        error = (result.vector_slopes[:, i] - difference) * M.sqrt()
        assert error.norm() < 1e-4 * (difference * M.sqrt()).norm()


@pytest.mark.thorough
def test_forward_and_reverse_agree_on_sparse_values_in_lanes(plate):
    load = torch.cos(torch.arange(len(plate(AT)[1]), dtype=torch.float64))

    def responses(theta):
        basis = modal_basis(*plate(theta), N_MODES)
        values = eigenpairs(*plate(theta), N_MODES).values
        amplitudes = basis.vectors.T @ load
        force = basis.vectors @ (basis.stiffness @ amplitudes)
        return torch.cat([(basis.vectors @ amplitudes)[::40], 1e-6 * force[::40], 1e-6 * values])

    forward, reverse = jacfwd(responses)(AT + 0.1), jacrev(responses)(AT + 0.1)
    torch.testing.assert_close(reverse, forward, rtol=1e-8, atol=1e-8 * forward.abs().max().item())
    lanes = torch.stack([AT + 0.1, AT - 0.2])
    together = vmap(jacfwd(responses))(lanes)
    for lane, theta in enumerate(lanes):
        alone = jacfwd(responses)(theta)
        torch.testing.assert_close(together[lane], alone, rtol=1e-8, atol=1e-8 * alone.abs().max().item())


@pytest.mark.thorough
def test_responses_of_the_reduced_plate_do_not_notice_the_crossing(plate):
    load = torch.sin(torch.arange(len(plate(AT)[1]), dtype=torch.float64))

    def responses(theta):
        basis = modal_basis(*plate(theta), N_MODES)
        w = torch.linalg.solve(basis.stiffness, basis.vectors.T @ load[:, None])
        energy = (w.T @ basis.stiffness @ w).squeeze(0) / 2
        return torch.cat([energy * 1e3, (basis.vectors @ w)[::7, 0]])

    result, expected = jvp(responses, (AT,), (ONE,))[1], central(responses, 1e-2)
    torch.testing.assert_close(result[0], expected[0], rtol=1e-6, atol=0)
    assert torch.linalg.norm(result - expected) < 1e-6 * torch.linalg.norm(expected)
