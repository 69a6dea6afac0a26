"""Sparse factors, by compiled code, CHOLMOD and SuperLU, against blocks and dense matrices."""

import pytest
import torch

import torchmbd as mbd
from experiments.models import large_shells
from tests.fem.reduction.test_sparse_modes import LANES, N, definite, grid, problem
from tests.refused import ANY, refused
from torchmbd.fem.reduction import elimination, sparse_factor
from torchmbd.fem.reduction.blocks import BlockFactor
from torchmbd.fem.reduction.constraint_modes import constraint_modes
from torchmbd.fem.reduction.dense import DenseModes
from torchmbd.fem.reduction.elimination import Solver, factorize, layout, seconds_of_blocks, seconds_of_fill
from torchmbd.fem.reduction.forms import Diagonal, Sparse
from torchmbd.fem.reduction.partition import Partition, partition
from torchmbd.fem.reduction.sparse_factor import Cholmod, SparseFactor, SparseLayout, SuperLU, Supernodal
from torchmbd.fem.reduction.sparse_modes import SparseModes
from torchmbd.fem.reduction.static import StaticLoads
from torchmbd.math.sparse import Pattern, SparseMatrix


@pytest.fixture(params=["supernodal", "cholmod", "superlu"])
def sparse(request, monkeypatch):
    """All matrices have sparse factors, by this library."""
    if request.param != "superlu":
        pytest.importorskip("cvxopt")
    if request.param == "supernodal" and not sparse_factor.solves_columns_together():
        pytest.skip("no compiled code")
    kind = {"supernodal": Supernodal, "cholmod": Cholmod, "superlu": SuperLU}[request.param]
    monkeypatch.setattr(sparse_factor, "library", lambda size: kind)
    monkeypatch.setattr(elimination, "seconds_of_fill", lambda *patterns: 0.0)


def plate(nx: int, ny: int) -> Pattern:
    """Six freedoms at each node of a grid of nx x ny cells."""
    x, y = torch.meshgrid(torch.arange(nx + 1), torch.arange(ny + 1), indexing="ij")
    node = torch.stack([x.flatten(), y.flatten()], -1)
    steps = torch.cartesian_prod(torch.arange(-1, 2), torch.arange(-1, 2))
    near = node[:, None] + steps
    inside = ((near >= 0) & (near <= torch.tensor([nx, ny]))).all(-1)
    first, second = inside.nonzero()[:, 0], (near @ torch.tensor([ny + 1, 1]))[inside]
    freedom = torch.cartesian_prod(torch.arange(6), torch.arange(6))
    rows, cols = ((6 * ends[:, None] + freedom[:, k]).flatten() for k, ends in enumerate((first, second)))
    return Pattern.gather(rows, cols, 6 * len(node))[0]


def definite_plate(pattern: Pattern) -> SparseMatrix:
    """Random symmetric values, diagonally dominant."""
    values = -torch.rand(pattern.nnz, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    values = values + values[pattern.transposed]
    values[pattern.rows == pattern.cols] = 200.0
    return SparseMatrix(pattern, values, symmetric=True)


def test_the_cheaper_method_is_chosen():
    strip, wide = plate(60, 2), plate(60, 60)
    for pattern, kind in ((strip, Partition), (wide, SparseLayout)):
        form = Sparse(pattern)
        assert isinstance(layout(form, Diagonal(form.size)), kind)


def test_blocks_cost_more_the_wider_the_body_and_a_sparse_factor_grows_as_its_entries():
    costs = []
    for ny in (10, 20, 40):
        form = Sparse(plate(40, ny))
        costs.append((seconds_of_blocks(partition(form, Diagonal(form.size))), seconds_of_fill(form.pattern)))
    blocks, fill = zip(*costs, strict=True)
    assert blocks[2] / blocks[1] > 3.5
    assert fill[2] / fill[1] < 3.0


@pytest.mark.thorough
@pytest.mark.parametrize("mass", ["diagonal", "sparse"])
@pytest.mark.parametrize("free", [False, True])
def test_modes_and_deflated_solves_agree_with_the_dense_route(sparse, free, mass):
    K_form, K, M_form, M = problem(True, free, mass)
    n = 5
    large, small = SparseModes(K_form, M_form, K, M, n), DenseModes(K_form, M_form, K, M, n)
    assert isinstance(large.layout, SparseLayout)
    assert not large.exhausted
    values, vectors = large.lowest()
    exact, others = small.lowest()
    size = exact.abs().amax()
    assert (values[:, :n] - exact[:, :n]).abs().amax() < 1e-10 * size
    overlap = vectors.mT @ M_form.multiply(M, others)
    assert (overlap.abs() - torch.eye(n, dtype=torch.float64)).abs().amax() < 1e-9
    F = torch.randn(LANES, N, 2, n, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    difference = large.deflated_solve(F) - small.deflated_solve(F)
    assert difference.abs().amax() < 1e-9 * small.deflated_solve(F).abs().amax()


@pytest.mark.thorough
@pytest.mark.parametrize("mass", ["diagonal", "sparse"])
def test_derivatives_of_modes_agree_with_those_of_blocks(sparse, mass, monkeypatch):
    K_form, K, _, M = problem(False, False, mass)
    dK, dM = (definite(K_form.pattern, seed, 0.1).values for seed in (7, 8))
    dM = dM if mass == "sparse" else torch.linspace(0.1, 0.2, N, dtype=torch.float64).expand_as(M)

    def matrices(x):
        values = M + x[:, None] * dM
        M_x = SparseMatrix(K_form.pattern, values) if mass == "sparse" else values
        return SparseMatrix(K_form.pattern, K + x[:, None] * dK), M_x

    def response(x):
        basis = mbd.reduction.modal_basis(*matrices(x), 5)
        weight = torch.linspace(0.0, 1.0, N, dtype=torch.float64)[:, None]
        return torch.cat([(weight * basis.vectors).sum(-2), basis.stiffness.diagonal(dim1=-2, dim2=-1)], -1)

    def derivatives():
        x = torch.zeros(LANES, dtype=torch.float64)
        forward = torch.func.jvp(response, (x,), (torch.ones_like(x),))[1]
        y = x.clone().requires_grad_()
        (reverse,) = torch.autograd.grad(response(y).square().sum(), y)
        lanes = torch.func.vmap(lambda s: response(s.expand(LANES)))(torch.zeros(3, dtype=torch.float64))
        return response(x), forward, reverse, lanes

    by_fill = derivatives()
    monkeypatch.setattr(elimination, "seconds_of_fill", lambda *patterns: float("inf"))
    for result, expected in zip(by_fill, derivatives(), strict=True):
        assert (result - expected).abs().amax() < 1e-9 * expected.abs().amax()


def test_static_loads_and_constraint_modes_agree_with_dense_matrices(sparse):
    K = definite(grid(True), 1, 0.5)
    F = torch.rand(LANES, N, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    exact = torch.linalg.solve(K.dense(), F)
    assert (StaticLoads(K.pattern)(K, F) - exact).abs().amax() < 1e-9 * exact.abs().amax()
    held = [3, 17, 200]
    T, _ = constraint_modes(K, torch.ones(N, dtype=torch.float64), held)
    rows = torch.ones(N, dtype=torch.bool)
    rows[held] = False
    A = K.dense()
    interior = -torch.linalg.solve(A[:, rows][:, :, rows], A[:, rows][:, :, held])
    assert (T[:, rows] - interior).abs().amax() < 1e-9


def test_pivots_tell_definite_lanes_from_others(sparse):
    K = definite(grid(False), 1, 0.5)
    values = K.values.clone()
    on = K.pattern.rows == K.pattern.cols
    values[1, on.nonzero()[40]] = -1.0
    form = Sparse(K.pattern)
    pivot = factorize(layout(form, Diagonal(N)), form, values).pivot
    assert pivot[0] > 0.01
    assert pivot[1] <= 0.0
    with refused("K", ANY, "lane 1"):
        Solver(form).factorize(values, "is not positive definite: something moves")


def test_a_zero_on_the_diagonal_is_not_positive_definite(sparse):
    """SuperLU would exchange rows, and find pivots that are all positive."""
    pattern = Pattern(torch.tensor([0, 0, 1, 1]), torch.tensor([0, 1, 0, 1]), 2)
    form = Sparse(pattern)
    pivot = factorize(SparseLayout(pattern), form, torch.tensor([[0.0, 1, 1, 0]], dtype=torch.float64)).pivot
    assert pivot[0] <= 0.0


def test_an_indefinite_sparse_mass_is_refused(sparse):
    K_form, K, M_form, M = problem(False, False, "sparse")
    M[1, (K_form.pattern.rows == K_form.pattern.cols).nonzero()[5]] = -1.0
    with refused("M", ANY, "lane 1"):
        SparseModes(K_form, M_form, K, M, 3)


def test_patterns_of_stiffness_and_mass_may_differ(sparse):
    pattern, band = grid(False), torch.arange(N)
    M_pattern = Pattern.gather(torch.cat([band, band[1:], band[:-1]]), torch.cat([band, band[:-1], band[1:]]), N)[0]
    M = torch.where(M_pattern.rows == M_pattern.cols, 2.0, 0.5).to(torch.float64).repeat(LANES, 1)
    K = definite(pattern, 1, 0.5).values
    forms = Sparse(pattern), Sparse(M_pattern)
    large, small = SparseModes(*forms, K, M, 3), DenseModes(*forms, K, M, 3)
    exact = small.eigenvalues()[:, :3]
    assert (large.eigenvalues()[:, :3] - exact).abs().amax() < 1e-10 * exact.amax()


def test_a_missing_library_is_named_once_for_large_bodies(monkeypatch, recwarn):
    monkeypatch.setattr(sparse_factor, "_has_cvxopt", lambda: False)
    sparse_factor._warn_missing.cache_clear()
    for size in (100, 30_000, 40_000):
        assert sparse_factor.library(size) is SuperLU
    messages = [str(w.message) for w in recwarn]
    assert len(messages) == 1
    assert "torchmbd[large]" in messages[0]


def test_modes_and_static_solutions_of_one_design_share_one_factorization(monkeypatch):
    made = []
    initialize = BlockFactor.__init__
    monkeypatch.setattr(BlockFactor, "__init__", lambda self, *args: (made.append(self), initialize(self, *args))[1])
    pattern = plate(30, 2)
    K = definite_plate(pattern)
    F = torch.ones(pattern.size, 1, dtype=torch.float64)
    mass = torch.ones(pattern.size, dtype=torch.float64)
    first = StaticLoads(pattern)(K, F)
    basis = mbd.reduction.modal_basis(K, mass, 3)
    assert torch.equal(StaticLoads(pattern)(K, F), first)
    assert len(made) == 1
    K.values.mul_(2.0)  # other numbers in the same tensor
    assert (StaticLoads(pattern)(K, F) - 0.5 * first).abs().amax() < 1e-9 * first.abs().amax()
    stiffer = mbd.reduction.modal_basis(K, mass, 3)
    assert (stiffer.stiffness - 2.0 * basis.stiffness).abs().amax() < 1e-9 * stiffer.stiffness.abs().amax()
    assert len(made) == 2


@pytest.mark.thorough
def test_a_motion_and_its_gradient_factorize_once_for_a_design(monkeypatch):
    """The body, its checks, its first motion and the gradient share one sparse factor; another design has another."""
    made = []
    initialize = SparseFactor.__init__
    monkeypatch.setattr(SparseFactor, "__init__", lambda self, *args: (made.append(self), initialize(self, *args))[1])
    monkeypatch.setattr(elimination, "seconds_of_fill", lambda *patterns: 0.0)
    system = large_shells.plate(8, 4, modes=3)
    energy = mbd.Integral(mbd.StrainEnergy("shell"))
    energy(mbd.simulate(system, 0.01, steps=2)).sum().backward()
    assert len(made) == 1
    angles = mbd.deg([30.0, -60.0, 10.0, 80.0])[None].requires_grad_()
    energy(mbd.simulate(system, 0.01, steps=2, designs={"shell.laminate.angles": angles})).sum().backward()
    assert len(made) == 2
