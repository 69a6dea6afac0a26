"""Sparse factors of large saddle-point matrices against dense ones: values, derivatives in every mode, odd matrices."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import GRAVITY, box, plate
from torchmbd.integrate.prepared import initial
from torchmbd.multibody.saddle.factors import LARGE, ColumnPattern, Factors
from torchmbd.multibody.system import Dynamics

LANES = 3


def chain(links: int, closed: bool = False) -> mbd.System:
    """Flexible and rigid links in turns; closed: the last is welded to the one before by a second joint, which is redundant."""
    bodies = [box(f"b{i}") if i % 3 == 0 else plate(f"b{i}", modes=4) for i in range(links)]
    ends = [mbd.Ground().at(), *(body.at("right") if hasattr(body, "mesh") else body.at(0.3) for body in bodies)]
    starts = [body.at("left") if hasattr(body, "mesh") else body.at() for body in bodies]
    joints: list = [mbd.Spherical(a, b) for a, b in zip(ends, starts, strict=False)]
    if closed:
        joints += [mbd.Fixed(ends[-2], starts[-1], name="weld")]
    return mbd.System(bodies, joints, gravity=GRAVITY)


def batch(system: mbd.System, tangents: bool = False) -> Dynamics:
    name = "b1.laminate.angles"
    x = system.get_parameter(name).detach()
    designs = {name: x + torch.linspace(0.0, 0.3, LANES, dtype=x.dtype)[:, None]}
    return system.dynamics(designs, tangents=[name] if tangents else ())


def dense(dynamics: Dynamics) -> Dynamics:
    saddle = type(dynamics.saddle)(dynamics.topology)
    saddle.columns = None
    return Dynamics(dynamics.topology, saddle, dynamics.data, dynamics.initial, dynamics.stabilization)


def start(dynamics: Dynamics) -> tuple:
    x, _ = initial(dynamics)
    return x.vd, x.lam


@pytest.mark.thorough
@pytest.mark.parametrize("closed", [False, True], ids=["chain", "redundant"])
def test_values_tangents_and_cotangents_are_those_of_dense_matrices(closed):
    system = chain(14, closed)
    T = system.topology
    assert T.n_v + T.rows >= LARGE
    sparse = batch(system, tangents=True)
    assert sparse.saddle.columns is not None
    assert bool(sparse.redundant) == closed
    for x, y in zip(start(sparse), start(dense(sparse)), strict=True):
        assert_close(x.full, y.full, rtol=1e-8, atol=1e-10 * float(y.full.abs().max()))
    result = []
    for dynamics in (batch(system), dense(batch(system))):
        leaves = [x.requires_grad_() for x in dynamics.data.values()]
        a, lam = start(dynamics)
        pulled = [torch.cos(torch.arange(x.numel(), dtype=x.dtype)).reshape(x.shape) for x in (a, lam)]
        rows = torch.vmap(
            lambda w, a=a, lam=lam, leaves=leaves, pulled=pulled: torch.autograd.grad(
                (a, lam), leaves, (w[0] * pulled[0], w[1] * pulled[1]), retain_graph=True, allow_unused=True
            )
        )(torch.eye(2, dtype=torch.float64))
        result.append(dict(zip(dynamics.data, rows, strict=True)))
    used = {name for name, x in result[1].items() if x is not None}
    assert used
    assert {name for name, x in result[0].items() if x is not None} == used
    for name in used:
        x = result[1][name]
        assert_close(result[0][name], x, rtol=1e-7, atol=1e-9 * float(x.abs().max()))


@pytest.mark.thorough
def test_derivatives_by_states_in_both_modes():
    """Under torch.func, also where states are a batch: matrices then are one as well."""
    system = chain(14)
    f = batch(system).select_lanes([0])
    g = dense(f)
    assert f.rank.rank == g.rank.rank  # found outside of all transforms
    z = f.initial_state()
    some = [7, 40, 100]

    def rates(dynamics: Dynamics, part: Tensor) -> Tensor:
        full = z.index_add(1, torch.tensor(some), part[None])
        return dynamics(0.0, full)[0]

    zero = z.new_zeros(3)
    expected = torch.func.jacrev(lambda x: rates(g, x))(zero)
    for mode in (torch.func.jacfwd, torch.func.jacrev):
        result = mode(lambda x: rates(f, x))(zero)
        assert_close(result, expected, rtol=1e-8, atol=1e-9 * float(expected.abs().max()))
    several = torch.linspace(0.0, 1e-3, 6, dtype=torch.float64).reshape(2, 3)
    both = [torch.vmap(lambda x, h=h: rates(h, x))(several) for h in (f, g)]
    assert_close(*both, rtol=1e-8, atol=1e-10 * float(both[1].abs().max()))
    for h in (f, g):
        x = zero.clone().requires_grad_()
        (slope,) = torch.autograd.grad(rates(h, x).square().sum(), x, create_graph=True)
        with pytest.raises(NotImplementedError, match="second derivatives of accelerations"):
            slope.sum().backward()


def test_a_lane_without_factors_is_nan_alone():
    generator = torch.Generator().manual_seed(0)
    A = torch.randn(4, 5, 5, generator=generator, dtype=torch.float64)
    K = A + A.mT
    K[1], K[2] = 0.0, torch.nan
    row, column = (x.flatten().numpy() for x in torch.meshgrid(*[torch.arange(5)] * 2, indexing="ij"))
    columns = ColumnPattern.of(row, column, row * 5 + column, 5, 25)
    b = torch.randn(5, 2, 4, generator=generator, dtype=torch.float64)
    x = Factors(K.flatten(1)[:, columns.entry], None, columns).solve(b)
    assert x.isnan().flatten(0, 1).all(0).tolist() == [False, True, True, False]
    for lane in (0, 3):
        assert_close(K[lane] @ x[..., lane], b[..., lane])


def test_other_errors_of_superlu_are_raised(monkeypatch):
    def splu(K):
        raise RuntimeError("out of memory")

    monkeypatch.setattr("scipy.sparse.linalg.splu", splu)
    index = torch.arange(3).numpy()
    columns = ColumnPattern.of(index, index, index, 3, 3)
    with pytest.raises(RuntimeError, match="out of memory"):
        Factors(torch.ones(1, 3, dtype=torch.float64), None, columns).solve(torch.ones(3, 1, 1, dtype=torch.float64))
