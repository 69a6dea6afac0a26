"""Functions of a retained span where eigenvalues cross and repeat: one derivative, the same in every mode."""

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck
from torch.func import jacfwd, jacrev, jvp, vmap

from experiments.models.eigen_families import FAMILIES, Family
from tests.refused import ANY, refused
from torchmbd.errors import InputError
from torchmbd.fem.reduction import (
    ModalBasis,
    constraint_modes,
    craig_bampton,
    eigenpairs,
    modal_basis,
    spectral_function,
)
from torchmbd.math.sparse import Pattern, SparseMatrix

MEETING = [f for f in FAMILIES if f.name != "free body"]


def label(family: Family) -> str:
    return family.name + (" M(b)" if family.with_mass else "")


def decay(x):
    return torch.exp(-0.4 * x)


def spectral(family: Family, b: torch.Tensor) -> torch.Tensor:
    K, M, _, _ = family.exact(b)
    return spectral_function(modal_basis(K, M, family.n), decay)


def closed_form(family: Family, b: torch.Tensor) -> torch.Tensor:
    _, _, Psi, low = family.exact(b)
    return Psi @ torch.linalg.matrix_exp(-0.4 * low) @ Psi.T


def at_meeting(family: Family) -> torch.Tensor:
    return torch.zeros(family.variables, dtype=torch.float64)


@pytest.mark.thorough
@pytest.mark.parametrize("family", MEETING, ids=label)
def test_a_function_of_the_span_has_its_exact_derivative_in_forward_and_reverse_mode(family):
    b = at_meeting(family)
    torch.testing.assert_close(spectral(family, b), closed_form(family, b), rtol=0, atol=1e-12)
    expected = jacfwd(lambda b: closed_form(family, b))(b)
    for mode in (jacfwd, jacrev):
        torch.testing.assert_close(mode(lambda b: spectral(family, b))(b), expected, rtol=0, atol=2e-11)
    lanes = torch.stack([b, b + 0.03])
    together = vmap(jacrev(lambda b: spectral(family, b)))(lanes)
    torch.testing.assert_close(together[0], expected, rtol=0, atol=2e-11)


def test_columns_give_the_product_without_the_square_matrix():
    family = MEETING[0]
    K, M, _, _ = family.exact(at_meeting(family))
    basis, X = modal_basis(K, M, family.n), torch.randn(len(K), 3, dtype=torch.float64)
    torch.testing.assert_close(spectral_function(basis, decay, X), spectral_function(basis, decay) @ X)


@pytest.mark.parametrize("gap", [0.0, 1e-14, 1e-11, 1e-9, 1e-7, 1e-5, 1e-3, 1e-1])
@pytest.mark.parametrize("size", [1.0, 1e8])
def test_divided_differences_lose_no_digits_at_any_gap(gap, size):
    """Of x^3: l_i^2 + l_i l_j + l_j^2."""
    values = size * torch.tensor([1.0, 1.0 + gap, 3.0], dtype=torch.float64)
    Kr = torch.diag(values)
    direction = torch.tensor([[0.3, 1.0, -0.5], [1.0, 0.7, 0.2], [-0.5, 0.2, 0.9]], dtype=torch.float64)
    one = torch.eye(3, dtype=torch.float64)
    result = jvp(lambda Kr: spectral_function(ModalBasis(one, Kr), lambda x: x**3), (Kr,), (direction,))[1]
    difference = values[:, None] ** 2 + values[:, None] * values + values**2
    torch.testing.assert_close(result, difference * direction, rtol=2e-13, atol=0)


def test_what_g_depends_on_has_its_gradient():
    family = MEETING[0]
    K, M, _, _ = family.exact(at_meeting(family))
    t = torch.tensor(0.4, dtype=torch.float64, requires_grad=True)
    spectral_function(modal_basis(K, M, family.n), lambda x: torch.exp(-x * t)).trace().backward()
    values, vectors = eigenpairs(K, M, family.n)
    expected = -(values * torch.exp(-0.4 * values) * (vectors**2).sum(0)).sum()
    torch.testing.assert_close(t.grad, expected)


@pytest.mark.parametrize("g", [lambda x: 3.0, torch.sum, torch.Tensor.float])
def test_a_g_of_another_shape_is_named(g):
    family = MEETING[0]
    K, M, _, _ = family.exact(at_meeting(family))
    with refused("g"):
        spectral_function(modal_basis(K, M, family.n), g)


CROSSINGS = [f for f in FAMILIES if f.name in ("crossing of two", "crossing of three", "not commuting")]


def loaded(U: torch.Tensor) -> torch.Tensor:
    load = torch.cos(torch.arange(len(U), dtype=torch.float64))
    return load @ U @ load


@pytest.mark.parametrize("family", CROSSINGS, ids=label)
def test_a_gradient_that_needs_values_and_vectors_of_a_cluster_together_is_refused(family):
    """U put together from single pairs: its derivative would lack what the cluster's block has beside its diagonal."""

    def from_pairs(b):
        K, M, _, _ = family.exact(b)
        values, vectors = eigenpairs(K, M, family.n)
        return loaded(vectors @ torch.diag(decay(values)) @ vectors.mT)

    with refused("modes", ANY, "spectral_function"):
        jacrev(from_pairs)(at_meeting(family))
    b = at_meeting(family).requires_grad_()
    with refused("modes", ANY, "spectral_function"):
        from_pairs(b).backward()
    assert jacrev(from_pairs)(at_meeting(family) + 0.03).isfinite().all()


@pytest.mark.parametrize("family", CROSSINGS, ids=label)
def test_a_single_vector_of_a_cluster_is_refused_and_its_span_is_not(family):
    def vectors(b):
        K, M, _, _ = family.exact(b)
        return eigenpairs(K, M, family.n)

    b = at_meeting(family)
    i = int((vectors(b).values - 2.0).abs().argmin())
    with pytest.raises(InputError, match=rf"modes .*\b{i + 1}\b.* coincide"):
        jacrev(lambda b: loaded(vectors(b).vectors[:, [i]] @ vectors(b).vectors[:, [i]].mT))(b)

    def legitimate(b):
        pairs = vectors(b)
        return (pairs.values**2).sum() + loaded(pairs.vectors @ pairs.vectors.mT)

    def exact(b):
        _, _, Psi, low = family.exact(b)
        return (low @ low).trace() + loaded(Psi @ Psi.mT)

    for mode in (jacfwd, jacrev):
        torch.testing.assert_close(mode(legitimate)(b), jacfwd(exact)(b), rtol=0, atol=1e-9)


def repeated_matrices(x, size=8):
    """K has the eigenvalue 2 twice at x = 0, where M is the identity; neither direction splits it as the other does."""
    first, *S = torch.from_numpy(np.random.default_rng(4).standard_normal((3, size, size)))
    Q, S = torch.linalg.qr(first)[0], torch.stack(S)
    low = torch.cat([torch.tensor([1.0, 2.0, 2.0], dtype=torch.float64), torch.arange(4.0, size + 1).double()])
    return Q * low @ Q.T + ((S + S.mT) * x[:, None, None]).sum(0), 1 + 0.3 * x[0] + 0 * low


def ring(x, size=200):
    """A ring of masses on a pattern, whose modes come in pairs at x = 0: waves to the left and to the right."""
    at = torch.arange(size)
    place = at.double()
    rows, cols = torch.cat([at, at, (at + 1) % size]), torch.cat([at, (at + 1) % size, at])
    pattern, position = Pattern.gather(rows, cols, size)
    spring = 1 + x[0] * torch.cos(0.7 * place) + x[1] * torch.sin(0.1 * place**2)
    entries = torch.cat([0.01 + spring + spring.roll(1), -spring, -spring])
    return SparseMatrix(pattern, entries.new_zeros(pattern.nnz).index_add(0, position, entries)), torch.ones(
        size
    ).double()


BATCHED = {
    "modal_basis": lambda K, M: _gauge_free(modal_basis(K, M, 4)),
    "spectral_function": lambda K, M: spectral_function(modal_basis(K, M, 4), decay),
    "craig_bampton": lambda K, M: _gauge_free(craig_bampton(K, M, 2, [0, 5])),
    "constraint_modes": lambda K, M: constraint_modes(K, M, [0, 5]),
}
FIVE = torch.cos(torch.arange(1000.0, dtype=torch.float64)).reshape(200, 5)


def _gauge_free(basis):
    return basis.vectors @ basis.stiffness @ basis.vectors.mT


@pytest.mark.thorough
@pytest.mark.parametrize("at", [0.0, 0.1])
@pytest.mark.parametrize("name", BATCHED)
def test_batched_gradcheck_where_a_pair_repeats_and_where_none_does(name, at):
    x = torch.full((2,), at, dtype=torch.float64, requires_grad=True)
    assert gradcheck(
        lambda x: BATCHED[name](*repeated_matrices(x)),
        (x,),
        atol=1e-7,
        check_batched_grad=True,
        check_forward_ad=True,
        check_batched_forward_grad=True,
    )


@pytest.mark.thorough
@pytest.mark.parametrize("at", [0.0, 0.1])
def test_batched_gradcheck_of_a_large_sparse_problem(at):
    """By Lanczos iteration and conjugate gradients, with pairs of waves in the span."""
    x = torch.full((2,), at, dtype=torch.float64, requires_grad=True)
    assert gradcheck(
        lambda x: FIVE.mT @ spectral_function(modal_basis(*ring(x), 5), decay, FIVE),
        (x,),
        atol=1e-5,
        check_batched_grad=True,
        check_forward_ad=True,
        check_batched_forward_grad=True,
    )


@pytest.mark.thorough
def test_batched_gradcheck_of_single_pairs_where_none_repeats():
    x = torch.tensor([0.1, -0.15], dtype=torch.float64, requires_grad=True)

    def pairs(x):
        values, vectors = eigenpairs(*repeated_matrices(x), 4)
        return values, vectors**2

    assert gradcheck(
        pairs, (x,), atol=1e-7, check_batched_grad=True, check_forward_ad=True, check_batched_forward_grad=True
    )
