"""Derivatives of individual eigenvalues and modes: exact families, Nelson's bordered solve, answers at clusters."""

from dataclasses import replace

import pytest
import torch
from torch.func import grad, jacfwd, jacrev, jvp, vjp, vmap

from experiments.models.eigen_families import FAMILIES, Family
from tests.refused import ANY, refused
from torchmbd.fem.reduction import eigenpairs, modal_basis, spectral_function
from torchmbd.math.sparse import Pattern, SparseMatrix

ONE = torch.ones(1, dtype=torch.float64)
ZERO = torch.zeros(1, dtype=torch.float64)
SMOOTH = [f for f in FAMILIES if f.name == "distinct"]
REPEATED = [
    f
    for f in FAMILIES
    if f.name in ("crossing of two", "crossing of three", "equal slopes", "always repeated", "partly splitting triple")
]


def label(family: Family) -> str:
    return family.name + (" M(b)" if family.with_mass else "")


def modes(family: Family, b: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    K, M, _, _ = family.exact(b)
    return tuple(eigenpairs(K, M, family.n))


def exact_modes(family: Family, b: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    _, _, psi, low = family.exact(b)
    return low.diagonal(dim1=-2, dim2=-1), psi


def signs(family: Family, found: torch.Tensor) -> torch.Tensor:
    _, M, psi, _ = family.exact(ZERO)
    return torch.sign((psi * (M @ found)).sum(0))


@pytest.mark.parametrize("size", [24, 180], ids=["dense", "krylov"])
@pytest.mark.parametrize("family", SMOOTH, ids=label)
def test_distinct_modes_have_their_exact_derivatives(family, size):
    family = replace(family, size=size)
    (values, vectors), (d_values, d_vectors) = jvp(lambda b: modes(family, b), (ZERO,), (ONE,))
    (exact_values, exact_vectors), (d_exact_values, d_exact_vectors) = jvp(
        lambda b: exact_modes(family, b), (ZERO,), (ONE,)
    )
    sign = signs(family, vectors)
    torch.testing.assert_close(values, exact_values, rtol=1e-12, atol=0)
    torch.testing.assert_close(vectors * sign, exact_vectors, rtol=0, atol=1e-11)
    torch.testing.assert_close(d_values, d_exact_values, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(d_vectors * sign, d_exact_vectors, rtol=0, atol=1e-9)


def test_every_mode_of_differentiation_gives_the_same_jacobian():
    family = SMOOTH[1]

    def function(b):
        values, vectors = modes(family, b)
        return torch.cat([values, (vectors**2).flatten()[:40]])

    forward = jacfwd(function)(ZERO)
    torch.testing.assert_close(jacrev(function)(ZERO), forward, rtol=1e-9, atol=1e-11)
    b = ZERO.clone().requires_grad_()
    weight = torch.linspace(-1, 2, len(forward), dtype=torch.float64)
    (function(b) @ weight).backward()
    torch.testing.assert_close(b.grad, forward.T @ weight, rtol=1e-9, atol=1e-11)
    lanes = torch.tensor([[0.0], [0.05]], dtype=torch.float64)
    torch.testing.assert_close(vmap(jacfwd(function))(lanes)[0], forward, rtol=1e-9, atol=1e-11)


def test_agrees_with_nelsons_bordered_solve_on_a_sparse_chain():
    n, size = 4, 200
    make = torch.Generator().manual_seed(3)
    spring = 1 + torch.rand(size, generator=make, dtype=torch.float64)
    rows = torch.cat([torch.arange(size), torch.arange(size - 1), torch.arange(1, size)])
    cols = torch.cat([torch.arange(size), torch.arange(1, size), torch.arange(size - 1)])
    pattern, position = Pattern.gather(rows, cols, size)

    def values_of(k):
        entries = torch.cat([k + torch.cat([k[1:], k.new_zeros(1)]), -k[1:], -k[1:]])
        return k.new_zeros(pattern.nnz).index_add(0, position, entries)

    mass = 1 + torch.rand(size, generator=make, dtype=torch.float64)
    change, mass_change = (torch.rand(size, generator=make, dtype=torch.float64) for _ in range(2))
    (values, vectors), (d_values, d_vectors) = jvp(
        lambda k, m: tuple(eigenpairs(SparseMatrix(pattern, values_of(k)), m, n)), (spring, mass), (change, mass_change)
    )
    K, dK = (SparseMatrix(pattern, values_of(k)).dense() for k in (spring, change))
    for i in range(n):
        psi, M_psi = vectors[:, i], mass * vectors[:, i]
        bordered = torch.zeros(size + 1, size + 1, dtype=torch.float64)
        bordered[:size, :size] = K - values[i] * torch.diag(mass)
        bordered[:size, size] = bordered[size, :size] = -M_psi
        force = -(dK @ psi - values[i] * mass_change * psi)
        right = torch.cat([force, (psi @ (mass_change * psi) / 2)[None]])
        answer = torch.linalg.solve(bordered, right)
        torch.testing.assert_close(d_values[i], answer[size], rtol=1e-9, atol=0)
        torch.testing.assert_close(d_vectors[:, i], answer[:size], rtol=0, atol=1e-8 * answer[:size].abs().max().item())


@pytest.mark.parametrize("family", REPEATED, ids=label)
def test_repeated_eigenvalues_have_their_one_sided_slopes_and_the_cluster_moves_as_a_span(family):
    (values, vectors), (d_values, d_vectors) = jvp(lambda b: modes(family, b), (ZERO,), (ONE,))
    (exact_values, _), (slopes, _) = jvp(lambda b: exact_modes(family, b), (ZERO,), (ONE,))
    order = sorted(range(family.n), key=lambda i: (round(exact_values[i].item(), 6), slopes[i].item()))
    torch.testing.assert_close(values, exact_values[order], rtol=1e-12, atol=0)
    torch.testing.assert_close(d_values, slopes[order], rtol=1e-8, atol=1e-10)
    first, last = (exact_values[order] == 2.0).nonzero().squeeze(-1)[[0, -1]].tolist()
    cluster = slice(first, last + 1)
    cluster_projector = 2 * (d_vectors[:, cluster] @ vectors[:, cluster].T)
    exact_cluster = [order[i] for i in range(first, last + 1)]

    def exact_projector(b):
        psi = exact_modes(family, b)[1][:, exact_cluster]
        return psi @ psi.T

    expected = jvp(exact_projector, (ZERO,), (ONE,))[1]
    torch.testing.assert_close((cluster_projector + cluster_projector.T) / 2, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("gap", ["gap 1e-10", "gap 1e-8", "gap 1e-6", "gap 1e-4"])
def test_nearly_repeated_eigenvalues_keep_their_own_slopes(gap):
    for family in (f for f in FAMILIES if f.name == gap):
        d_values = jvp(lambda b, f=family: modes(f, b)[0], (ZERO,), (ONE,))[1]
        slopes = jvp(lambda b, f=family: exact_modes(f, b)[0], (ZERO,), (ONE,))[1]
        torch.testing.assert_close(d_values, slopes, rtol=1e-8, atol=0)


def test_the_rigid_body_modes_of_a_free_body_have_no_slopes():
    for family in (f for f in FAMILIES if f.name == "free body"):
        d_values = jvp(lambda b, f=family: modes(f, b)[0], (ZERO,), (ONE,))[1]
        assert d_values[:3].abs().max() < 1e-12


NOT_COMMUTING = [f for f in FAMILIES if f.name == "not commuting"]


@pytest.mark.parametrize("family", NOT_COMMUTING, ids=label)
@pytest.mark.parametrize("direction", [(1.0, 0.0), (0.0, 1.0), (0.6, -0.8)])
def test_with_two_variables_slopes_are_right_along_each_direction(family, direction):
    # the block [[2 + b0, b1], [b1, 2 - b0]] has eigenvalues 2 -+ |b|: a cone, differentiable in no linear sense
    b, d = torch.zeros(2, dtype=torch.float64), torch.tensor(direction, dtype=torch.float64)
    d_values = jvp(lambda b: modes(family, b)[0], (b,), (d,))[1]
    expected = torch.tensor([direction[0], -1.0, 1.0, -direction[1]], dtype=torch.float64)
    torch.testing.assert_close(d_values, expected, rtol=1e-9, atol=1e-10)


def test_reverse_mode_at_a_cluster_gives_the_mean_and_exact_sums():
    family = NOT_COMMUTING[1]
    J = jacrev(lambda b: modes(family, b)[0])(torch.zeros(2, dtype=torch.float64))
    expected = torch.tensor([[1.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.0, -1.0]], dtype=torch.float64)
    torch.testing.assert_close(J, expected, rtol=1e-9, atol=1e-10)


def test_lanes_with_and_without_clusters_mix():
    crossing = next(f for f in FAMILIES if f.name == "crossing of two")
    lanes = torch.tensor([[0.0], [0.2], [0.0]], dtype=torch.float64)
    together = vmap(lambda b: jvp(lambda b: modes(crossing, b)[0], (b,), (ONE,))[1])(lanes)
    for lane, b in enumerate(lanes):
        alone = jvp(lambda b: modes(crossing, b)[0], (b,), (ONE,))[1]
        torch.testing.assert_close(together[lane], alone)


def test_a_cut_cluster_is_refused():
    K = torch.diag(torch.tensor([1.0, 2.0, 2.0, 3.0], dtype=torch.float64))
    with refused("n", 2):
        eigenpairs(K, torch.ones(4, dtype=torch.float64), 2)


def pair(gap: float, b: torch.Tensor) -> torch.Tensor:
    """A matrix with the eigenvalues 2, 2 + gap, and 3 and 5, whose first two turn and split with b."""
    Q = torch.linalg.qr(torch.cos(torch.arange(16, dtype=torch.float64).square()).reshape(4, 4))[0]
    low = torch.diag(torch.tensor([2.0, 2.0 + gap, 3.0, 5.0], dtype=torch.float64))
    change = torch.tensor([[0.3, 1, 0.2, 0], [1, -0.5, 0.4, 0.1], [0.2, 0.4, 1, 0], [0, 0.1, 0, 0.5]]).double()
    return Q @ (low + b * change) @ Q.T


def root_by_pairs(gap: float, b: torch.Tensor) -> torch.Tensor:
    values, vectors = eigenpairs(pair(gap, b), torch.ones(4, dtype=torch.float64), 3)
    return (vectors * values.sqrt()) @ vectors.mT


def root_by_spectrum(gap: float, b: torch.Tensor) -> torch.Tensor:
    return spectral_function(modal_basis(pair(gap, b), torch.ones(4, dtype=torch.float64), 3), torch.sqrt)


@pytest.mark.thorough
@pytest.mark.parametrize("gap", [0.0, 1e-13, 1e-12, 1e-10, 1e-8, 1e-6, 1e-5, 1e-3])
def test_functions_of_values_and_vectors_are_exact_or_refused_in_every_mode(gap):
    """Forward mode is exact; reverse mode where rounding leaves anything of single pairs."""
    (b,) = ZERO
    exact = jvp(lambda b: root_by_spectrum(gap, b), (b,), (torch.ones_like(b),))[1]
    forward = [
        lambda: jvp(lambda b: root_by_pairs(gap, b), (b,), (torch.ones_like(b),))[1],
        lambda: jacfwd(lambda b: root_by_pairs(gap, b))(b),
    ]
    tolerance = {"rtol": 0, "atol": 2e-6 if gap < 1e-6 else 1e-9}
    for way in (*forward, lambda: jacrev(lambda b: root_by_pairs(gap, b))(b)):
        if (0.0 < gap < 1e-9) or (gap == 0.0 and way not in forward):
            with refused("modes", ANY, "spectral_function"):
                way()
        else:
            torch.testing.assert_close(way(), exact, **tolerance)


def test_a_pair_along_the_axes_is_refused_too():
    """sqrt(K) of K = 2 with a change beside its diagonal: cotangents of the axes' own pairs would say nothing."""

    def root(b):
        K = torch.stack([torch.stack([2.0 + 0.0 * b, b]), torch.stack([b, 2.0 + 0.0 * b])])
        values, vectors = eigenpairs(K, torch.ones(2, dtype=torch.float64), 2)
        return ((vectors * values.sqrt()) @ vectors.mT)[0, 1]

    (b,) = ZERO
    assert jvp(root, (b,), (torch.ones_like(b),))[1].item() == pytest.approx(0.125**0.5, rel=1e-14)
    for way in (jacrev(root), grad(root)):
        with refused("modes", [1, 2]):
            way(b)
    with refused("modes", [1, 2], "along a direction"):
        jvp(lambda b: vmap(root)(b[None]), (b,), (torch.ones_like(b),))


@pytest.mark.thorough
def test_gradients_of_torch_func():
    """grad, vjp and vmap of grad, of the span and of single vectors."""
    K = torch.tensor([[2.0, 1, 0], [1, 3, 0.5], [0, 0.5, 7]], dtype=torch.float64)
    dK = torch.tensor([[0, 1.0, 2], [1, 0, 1], [2, 1, 1]], dtype=torch.float64)
    b = torch.tensor([0.3, 0.4], dtype=torch.float64)
    for response in (lambda v: (v @ v.mT)[0, 1], lambda v: v[0, 0] ** 2):

        def f(b, response=response):
            values, vectors = eigenpairs(K + b * dK, torch.ones(3, dtype=torch.float64), 2)
            return response(vectors) + values.prod()

        forward = torch.stack([jacfwd(f)(x) for x in b])
        torch.testing.assert_close(vmap(grad(f))(b), forward)
        torch.testing.assert_close(vjp(f, b[0])[1](ONE[0])[0], forward[0])
        torch.testing.assert_close(grad(f)(b[1]), forward[1])


@pytest.mark.parametrize("unit", [1.0, 1e9, 1e-9])
def test_rigid_motions_alone_have_no_derivative_but_zero(unit):
    """A free beam of Hermite's elements in a plane: a change of its stiffness moves no rigid motion, in any unit."""
    h, nodes = 0.2, 6
    rows = [[12, 6 * h, -12, 6 * h], [6 * h, 4 * h * h, -6 * h, 2 * h * h]]
    rows += [[-x for x in rows[0]], [6 * h, 2 * h * h, -6 * h, 4 * h * h]]
    element = torch.tensor(rows, dtype=torch.float64) / h**3
    mass = torch.tensor([1.0, 1e-2], dtype=torch.float64).repeat(nodes)

    def values(b: torch.Tensor) -> torch.Tensor:
        K = torch.zeros(2 * nodes, 2 * nodes, dtype=torch.float64)
        for e in range(nodes - 1):
            at = torch.arange(2 * e, 2 * e + 4)
            K = K.index_put((at[:, None], at), unit * b[0] * element, accumulate=True)
        return eigenpairs(K, b[1] * mass, 2).values

    b = torch.tensor([2.0, 1.5], dtype=torch.float64)
    largest = unit * float(element.diagonal().max()) / 1e-2
    for jacobian in (jacfwd(values)(b), jacrev(values)(b), vmap(jacfwd(values))(b[None])[0]):
        assert float(jacobian.abs().max()) < 1e-12 * largest
