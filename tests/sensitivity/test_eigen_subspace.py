"""Derivatives of the retained subspace on families with exact answers, by every mode of differentiation."""

from dataclasses import replace

import pytest
import torch
from torch.func import jacfwd, jacrev, jvp, vmap

from experiments.models.eigen_families import FAMILIES, by_eigh, derivative_errors, gauge_free
from torchmbd.fem.reduction import modal_basis

CROSSING = next(f for f in FAMILIES if f.name == "not commuting" and f.with_mass)


@pytest.mark.thorough
@pytest.mark.parametrize("size", [24, 180], ids=["dense", "krylov"])
@pytest.mark.parametrize("family", FAMILIES, ids=lambda f: f.name + (" M(b)" if f.with_mass else ""))
def test_gauge_free_derivatives_are_exact_in_every_family(family, size):
    errors = derivative_errors(replace(family, size=size), modal_basis)
    assert max(errors.values()) < 1e-9, errors


def test_plain_eigh_fails_at_a_crossing():
    errors = [max(derivative_errors(f, by_eigh).values()) for f in FAMILIES if f.name == "crossing of two"]
    assert not min(errors) < 1e-3, "torch.linalg.eigh has become right; say so in the README"


def response(b: torch.Tensor) -> torch.Tensor:
    """Response and energy of the family whose cluster matrices do not commute, in one vector."""
    K, M, _, _ = CROSSING.exact(b)
    result = gauge_free(*modal_basis(K, M, CROSSING.n))
    return torch.cat([result["response"], result["energy"][None]])


def exact_jacobian(b: torch.Tensor) -> torch.Tensor:
    def exact(b):
        truth = gauge_free(*CROSSING.exact(b)[2:])
        return torch.cat([truth["response"], truth["energy"][None]])

    return jacfwd(exact)(b)


def test_forward_reverse_and_backward_agree_with_the_exact_jacobian():
    b = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    expected = exact_jacobian(b.detach())
    torch.testing.assert_close(jacfwd(response)(b.detach()), expected, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(jacrev(response)(b.detach()), expected, rtol=1e-10, atol=1e-12)
    weight = torch.linspace(-1, 1, len(expected), dtype=torch.float64)
    (response(b) @ weight).backward()
    torch.testing.assert_close(b.grad, expected.T @ weight, rtol=1e-10, atol=1e-12)


def lanes_of_matrices() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Three designs, and their tangents in two directions: K, M [3, N, N], dK, dM [2, 3, N, N]."""
    b = torch.tensor([[0.0, 0.0], [0.1, -0.05], [-0.1, 0.02]], dtype=torch.float64)
    value, tangent = [], []
    for lane in b:
        pairs = [jvp(lambda b: CROSSING.exact(b)[:2], (lane,), (e,)) for e in torch.eye(2, dtype=torch.float64)]
        value.append(pairs[0][0])
        tangent.append([pair[1] for pair in pairs])
    K, M = (torch.stack([v[i] for v in value]) for i in (0, 1))
    dK, dM = (torch.stack([torch.stack([t[k][i] for t in tangent]) for k in range(2)]) for i in (0, 1))
    return K, M, dK, dM


def test_lanes_and_directions_nest_in_any_order():
    K, M, dK, dM = lanes_of_matrices()

    def push(K, M, dK, dM):
        return jvp(lambda K, M: modal_basis(K, M, CROSSING.n), (K, M), (dK, dM))[1]

    one_by_one = [[push(K[i], M[i], dK[k, i], dM[k, i]) for i in range(3)] for k in range(2)]
    expected = [torch.stack([torch.stack([one[j] for one in row]) for row in one_by_one]) for j in (0, 1)]
    routes = {
        "directions over lanes": vmap(lambda dK, dM: push(K, M, dK, dM))(dK, dM),
        "directions over vmapped lanes": vmap(lambda dK, dM: vmap(push)(K, M, dK, dM))(dK, dM),
        "lanes over directions": vmap(vmap(push, (None, None, 0, 0)), (0, 0, 1, 1), out_dims=1)(K, M, dK, dM),
    }
    for name, result in routes.items():
        for a, b in zip(result, expected, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-11, msg=name)


@pytest.mark.thorough
def test_a_mass_shared_by_all_lanes_and_one_that_alone_varies():
    K, M, dK, dM = lanes_of_matrices()
    n = CROSSING.n
    shared = jvp(lambda K: modal_basis(K, M[0], n), (K,), (dK[0],))[1]
    for lane in range(3):
        alone = jvp(lambda K, lane=lane: modal_basis(K, M[0], n), (K[lane],), (dK[0, lane],))[1]
        torch.testing.assert_close(shared[1][lane], alone[1], rtol=1e-9, atol=1e-11)
    only_mass = jvp(lambda M: modal_basis(K, M, n), (M,), (dM[1],))[1]
    with_zero = jvp(lambda K, M: modal_basis(K, M, n), (K, M), (torch.zeros_like(K), dM[1]))[1]
    for a, b in zip(only_mass, with_zero, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-11)


def test_reverse_mode_sums_over_lanes_that_share_a_mass():
    K, M, _, _ = lanes_of_matrices()
    weight = torch.linspace(0.5, 1.5, 3, dtype=torch.float64)
    shared = M[0].clone().requires_grad_()
    energy = gauge_free(*modal_basis(K, shared, CROSSING.n))["energy"]
    (energy @ weight).backward()
    total = torch.zeros_like(M[0])
    for lane in range(3):
        alone = M[0].clone().requires_grad_()
        (gauge_free(*modal_basis(K[lane], alone, CROSSING.n))["energy"] * weight[lane]).backward()
        total += alone.grad
    torch.testing.assert_close(shared.grad, total, rtol=1e-9, atol=1e-12)


def test_fixed_modes_leave_only_the_derivative_of_the_stiffness():
    b, d = torch.zeros(2, dtype=torch.float64), torch.tensor([0.3, -1.1], dtype=torch.float64)
    n = CROSSING.n
    (K, M), (dK, _) = jvp(lambda b: CROSSING.exact(b)[:2], (b,), (d,))
    basis, change = jvp(lambda b: modal_basis(*CROSSING.exact(b)[:2], n, updated=False), (b,), (d,))
    torch.testing.assert_close(basis.stiffness, modal_basis(K, M, n).stiffness, rtol=0, atol=1e-12)
    assert change.vectors.abs().max() == 0
    torch.testing.assert_close(change.stiffness, basis.vectors.T @ dK @ basis.vectors, rtol=1e-12, atol=1e-13)
    updated = jvp(lambda b: modal_basis(*CROSSING.exact(b)[:2], n), (b,), (d,))[1]
    assert (updated.stiffness - change.stiffness).abs().max() > 0.1


@pytest.mark.thorough
def test_second_derivatives_are_refused_by_name():
    b = torch.zeros(2, dtype=torch.float64)

    def energy(b):
        return response(b)[-1]

    for twice in (jacfwd(jacfwd(energy)), jacrev(jacrev(energy)), jacfwd(jacrev(energy))):
        with pytest.raises(NotImplementedError, match="second derivatives of modes"):
            twice(b)
