"""Signs of modes: fixed by the mode itself, whatever the solver returned, alone and in a batch."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.mechanisms import laminate
from tests.sensitivity.test_spectral import ring
from torchmbd.fem.reduction import craig_bampton, dense, eigenpairs, modal_basis, sparse_modes
from torchmbd.math.sparse import SparseMatrix


def plate(cells=(12, 4), reference="left", **given) -> mbd.FlexibleBody:
    mesh = mbd.mesh.rectangle(length=0.3, width=0.1, cells=cells)
    return mbd.FlexibleBody.plate("plate", mesh, laminate(), modes=6, reference=reference, **given)


def modes_of(body: mbd.FlexibleBody, angles: torch.Tensor) -> torch.Tensor:
    """psi [..., nodes, 6, modes] of designs [..., layers]."""
    with torch.no_grad():
        return torch.func.functional_call(Structure(body), {"body.laminate.angles": angles})["psi"]


class Structure(torch.nn.Module):
    """A body whose forward is its structure stage."""

    def __init__(self, body: mbd.FlexibleBody) -> None:
        super().__init__()
        self.body = body

    def forward(self) -> dict[str, torch.Tensor]:
        return self.body.structure()


def along(steps: int) -> torch.Tensor:
    """Designs on a line through the space of designs."""
    start, way = torch.from_numpy(np.random.default_rng(3).uniform(-1.0, 1.0, (2, 3)))
    return start + torch.linspace(0.0, 1.0, steps, dtype=torch.float64)[:, None] * way


BODIES = {
    "dense": {"cells": (4, 2)},
    "lanczos": {},
    "held at the center": {"reference": "center"},
    "craig-bampton": {"reduction": "craig-bampton", "interface": ["right"]},
}


@pytest.mark.thorough
@pytest.mark.parametrize("name", BODIES)
def test_a_design_alone_and_in_a_batch_has_the_same_modes(name):
    body, designs = plate(**BODIES[name]), along(11)
    together = modes_of(body, designs)
    for k in range(11):
        alone = modes_of(body, designs[k])
        lane = together[k, ..., : alone.shape[-1]]
        torch.testing.assert_close(alone, lane, rtol=0, atol=1e-6 * float(alone.abs().max()))


@pytest.fixture
def turned_solvers(monkeypatch):
    """Solvers that return modes of signs at will."""
    at_will = torch.tensor([1.0, -1.0, -1.0, 1.0, -1.0, 1.0], dtype=torch.float64)

    def turning(lowest):
        def turned(self):
            values, vectors = lowest(self)
            return values, vectors * at_will[: vectors.shape[-1]]

        return turned

    def turn() -> None:
        for kind in (dense.DenseModes, sparse_modes.SparseModes):
            monkeypatch.setattr(kind, "lowest", turning(kind.lowest))

    return turn


def problem(name):
    """A matrix and a mass whose modes are distinct: small by the dense route, large by the iteration."""
    K, M = ring(torch.tensor([0.2, 0.3], dtype=torch.float64))
    assert isinstance(K, SparseMatrix)
    return (K, M) if name == "sparse" else (K.dense()[:40, :40], M[:40])


ROUTES = {
    "modal_basis": lambda K, M: modal_basis(K, M, 5).vectors,
    "eigenpairs": lambda K, M: eigenpairs(K, M, 5).vectors,
    "craig_bampton": lambda K, M: craig_bampton(K, M, 3, [0, 7]).vectors,
}


@pytest.mark.parametrize("size", ["small", "sparse"])
@pytest.mark.parametrize("route", ROUTES)
def test_the_sign_does_not_depend_on_what_a_solver_returns(route, size, turned_solvers):
    before = ROUTES[route](*problem(size))
    turned_solvers()
    torch.testing.assert_close(ROUTES[route](*problem(size)), before, rtol=0, atol=1e-12)


def test_two_components_of_nearly_the_same_size_do_not_decide():
    """A chain that is its own mirror image: every second mode has two largest components, of opposite sign."""
    size = 41
    at = torch.arange(size, dtype=torch.float64)
    K = torch.diag(torch.full((size,), 2.0, dtype=torch.float64)) - torch.diag(torch.ones(size - 1).double(), 1)
    K = K - torch.diag(torch.ones(size - 1).double(), -1)
    result = [modal_basis(K, 1 + 1e-6 * s * (at - 20) / 20, 8).vectors for s in (-1.0, 0.0, 1.0)]
    for one in result:
        torch.testing.assert_close(one, result[1], rtol=0, atol=1e-4)


@pytest.mark.thorough
@pytest.mark.parametrize("name", BODIES)
def test_signs_hold_across_the_space_of_designs(name):
    """Of neighbors 3 degrees apart two in a hundred at most differ in sign: no rule has none, for modes may turn round."""
    body, generator = plate(**BODIES[name]), np.random.default_rng(0)
    start = torch.from_numpy(generator.uniform(-np.pi / 2, np.pi / 2, (60, 1, 3)))
    way = torch.from_numpy(generator.standard_normal((60, 1, 3)))
    designs = start + torch.linspace(0.0, 0.3, 7).double()[:, None] * way / way.norm(dim=-1, keepdim=True)
    psi = modes_of(body, designs.flatten(0, 1)).flatten(1, 2).unflatten(0, (60, 7))
    likeness = torch.nn.functional.cosine_similarity(psi[:, 1:], psi[:, :-1], dim=2)
    same = likeness[likeness.abs() > 0.9]
    assert len(same) > 1500
    assert (same < 0).double().mean() < 0.02
