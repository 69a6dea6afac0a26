"""modal_basis: values against SciPy and closed forms, all forms of matrices, and errors of arguments."""

import numpy as np
import pytest
import scipy.linalg
import torch

from tests.refused import ANY, refused
from torchmbd.errors import InputError
from torchmbd.fem.reduction import CutCluster, modal_basis
from torchmbd.math.sparse import Pattern, SparseMatrix


def chain(masses: int, free: bool) -> torch.Tensor:
    """Stiffness of equal unit springs between unit masses; fixed at both ends, or free."""
    K = 2 * torch.eye(masses, dtype=torch.float64)
    K -= torch.diag(torch.ones(masses - 1), 1) + torch.diag(torch.ones(masses - 1), -1)
    if free:
        K[0, 0] = K[-1, -1] = 1
    return K


def sparse(matrix: torch.Tensor) -> SparseMatrix:
    present = (matrix != 0).any(0) if matrix.dim() == 3 else matrix != 0
    pattern = Pattern(present.nonzero()[:, 0], present.nonzero()[:, 1], matrix.shape[-1])
    return SparseMatrix(pattern, matrix[..., pattern.rows, pattern.cols])


def random_pencil(size: int, seed: int = 2) -> tuple[torch.Tensor, torch.Tensor]:
    make = np.random.default_rng(seed)
    K, M = (torch.from_numpy(make.standard_normal((size, size))) for _ in range(2))
    return K @ K.T + torch.eye(size), M @ M.T / size + torch.eye(size, dtype=torch.float64)


@pytest.mark.parametrize("free", [False, True])
@pytest.mark.parametrize("masses", [7, 30])
def test_a_chain_of_springs_has_its_closed_form(masses, free):
    basis = modal_basis(chain(masses, free), torch.ones(masses, dtype=torch.float64), 5)
    k = torch.arange(5.0) if free else torch.arange(1.0, 6.0)
    expected = 4 * torch.sin(torch.pi * k.double() / (2 * masses if free else 2 * (masses + 1))) ** 2
    torch.testing.assert_close(basis.stiffness, torch.diag(expected), rtol=1e-11, atol=1e-13)


@pytest.mark.parametrize("n", [1, 6, 20])
def test_agrees_with_scipy_and_is_invariant(n):
    K, M = random_pencil(20)
    basis = modal_basis(K, M, n)
    expected = scipy.linalg.eigh(K.numpy(), M.numpy(), eigvals_only=True)[:n]
    torch.testing.assert_close(basis.stiffness, torch.diag(torch.from_numpy(expected)), rtol=1e-11, atol=1e-11)
    torch.testing.assert_close(basis.vectors.T @ M @ basis.vectors, torch.eye(n, dtype=torch.float64))
    torch.testing.assert_close(K @ basis.vectors, M @ basis.vectors @ basis.stiffness, rtol=1e-9, atol=1e-10)


def test_all_forms_of_the_same_matrices_agree():
    K, _ = random_pencil(15)
    mass = torch.linspace(1, 2, 15, dtype=torch.float64)
    reference = modal_basis(K, torch.diag(mass), 4)
    for stiffness in (K, sparse(K)):
        for M in (mass, torch.diag(mass), sparse(torch.diag(mass))):
            basis = modal_basis(stiffness, M, 4)
            torch.testing.assert_close(basis.stiffness, reference.stiffness)
            projectors = (b.vectors @ b.vectors.T for b in (basis, reference))
            torch.testing.assert_close(*projectors)


def test_lanes_broadcast_and_keep_their_shape():
    K, M = random_pencil(12)
    scale = torch.tensor([[1.0, 2.0, 3.0]], dtype=torch.float64)
    basis = modal_basis(scale[..., None, None] * K, M, 4)
    assert basis.vectors.shape == (1, 3, 12, 4)
    one = modal_basis(K, M, 4).stiffness
    torch.testing.assert_close(basis.stiffness, scale[..., None, None] * one)


def test_a_spectrum_over_twelve_decades_keeps_the_lowest_relatively_exact():
    stiff, soft = 1e12, torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    K = torch.block_diag(torch.diag(soft), torch.diag(torch.linspace(1e3, stiff, 40, dtype=torch.float64)))
    basis = modal_basis(K, torch.ones(43, dtype=torch.float64), 3)
    torch.testing.assert_close(basis.stiffness.diagonal(), soft, rtol=1e-13, atol=0)


def test_an_indefinite_stiffness_has_its_negative_modes_first():
    K = torch.diag(torch.tensor([3.0, -2.0, 5.0, -7.0, 1.0], dtype=torch.float64))
    basis = modal_basis(K, torch.ones(5, dtype=torch.float64), 3)
    torch.testing.assert_close(basis.stiffness.diagonal(), torch.tensor([-7.0, -2.0, 1.0], dtype=torch.float64))


@pytest.mark.parametrize("size", [8, 200])
def test_no_stiffness_at_all_leaves_rigid_modes_only(size):
    K, M = torch.zeros(size, size, dtype=torch.float64), torch.full((size,), 2.0, dtype=torch.float64)
    basis = modal_basis(K, M, size)
    assert basis.stiffness.abs().max() < 1e-9
    torch.testing.assert_close(2 * basis.vectors @ basis.vectors.T, torch.eye(size, dtype=torch.float64))


def test_all_modes_together_span_everything_and_only_turn():
    K, M = random_pencil(8)
    dK, dM = random_pencil(8, seed=3)
    (psi, Kr), (d_psi, d_Kr) = torch.func.jvp(lambda K, M: tuple(modal_basis(K, M, 8)), (K, M), (dK, dM))
    S = -psi.T @ dM @ psi / 2
    torch.testing.assert_close(d_psi, psi @ S, rtol=0, atol=1e-11)
    torch.testing.assert_close(d_Kr, psi.T @ dK @ psi + Kr @ S + S @ Kr, rtol=0, atol=1e-10)


def test_a_cut_cluster_is_refused_with_both_ways_out():
    K = torch.diag(torch.tensor([1.0, 2.0, 2.0, 2.0 + 1e-9, 5.0], dtype=torch.float64))
    M = torch.ones(5, dtype=torch.float64)
    with refused("n", 3, "3 and 4", "n = 1 or n = 4"):
        modal_basis(K, M, 3)
    free = torch.diag(torch.tensor([0.0, 0.0, 0.0, 2.0, 3.0], dtype=torch.float64))
    with refused("n", 2, "n = 3"):
        modal_basis(free, M, 2)
    with refused("n", 3, "lane 1"):
        modal_basis(torch.stack([K + torch.diag(torch.arange(5.0).double()), K]), M, 3)
    assert modal_basis(K, M, 4).vectors.shape == (5, 4)
    assert modal_basis(K, M, 3, cluster=1e-12).vectors.shape == (5, 3)


def test_every_lane_that_cuts_a_cluster_is_named_so_that_the_others_can_go_on():
    M = torch.ones(4, dtype=torch.float64)
    rows = [[1.0, 2.0, 3.0, 4.0], [1.0, 2.0, 2.0, 4.0], [1.0, 2.5, 3.0, 4.0], [1.0, 3.0, 3.0, 5.0]]
    K = torch.diag_embed(torch.tensor(rows, dtype=torch.float64))
    with refused("n", 2, "lane 1 (and of lanes 3)", "2 and 3 are 2 and 2", kind=CutCluster) as error:
        modal_basis(K, M, 2)
    assert error.value.lanes == (1, 3)
    assert isinstance(error.value, InputError)
    good = [lane for lane in range(4) if lane not in error.value.lanes]
    assert modal_basis(K[good], M, 2).stiffness.diagonal(dim1=1, dim2=2)[:, 1].tolist() == pytest.approx([2.0, 2.5])
    with pytest.raises(CutCluster) as error:  # leading dimensions are flattened
        modal_basis(K.reshape(2, 2, 4, 4), M, 2)
    assert error.value.lanes == (1, 3)


@pytest.mark.parametrize("n", [1, 6])
@pytest.mark.parametrize("mass", ["diagonal", "sparse"])
def test_no_stiffness_at_all_is_no_trouble_for_the_block_route(n, mass):
    """Every pivot of K is zero: the factorization fails, and a shift takes over. One lane of two, then both."""
    K = sparse(chain(200, False))
    M = torch.full((200,), 2.0, dtype=torch.float64)
    values = torch.stack([K.values, 0 * K.values])
    M_matrix = M if mass == "diagonal" else sparse(torch.diag(M))
    with pytest.raises(CutCluster) as error:
        modal_basis(SparseMatrix(K.pattern, values), M_matrix, n)
    assert error.value.lanes == (1,)  # 200 rigid modes are one cluster
    whole = modal_basis(SparseMatrix(K.pattern, values), M_matrix, 200)
    assert whole.stiffness[1].abs().max() < 1e-9
    torch.testing.assert_close(whole.stiffness[0].diagonal(), torch.linalg.eigvalsh(chain(200, False)) / 2)


K_GOOD, M_GOOD = random_pencil(6)


def changed(matrix: torch.Tensor, index: tuple[int, ...], value: float) -> torch.Tensor:
    matrix = matrix.clone()
    matrix[index] = value
    return matrix


@pytest.mark.parametrize(
    ("K", "M", "n", "fault"),
    [
        (changed(K_GOOD, (2, 3), torch.nan), M_GOOD, 2, ("K", ANY, "[2, 3] = nan")),
        (changed(K_GOOD, (1, 4), 9.0), M_GOOD, 2, ("K", ANY, "[1, 4]")),
        (K_GOOD, changed(M_GOOD, (0, 5), torch.inf), 2, ("M", ANY, "[0, 5] = inf")),
        (K_GOOD, changed(M_GOOD, (3, 3), -1.0), 2, ("M", -1.0, "[3, 3]")),
        (K_GOOD, torch.ones(6).double() - 2 * torch.eye(6).double()[4], 2, ("M", -1.0, "[4, 4]")),
        (K_GOOD, M_GOOD - 2 * torch.eye(6).double()[:1].T @ torch.ones(1, 6).double() / 2, 2, ("M", ANY, "[0, 1]")),
        (
            K_GOOD,
            torch.ones(6, 6).double() + 1e-3 * torch.diag(torch.tensor([0, 0, -1.0, 0, 0, 0]).double()),
            2,
            ("M", ANY, "row 2"),
        ),
        (K_GOOD, M_GOOD, 7, ("n", 7)),
        (K_GOOD, M_GOOD, 0, ("n", 0)),
        (K_GOOD, M_GOOD, 2.0, ("n", 2.0)),
        (K_GOOD, M_GOOD, True, ("n", True)),
        (K_GOOD.tolist(), M_GOOD, 2, ("K", ANY, "list")),
        (K_GOOD, None, 2, ("M", ANY, "NoneType")),
        (K_GOOD.expand(3, 6, 6), M_GOOD.expand(2, 6, 6), 2, ("M", ANY, "(3,)", "(2,)")),
        (K_GOOD, changed(torch.ones(6).double(), (3,), 0.0), 2, ("M", 0.0, "[3, 3]")),
        (K_GOOD[:4], M_GOOD, 2, ("K", ANY, "(4, 6)")),
        (K_GOOD, M_GOOD[:5, :5], 2, ("M", ANY, "(5, 5)", "[..., 6, 6] or [..., 6]")),
        (K_GOOD.float(), M_GOOD, 2, ("K", ANY, "torch.float32")),
        (sparse(K_GOOD), sparse(M_GOOD[:5, :5]), 2, ("M", ANY, "5 rows")),
        (changed(sparse(K_GOOD).dense(), (5, 0), torch.nan), M_GOOD, 2, ("K", ANY, "[5, 0]")),
    ],
)
def test_bad_input_is_named(K, M, n, fault):
    with refused(*fault):
        modal_basis(K, M, n)


def test_bad_entries_of_sparse_matrices_are_named_with_their_lane():
    K = sparse(chain(6, False))
    values = torch.stack([K.values, K.values])
    values[1, 3] = torch.nan
    with refused("K"):
        modal_basis(SparseMatrix(K.pattern, values), torch.ones(6, dtype=torch.float64), 2)
