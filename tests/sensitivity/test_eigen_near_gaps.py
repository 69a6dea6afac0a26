"""Individual modes next to each other, from matrices that hold their modes exactly.

    K(b) = D Q(b) Lambda(b) Q(b)' D,   M = D D,   Q(b) = exp(b W) Q_0,   psi = D^-1 q,   dpsi = D^-1 W q

Q_0 is a Hadamard matrix over a power of two, D, W and Lambda are small multiples of powers of two: K, M and dK have no
rounding at b = 0. In the families of eigen_families.py rounding of K itself moves derivatives of vectors by rounding / gap^2.
What rounding leaves depends on the order in which a processor adds: 0.6 to 1.7e-7 at the nearest gap.
"""

from __future__ import annotations

import pytest
import scipy.linalg
import torch
from torch import Tensor
from torch.func import jvp, vmap

from torchmbd.fem.reduction import eigenpair_branches, eigenpairs

ONE, ZERO = (torch.full((1,), x, dtype=torch.float64) for x in (1.0, 0.0))
N_MODES = 4


def exact(size: int, gap: float, with_mass: bool) -> tuple[Tensor, ...]:
    """K, M (its diagonal), dK, the modes, their derivatives, and the slopes of the eigenvalues."""
    Q = torch.from_numpy(scipy.linalg.hadamard(size) / size**0.5)
    values = torch.cat([torch.tensor([1.0, 2.0, 2.0 + gap, 4.0]), 8 + torch.arange(size - 4) / 4]).double()
    slopes = torch.cat([torch.tensor([1.0, -1.0, 2.0, 0.5]), torch.zeros(size - 4)]).double()
    W = torch.randint(-4, 5, (size, size), generator=torch.Generator().manual_seed(size)).double() / 64
    W = W.tril(-1) - W.tril(-1).T
    A = (Q * values) @ Q.T
    dA = W @ A - A @ W + (Q * slopes) @ Q.T
    D = 2.0 ** (torch.arange(size) % 3 - 1).double() if with_mass else torch.ones(size, dtype=torch.float64)
    psi, d_psi = (x[:, :N_MODES] / D[:, None] for x in (Q, W @ Q))
    return D[:, None] * A * D, D * D, D[:, None] * dA * D, psi, d_psi, slopes[:N_MODES]


def relative(found: Tensor, expected: Tensor) -> float:
    return float((torch.linalg.norm(found - expected, dim=-2) / torch.linalg.norm(expected, dim=-2)).max())


# Rounding of K, 70 eps, over the square of the gap is 7e-5 at the least of them; blocks of eight columns leave 3.5e-7.
@pytest.mark.parametrize(("exponent", "tolerance"), [(-7, 1e-10), (-13, 1e-8), (-16, 5e-7)])
@pytest.mark.parametrize("with_mass", [False, True], ids=["", "M"])
@pytest.mark.parametrize("size", [16, 256], ids=["dense", "krylov"])
def test_vectors_and_their_derivatives_are_what_the_numbers_tell(size, with_mass, exponent, tolerance):
    K, M, dK, psi, d_psi, slopes = exact(size, 2.0**exponent, with_mass)
    (values, vectors), (d_values, d_vectors) = jvp(lambda K: tuple(eigenpairs(K, M, N_MODES)), (K,), (dK,))
    branches = eigenpair_branches(lambda b: (K + b * dK, M), ZERO, ONE, N_MODES, orders=1)
    assert float(values[2] - values[1]) == pytest.approx(2.0**exponent, rel=1e-9)
    torch.testing.assert_close(d_values, slopes, rtol=1e-8, atol=0)
    for V, dV in ((vectors, d_vectors), (branches.vectors, branches.vector_slopes)):
        sign = torch.sign((V * M[:, None] * psi).sum(0))
        assert relative(V * sign, psi) < 1e-11
        assert relative(dV * sign, d_psi) < tolerance


def test_lanes_near_and_far_from_a_gap_go_together():
    near, far = exact(16, 2.0**-13, True), exact(16, 0.5, True)
    K, dK = (torch.stack([near[i], far[i]]) for i in (0, 2))

    def push(K: Tensor, dK: Tensor) -> Tensor:
        return jvp(lambda K: eigenpairs(K, near[1], N_MODES).vectors, (K,), (dK,))[1]

    routes = {"lanes": push(K, dK), "vmap": vmap(push)(K, dK)}
    for result in routes.values():
        for lane, case in enumerate((near, far)):
            sign = torch.sign((eigenpairs(case[0], case[1], N_MODES).vectors * case[1][:, None] * case[3]).sum(0))
            assert relative(result[lane] * sign, case[4]) < 1e-9
