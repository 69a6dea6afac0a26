"""Sparse matrices on a fixed pattern against dense arithmetic."""

import numpy as np
import pytest
import torch

from tests.refused import ANY, refused
from torchmbd.math.sparse import Pattern, SparseMatrix


@pytest.fixture
def matrix() -> SparseMatrix:
    torch.manual_seed(3)
    dense = (torch.rand(7, 7) < 0.3) | torch.eye(7, dtype=torch.bool)
    rows, cols = (dense | dense.T).nonzero().unbind(1)
    pattern = Pattern(rows, cols, 7)
    return SparseMatrix(pattern, torch.randn(4, pattern.nnz, dtype=torch.float64))


def test_dense_places_every_value(matrix):
    dense = matrix.dense()
    assert dense.shape == (4, 7, 7)
    assert torch.equal(dense[:, matrix.pattern.rows, matrix.pattern.cols], matrix.values)
    assert torch.count_nonzero(dense) == matrix.values.numel()


def test_product_agrees_with_the_dense_product(matrix):
    x = torch.randn(4, 7, 3, dtype=torch.float64)
    torch.testing.assert_close(matrix @ x, matrix.dense() @ x, rtol=1e-14, atol=1e-14)
    torch.testing.assert_close(matrix @ x[0, :, 0], matrix.dense() @ x[0, :, 0], rtol=1e-14, atol=1e-14)


def test_to_scipy_agrees_also_for_unsymmetric_values(matrix):
    one = matrix.values[1]
    assert np.array_equal(matrix.pattern.to_scipy(one).toarray(), SparseMatrix(matrix.pattern, one).dense().numpy())


@pytest.mark.parametrize("keep", [[0, 2, 3], [5, 1, 6, 0], [6, 5, 4, 3, 2, 1, 0]])
def test_restrict_is_the_submatrix_in_the_order_asked_for(matrix, keep):
    pattern, positions = matrix.pattern.restrict(keep)
    small = SparseMatrix(pattern, matrix.values[..., positions])
    assert torch.equal(small.dense(), matrix.dense()[:, keep][:, :, keep])
    assert torch.equal(matrix.restrict(keep).dense(), small.dense())


def test_gather_sums_an_assembly():
    rows, cols = [2, 0, 1, 0, 2, 1, 0], [0, 2, 1, 0, 0, 1, 2]
    pattern, position = Pattern.gather(rows, cols, 3)
    parts = torch.arange(1.0, 8.0, dtype=torch.float64)
    values = torch.zeros(pattern.nnz, dtype=torch.float64).index_add(0, position, parts)
    expected = torch.zeros(3, 3, dtype=torch.float64)
    for i, j, part in zip(rows, cols, parts, strict=True):
        expected[i, j] += part
    assert torch.equal(SparseMatrix(pattern, values).dense(), expected)


@pytest.mark.thorough
def test_derivatives_of_the_product_forward_and_reverse(matrix):
    x = torch.randn(7, 2, dtype=torch.float64, requires_grad=True)
    values = matrix.values.clone().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda v, y: SparseMatrix(matrix.pattern, v) @ y, (values, x), check_forward_ad=True, check_batched_grad=True
    )


@pytest.mark.parametrize(
    ("rows", "cols", "path"),
    [
        ([0, 3], [0, 0], "rows.1"),
        ([1, 0], [0, 1], "rows.1"),
        ([0, 0], [0, 0], "rows.1"),
        ([0, 0, 1], [0, 1, 1], "rows.1"),
        ([0, 1], [0], "cols"),
    ],
)
def test_bad_coordinates_are_named(rows, cols, path):
    with refused(path):
        Pattern(torch.tensor(rows), torch.tensor(cols), 3)


def test_more_entries_than_an_index_counts_are_refused():
    """Indices are int32, which would wrap in silence; the tensor is one number, expanded."""
    column = torch.zeros(1, dtype=torch.int32).expand(2**31)
    with refused("rows", ANY, "2147483648"):
        Pattern.unchecked(torch.zeros(2, dtype=torch.long), column, 1)


def test_a_wrong_number_of_values_is_named(matrix):
    with refused("values"):
        SparseMatrix(matrix.pattern, matrix.values[..., 1:])
    with refused("keep"):
        matrix.pattern.restrict([1, 1])
