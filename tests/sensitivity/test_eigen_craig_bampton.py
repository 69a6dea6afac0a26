"""Derivatives of the Craig-Bampton basis on families with exact answers, by every mode of differentiation."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.func import jacfwd, jacrev, jvp, vmap

from experiments.models.eigen_families import FAMILIES, Family
from torchmbd.fem.reduction import craig_bampton
from torchmbd.math.sparse import Pattern, SparseMatrix

HELD = 3  # interface freedoms, the first ones
EYE = torch.eye(HELD, dtype=torch.float64)
CROSSING = next(f for f in FAMILIES if f.name == "not commuting" and f.with_mass)


def whole(family: Family, b: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """K and M of a body whose interior is the family, and its exact T; all smooth in b."""
    draw = np.random.default_rng(9).standard_normal((3, HELD, family.size))
    K_oo, M_oo, Phi, _ = family.exact(b)
    first, second, third = torch.from_numpy(draw)
    s = b.sum()
    K_io, M_io = first + torch.sin(s) * second, 0.05 * third * torch.cos(3 * s + 1)
    flexibility = torch.linalg.inv(K_oo)
    K_ii = K_io @ flexibility @ K_io.T + (2 + s) * EYE + torch.ones(HELD, HELD, dtype=torch.float64)
    K = torch.cat([torch.cat([K_ii, K_io], 1), torch.cat([K_io.T, K_oo], 1)])
    M = torch.cat([torch.cat([(3 + s * s - s) * EYE, M_io], 1), torch.cat([M_io.T, M_oo], 1)])
    top = torch.cat([EYE, torch.zeros(HELD, family.n, dtype=torch.float64)], 1)
    return (K + K.T) / 2, M, torch.cat([top, torch.cat([-flexibility @ K_io.T, Phi], 1)])


def of_span(T: Tensor, K: Tensor, M: Tensor) -> Tensor:
    """The projector and the dynamic response of a span, whatever its basis, in one vector."""
    Kt, Mt = T.mT @ K @ T, T.mT @ M @ T
    load = torch.cos(torch.arange(len(T), dtype=torch.float64))[:, None]
    response = T @ torch.linalg.inv(Kt + 0.3 * Mt) @ T.mT @ load
    return torch.cat([(T @ torch.linalg.inv(Mt) @ T.mT).flatten(), response.flatten()])


def exact(family: Family) -> Callable[[Tensor], Tensor]:
    def function(b: Tensor) -> Tensor:
        K, M, T = whole(family, b)
        return of_span(T, K, M)

    return function


def ours(family: Family) -> Callable[[Tensor], Tensor]:
    def function(b: Tensor) -> Tensor:
        K, M, _ = whole(family, b)
        psi, Kr = craig_bampton(K, M, family.n, range(HELD))
        load = torch.cos(torch.arange(len(psi), dtype=torch.float64))[:, None]
        response = psi @ torch.linalg.inv(Kr + 0.3 * torch.eye(len(Kr), dtype=torch.float64)) @ psi.mT @ load
        return torch.cat([(psi @ psi.mT).flatten(), response.flatten()])

    return function


@pytest.mark.thorough
@pytest.mark.parametrize("size", [24, 180], ids=["dense", "krylov"])
@pytest.mark.parametrize(
    "family", [f for f in FAMILIES if f.name != "free body"], ids=lambda f: f.name + (" M(b)" if f.with_mass else "")
)
def test_derivatives_are_exact_in_every_family(family, size):
    family = replace(family, size=size)
    b = torch.zeros(family.variables, dtype=torch.float64)
    truth, result = jacfwd(exact(family))(b), jacfwd(ours(family))(b)
    assert torch.linalg.norm(result - truth) < 1e-9 * torch.linalg.norm(truth)


@pytest.mark.thorough
def test_forward_reverse_and_backward_agree():
    b = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    truth = jacfwd(exact(CROSSING))(b.detach())
    function = ours(CROSSING)
    torch.testing.assert_close(jacrev(function)(b.detach()), truth, rtol=1e-9, atol=1e-11)
    weight = torch.linspace(-1, 1, len(truth), dtype=torch.float64)
    (function(b) @ weight).backward()
    torch.testing.assert_close(b.grad, truth.T @ weight, rtol=1e-9, atol=1e-10)


@pytest.mark.thorough
@pytest.mark.parametrize("form", ["dense", "sparse"])
def test_lanes_and_directions_nest_in_any_order(form):
    designs = torch.tensor([[0.0, 0.0], [0.1, -0.05], [-0.1, 0.02]], dtype=torch.float64)
    size = HELD + CROSSING.size
    pattern = Pattern(torch.ones(size, size).nonzero()[:, 0], torch.ones(size, size).nonzero()[:, 1], size)

    def span(K: Tensor, M: Tensor) -> Tensor:
        if form == "sparse":
            psi, Kr = craig_bampton(
                SparseMatrix(pattern, K.flatten(-2)), SparseMatrix(pattern, M.flatten(-2)), 4, range(3)
            )
        else:
            psi, Kr = craig_bampton(K, M, 4, range(HELD))
        return psi @ Kr @ psi.mT

    pairs = [[jvp(lambda b: whole(CROSSING, b)[:2], (b,), (e,)) for e in torch.eye(2).double()] for b in designs]
    K, M = (torch.stack([row[0][0][i] for row in pairs]) for i in (0, 1))
    dK, dM = (torch.stack([torch.stack([row[k][1][i] for row in pairs]) for k in range(2)]) for i in (0, 1))

    def push(K: Tensor, M: Tensor, dK: Tensor, dM: Tensor) -> Tensor:
        return jvp(span, (K, M), (dK, dM))[1]

    expected = torch.stack([torch.stack([push(K[i], M[i], dK[k, i], dM[k, i]) for i in range(3)]) for k in range(2)])
    routes = {
        "directions over lanes": vmap(lambda dK, dM: push(K, M, dK, dM))(dK, dM),
        "directions over vmapped lanes": vmap(lambda dK, dM: vmap(push)(K, M, dK, dM))(dK, dM),
        "lanes over directions": vmap(vmap(push, (None, None, 0, 0)), (0, 0, 1, 1), out_dims=1)(K, M, dK, dM),
    }
    for name, result in routes.items():
        torch.testing.assert_close(result, expected, rtol=1e-9, atol=1e-10, msg=name)


def test_a_mass_or_a_stiffness_that_alone_varies():
    b, d = torch.zeros(2, dtype=torch.float64), torch.tensor([0.4, -1.3], dtype=torch.float64)
    (K, M), (dK, dM) = jvp(lambda b: whole(CROSSING, b)[:2], (b,), (d,))

    def span(K, M):
        psi, Kr = craig_bampton(K, M, CROSSING.n, range(HELD))
        return psi @ Kr @ psi.mT

    by_K = jvp(lambda K: span(K, M), (K,), (dK,))[1]
    by_M = jvp(lambda M: span(K, M), (M,), (dM,))[1]
    torch.testing.assert_close(by_K + by_M, jvp(span, (K, M), (dK, dM))[1], rtol=1e-9, atol=1e-10)


def test_fixed_modes_leave_only_the_derivative_of_the_stiffness():
    b, d = torch.zeros(2, dtype=torch.float64), torch.tensor([0.3, -1.1], dtype=torch.float64)
    dK = jvp(lambda b: whole(CROSSING, b)[0], (b,), (d,))[1]

    def reduced(b, updated):
        return craig_bampton(*whole(CROSSING, b)[:2], CROSSING.n, range(HELD), updated=updated)

    basis, change = jvp(lambda b: reduced(b, False), (b,), (d,))
    assert change.vectors.abs().max() == 0
    torch.testing.assert_close(change.stiffness, basis.vectors.T @ dK @ basis.vectors, rtol=1e-11, atol=1e-12)
    torch.testing.assert_close(basis.stiffness, reduced(b, True).stiffness, rtol=0, atol=1e-11)
    assert (jvp(lambda b: reduced(b, True), (b,), (d,))[1].stiffness - change.stiffness).abs().max() > 0.1


@pytest.mark.thorough
def test_second_derivatives_are_refused_by_name():
    b = torch.zeros(2, dtype=torch.float64)
    for n in (0, CROSSING.n):

        def energy(b, n=n):
            return craig_bampton(*whole(CROSSING, b)[:2], n, range(HELD)).stiffness.sum()

        for twice in (jacfwd(jacfwd(energy)), jacrev(jacrev(energy)), jacfwd(jacrev(energy))):
            with pytest.raises(NotImplementedError, match="second derivatives of modes"):
                twice(b)
