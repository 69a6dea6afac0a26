"""Block Lanczos on diagonal operators, whose eigenvalues are known."""

import pytest
import torch

from torchmbd.fem.reduction.lanczos import BLOCK, Ritz, lanczos, misses_eigenvector


def largest(values: torch.Tensor, n: int, tolerance: float = 1e-12) -> Ritz | None:
    """Iterate on diag(values) [lane, N], turned by a random orthogonal matrix."""
    size = values.shape[-1]
    make = torch.Generator().manual_seed(1)
    turn = torch.linalg.qr(torch.randn(size, size, generator=make, dtype=torch.float64))[0]
    H = (turn * values[:, None, :]) @ turn.T
    return lanczos(lambda X: H @ X, (len(values), size), n, tolerance)[0]


def spectrum(size: int) -> torch.Tensor:
    return 1 / torch.arange(1.0, size + 1, dtype=torch.float64) ** 2


def test_wanted_values_and_the_recurrence():
    values = torch.stack([spectrum(300), spectrum(300).flip(0) * 5])
    ritz = largest(values, 7)
    assert ritz is not None
    expected = values.sort(-1, descending=True)[0][:, :7]
    torch.testing.assert_close(ritz.mu[:, :7], expected, rtol=1e-13, atol=1e-15)
    eye = torch.eye(ritz.Q.shape[2], dtype=torch.float64).expand(2, -1, -1)
    torch.testing.assert_close(ritz.Q.mT @ ritz.Q, eye, rtol=0, atol=1e-13)
    assert (ritz.residuals()[:, :7] <= 1e-12 + 1e-14 * values.amax(-1, keepdim=True) / expected).all()


def test_more_copies_than_the_block_has_columns_are_all_found():
    copies = BLOCK + 4
    values = 0.3 * spectrum(400) ** 2
    values[:copies] = 1.0
    ritz = largest(values[None], copies, tolerance=1e-8)
    assert ritz is not None
    torch.testing.assert_close(ritz.mu[0, :copies], values[:copies], rtol=1e-12, atol=0)


def test_unwanted_eigenvalues_just_below_the_wanted_ones_are_not_taken_for_missed_ones():
    wanted = 1 + 0.03 * torch.rand(12, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    values = torch.cat([wanted, torch.full((36,), 0.6, dtype=torch.float64), 0.3 * spectrum(552)])
    make = torch.Generator().manual_seed(1)
    turn = torch.linalg.qr(torch.randn(600, 600, generator=make, dtype=torch.float64))[0]
    H = (turn * values) @ turn.T
    ritz, recurrence = lanczos(lambda X: H @ X, (1, 600), 12, 1e-12)
    assert ritz is not None
    torch.testing.assert_close(ritz.mu[0, :12], wanted.sort(descending=True)[0], rtol=1e-12, atol=0)
    assert recurrence.X.shape[2] == BLOCK  # it did not start again


@pytest.mark.parametrize("missing", [0, 4])
def test_the_probe_notices_an_eigenvector_that_the_basis_lacks(missing):
    values, n = spectrum(200), 6
    eye = torch.eye(200, dtype=torch.float64)
    kept = [j for j in range(30) if j != missing]
    for columns, expected in ((kept, True), (list(range(30)), False)):
        count = len(columns)
        rest = torch.zeros(1, 200, 6, dtype=torch.float64), torch.zeros(1, 6, 6, dtype=torch.float64)
        ritz = Ritz(values[None, columns], eye[None, :, columns], eye[None, :count, :count], *rest)
        assert misses_eigenvector(lambda X: values[:, None] * X, ritz, n) is expected


def test_a_space_that_is_exhausted_early_stays_orthonormal():
    values = torch.tensor([4.0, 3.0, 2.0, 1.0], dtype=torch.float64).repeat_interleave(75)[None]
    values[:, 0] = 5.0
    ritz = largest(values, 1)
    assert ritz is not None
    torch.testing.assert_close(ritz.mu[:, 0], values[:, 0])
    eye = torch.eye(ritz.Q.shape[2], dtype=torch.float64)
    torch.testing.assert_close(ritz.Q[0].mT @ ritz.Q[0], eye, rtol=0, atol=1e-12)


def test_a_hopeless_spectrum_is_handed_back():
    assert largest(torch.linspace(1, 1.001, 200, dtype=torch.float64)[None], 8) is None
