"""Invariants of mass matrices against integrals: points on arms that turn with nodes, and consistent beams."""

from __future__ import annotations

import numpy as np
import torch
from torch.testing import assert_close

from torchmbd.fem.reduction.mass_invariants import epsilon, has_isotropic_inertia, mass_invariants
from torchmbd.math.sparse import Pattern, SparseMatrix


def sparse(A) -> SparseMatrix:
    A = np.asarray(A)
    i, j = (k.ravel() for k in np.indices(A.shape))
    pattern, position = Pattern.gather(i, j, len(A))
    return SparseMatrix(
        pattern, torch.zeros(pattern.nnz, dtype=torch.float64).index_add(0, position, torch.tensor(A.ravel()))
    )


def points(x, psi, nodes, arms, masses):
    """Integrals over mass points on arms: mass, S0, S1, J, C0, C1."""
    place = x[nodes] + arms
    u = psi[nodes, :3] + torch.linalg.cross(psi[nodes, 3:], arms[:, :, None].expand(-1, -1, psi.shape[-1]), dim=1)
    square = place.square().sum(1)[:, None, None] * torch.eye(3, dtype=x.dtype) - place[:, :, None] * place[:, None, :]
    return {
        "mass": masses.sum(),
        "S0": masses @ place,
        "S1": torch.einsum("p,pia->ia", masses, u),
        "J": torch.einsum("p,pij->ij", masses, square),
        "C0": torch.einsum("p,pia,pj->ija", masses, u, place),
        "C1": torch.einsum("p,pia,pjb->ijab", masses, u, u),
    }


def test_points_on_arms():
    g = torch.Generator().manual_seed(1)

    def draw(*shape):
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    x, psi = draw(4, 3), draw(4, 6, 5)
    nodes, arms = torch.tensor([0, 0, 1, 1, 1, 2, 3, 3]), 0.3 * draw(8, 3)
    masses = draw(8).abs() + 0.1
    M = torch.zeros(24, 24, dtype=torch.float64)
    for k, s, m in zip(nodes.tolist(), arms, masses, strict=True):
        eye = torch.eye(3, dtype=torch.float64)
        rows = torch.cat([eye, torch.stack([torch.linalg.cross(e, s, dim=0) for e in eye], dim=1)], dim=1)
        M[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] += m * rows.T @ rows
    A = sparse(M)
    assert not has_isotropic_inertia(A)
    result = mass_invariants(x, A, psi)
    want = points(x, psi, nodes, arms, masses)
    result["J"] = result["P0"].trace() * torch.eye(3, dtype=torch.float64) - result["P0"]
    for key, value in want.items():
        assert_close(result[key], value, rtol=1e-11, atol=1e-11, msg=lambda m, k=key: f"{k}: {m}")
    assert float(result["R2"].abs().max()) < 1e-12


def test_lumped_isotropic_inertia_has_no_arms():
    m, mu = torch.tensor([1.0, 2.0, 0.5], dtype=torch.float64), torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    A = sparse(torch.diag(torch.stack([m, m, m, mu, mu, mu], 1).flatten()))
    assert has_isotropic_inertia(A)
    psi = torch.randn(3, 6, 2, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    result = mass_invariants(torch.eye(3, dtype=torch.float64), A, psi, arms=False)
    t, r = psi[:, :3], psi[:, 3:]
    assert_close(result["C1"], torch.einsum("n,nia,njb->ijab", m, t, t))
    assert_close(result["R2"], torch.einsum("n,nia,njb->ijab", mu, r, r))


def test_consistent_mass_of_a_beam():
    """Cubic deflection along x, axial motion too: integrals by Gauss points."""
    L, line = 0.8, 1.7

    def shape(s):  # displacement of the axis for the twelve freedoms of two nodes
        a, b, c, d = 1 - 3 * s**2 + 2 * s**3, L * (s - 2 * s**2 + s**3), 3 * s**2 - 2 * s**3, L * (s**3 - s**2)
        N = np.zeros((3, 12))
        N[0, [0, 6]] = a, c  # also along x, so that the mass is the same along all axes
        N[1, [1, 5, 7, 11]] = a, b, c, d
        N[2, [2, 4, 8, 10]] = a, -b, c, -d
        return N

    s, w = np.polynomial.legendre.leggauss(6)
    s, w = 0.5 * (s + 1.0), 0.5 * w * L * line
    M = sum(wk * shape(sk).T @ shape(sk) for sk, wk in zip(s, w, strict=True))
    x = torch.tensor([[0.1, 0.2, 0.3], [0.1 + L, 0.2, 0.3]], dtype=torch.float64)
    psi = torch.randn(2, 6, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    result = mass_invariants(x, sparse(M), psi)
    u = torch.tensor(np.array([shape(sk) for sk in s])) @ psi.flatten(0, 1)
    place = x[0] + torch.tensor(s)[:, None] * torch.tensor([L, 0.0, 0.0], dtype=torch.float64)
    weight = torch.tensor(w)
    assert_close(result["S1"], torch.einsum("p,pia->ia", weight, u))
    C1 = torch.einsum("p,pia,pjb->ijab", weight, u, u)
    assert_close(torch.einsum("iiab->ab", result["C1"] + result["R2"]), torch.einsum("iiab->ab", C1))
    assert_close(result["C1"][1:, 1:], C1[1:, 1:], rtol=1e-10, atol=1e-12)
    C0 = torch.einsum("p,pia,pj->ija", weight, u, place)
    moment = torch.einsum("ikj,ija->ka", epsilon(), C0)
    assert_close(torch.einsum("ikj,ija->ka", epsilon(), result["C0"]), moment)
