"""The block route for large sparse problems against the dense one: values, deflated solves, and its parts."""

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from tests.refused import ANY, refused
from torchmbd.fem.reduction.blocks import BlockFactor, BlockRoot, DiagonalRoot, mass_root, storage
from torchmbd.fem.reduction.dense import DenseModes
from torchmbd.fem.reduction.forms import Diagonal, Sparse
from torchmbd.fem.reduction.partition import partition
from torchmbd.fem.reduction.sparse_modes import SparseModes
from torchmbd.math.sparse import Pattern, SparseMatrix

pytestmark = pytest.mark.usefixtures("products")
LANES, N = 2, 480


def grid(shuffled: bool) -> Pattern:
    """Two freedoms at each node of a 60 x 4 grid, coupled with all neighbors; numbered along or at random."""
    i, j = torch.meshgrid(torch.arange(60), torch.arange(4), indexing="ij")
    i, j = (x.flatten().repeat_interleave(2) for x in (i, j))
    near = ((i[:, None] - i).abs() <= 1) & ((j[:, None] - j).abs() <= 1)
    if shuffled:
        order = torch.randperm(N, generator=torch.Generator().manual_seed(4))
        near = near[order][:, order]
    return Pattern(near.nonzero()[:, 0], near.nonzero()[:, 1], N)


def definite(pattern: Pattern, seed: int, margin: float) -> SparseMatrix:
    """Random symmetric values, diagonally dominant by `margin` (0: singular, rows sum to zero)."""
    values = -torch.rand(LANES, pattern.nnz, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    values = values + values[:, pattern.transposed]
    on = pattern.rows == pattern.cols
    values[:, on] = 0
    sums = SparseMatrix(pattern, values) @ torch.ones(N, dtype=torch.float64)
    values[:, on] = margin - sums
    return SparseMatrix(pattern, values)


def problem(shuffled: bool, free: bool, mass: str):
    """K and M as forms with values."""
    pattern = grid(shuffled)
    K = definite(pattern, 1, 0.0 if free else 0.5)
    if mass == "diagonal":
        values = 1 + torch.rand(LANES, N, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
        return Sparse(pattern), K.values, Diagonal(N), values
    M = definite(pattern, 2, 1.0)
    return Sparse(pattern), K.values, Sparse(pattern), M.values


@pytest.mark.thorough
@pytest.mark.parametrize("mass", ["diagonal", "sparse"])
@pytest.mark.parametrize("free", [False, True])
@pytest.mark.parametrize("shuffled", [False, True])
def test_agrees_with_the_dense_route(shuffled, free, mass):
    K_form, K, M_form, M = problem(shuffled, free, mass)
    n = 5
    large, small = (kind(K_form, M_form, K, M, n) for kind in (SparseModes, DenseModes))
    assert not large.exhausted
    result, expected = large.lowest(), small.lowest()
    torch.testing.assert_close(result[0][:, :n], expected[0][:, :n], rtol=1e-11, atol=1e-12)
    torch.testing.assert_close(result[0][:, n], expected[0][:, n], rtol=1e-7, atol=0)
    projectors = [v @ v.mT for v in (result[1], expected[1])]
    torch.testing.assert_close(*projectors, rtol=0, atol=1e-10)
    # the deflated solve is a function of single vectors: give both the same ones
    signs = torch.sign((result[1] * M_form.multiply(M, expected[1])).sum(1))
    F = torch.randn(LANES, N, 3, n, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    Z, Z_expected = large.deflated_solve(F), small.deflated_solve(F)
    assert signs.abs().min() == 1
    torch.testing.assert_close(Z, Z_expected, rtol=1e-9, atol=1e-9 * Z_expected.abs().max().item())


@pytest.mark.parametrize("free", [False, True])
def test_more_modes_are_those_of_a_solution_that_begins_with_them(free):
    K_form, K, M_form, M = problem(True, free, "diagonal")
    modes, expected = SparseModes(K_form, M_form, K, M, 3), SparseModes(K_form, M_form, K, M, 6)
    modes.more(6)
    (values, psi), (expected_values, expected_psi) = modes.lowest(), expected.lowest()
    torch.testing.assert_close(values[:, :6], expected_values[:, :6], rtol=1e-11, atol=1e-12)
    torch.testing.assert_close(psi @ psi.mT, expected_psi @ expected_psi.mT, rtol=0, atol=1e-10)
    F = torch.randn(LANES, N, 1, 6, generator=torch.Generator().manual_seed(8), dtype=torch.float64)
    torch.testing.assert_close(modes.deflated_solve(F), expected.deflated_solve(F), rtol=0, atol=1e-9)


def test_the_deflated_solve_satisfies_its_equation():
    K_form, K, M_form, M = problem(True, False, "sparse")
    modes = SparseModes(K_form, M_form, K, M, 4)
    values, psi = modes.lowest()
    F = torch.randn(LANES, N, 1, 4, generator=torch.Generator().manual_seed(8), dtype=torch.float64)
    Z, F = modes.deflated_solve(F)[:, :, 0], F[:, :, 0]
    M_psi = M_form.multiply(M, psi)
    left = K_form.multiply(K, Z) - M_form.multiply(M, Z) * values[:, None, :4]
    torch.testing.assert_close(left, F - M_psi @ (psi.mT @ F), rtol=0, atol=1e-10)
    assert (M_psi.mT @ Z).abs().max() < 1e-12


def test_a_deflated_solve_does_not_depend_on_how_many_columns_are_solved_at_a_time():
    K_form, K, M_form, M = problem(False, False, "diagonal")
    modes = SparseModes(K_form, M_form, K, M, 4)
    F = torch.randn(LANES, N, 5, 4, generator=torch.Generator().manual_seed(9), dtype=torch.float64)
    together = modes.deflated_solve(F)
    apart = torch.cat([modes.deflated_solve(F[:, :, k : k + 1]) for k in range(5)], 2)
    torch.testing.assert_close(apart, together, rtol=0, atol=1e-11 * float(together.abs().max()))


class _LargestTensor(TorchDispatchMode):
    """Record how many numbers the largest tensor holds that any operation makes."""

    numbers = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        if isinstance(result, torch.Tensor) and result.untyped_storage().data_ptr():
            self.numbers = max(self.numbers, result.untyped_storage().nbytes() // 8)
        return result


@pytest.mark.thorough
def test_nothing_of_the_size_of_a_dense_matrix_is_ever_made():
    size, n = 3000, 5
    rows = torch.cat([torch.arange(size), torch.arange(size - 1), torch.arange(1, size)])
    cols = torch.cat([torch.arange(size), torch.arange(1, size), torch.arange(size - 1)])
    pattern, position = Pattern.gather(rows, cols, size)
    entries = torch.cat([torch.full((size,), 2.0), torch.full((2 * size - 2,), -1.0)]).double()
    K = torch.zeros(1, pattern.nnz, dtype=torch.float64).index_add(1, position, entries[None])
    with _LargestTensor() as largest:
        modes = SparseModes(Sparse(pattern), Diagonal(size), K, torch.ones(1, size, dtype=torch.float64), n)
        values, _ = modes.lowest()
        modes.deflated_solve(torch.ones(1, size, 4, n, dtype=torch.float64))
    exact = 4 * torch.sin(torch.pi * torch.arange(1, n + 1).double() / (2 * (size + 1))) ** 2
    torch.testing.assert_close(values[0, :n], exact, rtol=1e-9, atol=0)
    assert size * n < largest.numbers < 0.05 * size**2


def test_columns_that_are_zero_or_inside_the_retained_span_give_zero():
    K_form, K, M_form, M = problem(False, False, "diagonal")
    modes = SparseModes(K_form, M_form, K, M, 3)
    _, psi = modes.lowest()
    inside = M_form.multiply(M, psi)
    F = torch.stack([torch.zeros_like(inside), inside], dim=2)
    Z = modes.deflated_solve(F)
    assert torch.isfinite(Z).all()
    assert Z.abs().max() < 1e-12


@pytest.mark.parametrize("heavy", [1e4, 1e6, 1e8])
def test_a_payload_leaves_the_deflated_solve_exact(heavy):
    """A mass at one node makes the lowest eigenvalue small beside the others, and the columns nearly all its mode: the residual
    must keep no part in the retained modes, of which conjugate gradients would be none but rounding."""
    K_form, K, M_form, M = problem(shuffled=False, free=False, mass="diagonal")
    M = M.clone()
    M[:, 200] *= heavy
    modes = SparseModes(K_form, M_form, K, M, 5)
    values, psi = modes.lowest()
    values = values[:, None, :5]
    assert float((values[..., 4] / values[..., 0]).min()) > 0.03 * heavy
    M_psi = M_form.multiply(M, psi)
    outside = torch.randn(LANES, N, 5, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    outside = 1e-6 * (outside - M_psi @ (psi.mT @ outside))
    Z = modes.deflated_solve((outside + M_psi.sum(2, keepdim=True))[:, :, None])[:, :, 0]
    left = K_form.multiply(K, Z) - M_form.multiply(M, Z) * values
    torch.testing.assert_close(left, outside, rtol=0, atol=1e-8 * float(outside.abs().max()))


def test_partition_of_a_shuffled_grid_is_as_good_as_of_the_ordered_one():
    ordered, shuffled = (partition(Sparse(grid(flag)), Diagonal(N)) for flag in (False, True))
    assert max(ordered.sizes) == 24  # three lines of 4 x 2 freedoms, merged to the smallest block
    assert max(shuffled.sizes) <= 48
    for layout in (ordered, shuffled):
        assert torch.equal(layout.order[layout.inverse], torch.arange(N))
        assert layout.bounds[0] == 0
        assert layout.bounds[-1] == N


@pytest.mark.parametrize("shuffled", [False, True])
def test_block_factor_solves(shuffled):
    K_form, K, _, _ = problem(shuffled, False, "diagonal")
    layout = partition(K_form, Diagonal(N))
    factor = BlockFactor(layout, storage(layout, K_form, K))
    X = torch.randn(LANES, N, 4, generator=torch.Generator().manual_seed(9), dtype=torch.float64)
    solution = factor.solve(X[:, layout.order])[:, layout.inverse]
    torch.testing.assert_close(K_form.dense(K) @ solution, X, rtol=0, atol=1e-12)
    assert (factor.pivot > 1e-3).all()


def test_block_factor_marks_the_lane_that_is_not_definite():
    K_form, K, _, _ = problem(False, False, "diagonal")
    K[1, int((K_form.pattern.rows == K_form.pattern.cols).nonzero()[100])] = -1.0
    layout = partition(K_form, Diagonal(N))
    pivot = BlockFactor(layout, storage(layout, K_form, K)).pivot
    assert pivot[0] > 1e-3
    assert pivot[1] < 0


def test_mass_root_squares_to_the_mass():
    K_form, _, M_form, M = problem(True, False, "sparse")
    layout = partition(K_form, M_form)
    dense = M_form.dense(M)[:, layout.order][:, :, layout.order]
    eye = torch.eye(N, dtype=torch.float64).expand(LANES, N, N)
    root = mass_root(layout, M_form, M)
    assert isinstance(root, BlockRoot)
    torch.testing.assert_close(root.lower(root.upper(eye)), dense, rtol=0, atol=1e-12)
    torch.testing.assert_close(root.upper_inverse(root.upper(eye)), eye, rtol=0, atol=1e-12)
    diagonal = DiagonalRoot(layout.order, M_form.diagonal(M))
    torch.testing.assert_close(diagonal.upper_inverse(diagonal.upper(eye)), eye, rtol=0, atol=1e-14)


def test_a_sparse_mass_that_is_not_definite_is_named():
    K_form, K, M_form, M = problem(False, False, "sparse")
    M = M.clone()
    M[1, M_form.pattern.rows != M_form.pattern.cols] *= 3
    with refused("M", ANY, "lane 1", "row "):
        SparseModes(K_form, M_form, K, M, 4)


def test_a_krylov_space_that_fills_the_whole_reports_it():
    K_form, K, M_form, M = problem(False, False, "diagonal")
    assert SparseModes(K_form, M_form, K, M, 90).exhausted
