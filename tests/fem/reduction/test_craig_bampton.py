"""Craig-Bampton: against an independent assembly in SciPy, exact statics at the interface, forms, lanes, bad input."""

import itertools

import numpy as np
import pytest
import scipy.linalg
import torch

from tests.refused import ANY, refused
from torchmbd.fem.reduction import (
    REDUCTIONS,
    CraigBampton,
    VibrationModes,
    constraint_modes,
    craig_bampton,
)
from torchmbd.math.sparse import Pattern, SparseMatrix

SIZE, INTERFACE = 20, [7, 0, 12]


def random_pencil(size: int = SIZE, seed: int = 2) -> tuple[torch.Tensor, torch.Tensor]:
    make = np.random.default_rng(seed)
    K, M = (torch.from_numpy(make.standard_normal((size, size))) for _ in range(2))
    return K @ K.T + torch.eye(size), M @ M.T / size + torch.eye(size, dtype=torch.float64)


def sparse(matrix: torch.Tensor) -> SparseMatrix:
    pattern = Pattern((matrix != 0).nonzero()[:, 0], (matrix != 0).nonzero()[:, 1], matrix.shape[-1])
    return SparseMatrix(pattern, matrix[pattern.rows, pattern.cols])


def band(size: int) -> torch.Tensor:
    """A chain of unequal springs, fixed at its left end."""
    k = 1 + torch.rand(size, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    return torch.diag(k + torch.cat([k[1:], k.new_zeros(1)])) - torch.diag(k[1:], 1) - torch.diag(k[1:], -1)


def textbook(K: np.ndarray, M: np.ndarray, n: int, interface: list[int]) -> np.ndarray:
    """The transformation matrix of Craig and Bampton, by dense algebra."""
    rest = [i for i in range(len(K)) if i not in interface]
    T = np.zeros((len(K), len(interface) + n))
    T[interface, range(len(interface))] = 1.0
    T[rest, : len(interface)] = -np.linalg.solve(K[np.ix_(rest, rest)], K[np.ix_(rest, interface)])
    T[rest, len(interface) :] = scipy.linalg.eigh(K[np.ix_(rest, rest)], M[np.ix_(rest, rest)])[1][:, :n]
    return T


@pytest.mark.parametrize("n", [0, 1, 6, SIZE - len(INTERFACE)])
def test_the_span_is_that_of_the_textbook_and_the_basis_is_orthonormal(n):
    K, M = random_pencil()
    result = craig_bampton(K, M, n, INTERFACE)
    T = textbook(K.numpy(), M.numpy(), n, INTERFACE)
    Kt, Mt = T.T @ K.numpy() @ T, T.T @ M.numpy() @ T
    size = n + len(INTERFACE)
    eye = torch.eye(size, dtype=torch.float64)
    torch.testing.assert_close(result.vectors.T @ M @ result.vectors, eye, rtol=0, atol=1e-12)
    torch.testing.assert_close(result.vectors.T @ K @ result.vectors, result.stiffness, rtol=0, atol=1e-11)
    expected = torch.from_numpy(T @ np.linalg.solve(Mt, T.T))
    torch.testing.assert_close(result.vectors @ result.vectors.T, expected, rtol=0, atol=1e-12)
    values = torch.from_numpy(scipy.linalg.eigh(Kt, Mt, eigvals_only=True))
    torch.testing.assert_close(result.stiffness, torch.diag(values), rtol=1e-11, atol=1e-11)


def test_numbers_of_modes_may_be_those_of_numpy():
    basis = craig_bampton(K_GOOD, M_GOOD, 2, [0])
    assert torch.equal(craig_bampton(K_GOOD, M_GOOD, np.int64(2), [0]).vectors, basis.vectors)


def test_statics_under_interface_loads_are_exact_without_a_single_mode():
    K, M = random_pencil()
    load = torch.zeros(SIZE, dtype=torch.float64)
    load[INTERFACE] = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    result = craig_bampton(K, M, 0, INTERFACE)
    reduced = result.vectors @ torch.linalg.solve(result.stiffness, result.vectors.T @ load)
    torch.testing.assert_close(reduced, torch.linalg.solve(K, load), rtol=1e-11, atol=1e-13)


def test_lowest_frequencies_come_down_to_those_of_the_whole():
    K, M = band(60), torch.ones(60, dtype=torch.float64)
    exact = torch.linalg.eigvalsh(K)[:4]
    errors = []
    for n in (0, 3, 8, 16):
        values = craig_bampton(K, M, n, [29, 59]).stiffness.diagonal()[:2]
        errors.append(((values - exact[:2]) / exact[:2]).max().item())
        assert (values > exact[:2] * (1 - 1e-12)).all()  # Rayleigh: never below
    assert errors[0] > 1e-2
    assert all(b < a / 2 for a, b in itertools.pairwise(errors))


def test_all_forms_of_the_same_matrices_agree():
    K, mass = band(200), torch.linspace(1, 2, 200, dtype=torch.float64)
    reference = craig_bampton(K, torch.diag(mass), 5, [50, 199])
    for stiffness in (K, sparse(K)):
        for M in (mass, torch.diag(mass), sparse(torch.diag(mass))):
            result = craig_bampton(stiffness, M, 5, [50, 199])
            torch.testing.assert_close(result.stiffness, reference.stiffness, rtol=1e-9, atol=1e-11)
            torch.testing.assert_close(
                result.vectors @ result.vectors.T, reference.vectors @ reference.vectors.T, rtol=0, atol=1e-10
            )


def test_lanes_broadcast():
    K, M = random_pencil()
    scale = torch.tensor([[1.0, 2.0, 3.0]], dtype=torch.float64)
    result = craig_bampton(scale[..., None, None] * K, M, 2, INTERFACE)
    assert result.vectors.shape == (1, 3, SIZE, 5)
    one = craig_bampton(K, M, 2, INTERFACE).stiffness
    torch.testing.assert_close(result.stiffness, scale[..., None, None] * one, rtol=1e-10, atol=1e-10)


def test_a_free_body_keeps_its_rigid_modes():
    K = band(30)
    K[0, 0] -= band(30).sum(0)[0]  # cut the spring to the wall
    result = craig_bampton(K, torch.ones(30, dtype=torch.float64), 3, [0, 29])
    values = result.stiffness.diagonal()
    assert values[0].abs() < 1e-10
    assert values[1] > 1e-3
    torch.testing.assert_close(result.vectors[:, 0].abs(), torch.full((30,), 30**-0.5, dtype=torch.float64))


def test_constraint_modes_are_those_of_a_chain():
    # between two held masses of a uniform chain the others lie on a line
    K = 2 * torch.eye(9, dtype=torch.float64) - torch.diag(torch.ones(8), 1) - torch.diag(torch.ones(8), -1)
    T, S = constraint_modes(K, torch.ones(9, dtype=torch.float64), [2, 6])
    line = torch.tensor([1 / 3, 2 / 3, 1, 0.75, 0.5, 0.25, 0, 0, 0], dtype=torch.float64)
    torch.testing.assert_close(T[:, 0], line)
    torch.testing.assert_close(T[:, 1], line.flip(0))
    springs = 1 / 3 + 1 / 4
    torch.testing.assert_close(S, torch.tensor([[springs, -0.25], [-0.25, springs]], dtype=torch.float64))


K_GOOD, M_GOOD = random_pencil(6)


def changed(matrix: torch.Tensor, index: tuple[int, ...], value: float) -> torch.Tensor:
    matrix = matrix.clone()
    matrix[index] = value
    return matrix


@pytest.mark.parametrize(
    ("K", "M", "n", "interface", "fault"),
    [
        (changed(K_GOOD, (2, 3), torch.nan), M_GOOD, 2, [0], ("K", ANY, "[2, 3] = nan")),
        (changed(K_GOOD, (1, 4), 9.0), M_GOOD, 2, [0], ("K", ANY, "[1, 4]")),
        (K_GOOD, changed(M_GOOD, (5, 5), -1.0), 2, [0], ("M", -1.0, "[5, 5]")),
        (K_GOOD, changed(M_GOOD, (0, 0), torch.inf), 2, [0], ("M", ANY, "[0, 0] = inf")),
        (K_GOOD, M_GOOD, 6, [0], ("n", 6)),
        (K_GOOD, M_GOOD, -1, [0], ("n", -1)),
        (K_GOOD, M_GOOD, True, [0], ("n", True)),
        (K_GOOD, M_GOOD, 2, [6], ("interface", [6])),
        (K_GOOD, M_GOOD, 2, [0.7], ("interface", ANY, "0.7")),
        (K_GOOD, M_GOOD, 2, [1, 1], ("interface", [1, 1])),
        (K_GOOD, M_GOOD, 2, [], ("interface", [])),
        (K_GOOD, M_GOOD, 0, [0, 1, 2, 3, 4, 5], ("interface", [0, 1, 2, 3, 4, 5])),
        (
            torch.block_diag(torch.eye(3).double(), torch.zeros(3, 3).double()),
            M_GOOD,
            1,
            [0],
            ("K", ANY, "interface"),
        ),
        (torch.diag(torch.arange(6.0).double()), torch.ones(6).double(), 2, [2], ("K",)),
        (
            torch.diag(torch.tensor([1.0, 2, 3, 3, 4, 5]).double()),
            torch.ones(6).double(),
            2,
            [0],
            ("n", 2),
        ),
    ],
)
def test_bad_input_is_named(K, M, n, interface, fault):
    with refused(*fault):
        craig_bampton(K, M, n, interface)


def test_as_many_modes_as_it_takes():
    """A cluster of three is longer than what is known beyond the first two."""
    K = torch.diag(torch.tensor([5.5, 1.0, 3.0, 3.0, 3.0, 4.0, 5.0]).double())
    M = torch.ones(7).double()
    for asked, result in ((0, 0), (1, 1), (2, 4), (3, 4), (4, 4), (5, 5), (6, 6)):
        assert CraigBampton(asked, [0])(K, M).stiffness.shape[-1] == 1 + result
    assert VibrationModes(2, updated=False)(K, M).stiffness.shape[-1] == 4


def test_a_lane_that_is_loose_is_named():
    K = torch.stack([K_GOOD, torch.block_diag(K_GOOD[:5, :5], torch.zeros(1, 1).double())])
    with refused("K", ANY, "lane 1", "positive definite"):
        craig_bampton(K, M_GOOD, 1, [0])


def test_members_of_the_family_say_what_they_need():
    with refused("interface"):
        REDUCTIONS["craig-bampton"](4)
    with refused("interface"):
        REDUCTIONS["vibration"](4, (1, 2))
