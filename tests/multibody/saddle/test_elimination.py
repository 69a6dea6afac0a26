"""Block elimination against the dense inverse, on iteration matrices of mechanisms."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import GRAVITY, box, pendulum, plate, random_state, rigid_pendulum
from torchmbd.multibody.equations import equations
from torchmbd.multibody.saddle.blocks import Slopes
from torchmbd.multibody.saddle.elimination import Elimination, factored, pays


def chain(links: int) -> mbd.System:
    """Flexible and rigid links in turns, with different numbers of modes."""
    bodies = [box(f"b{i}") if i % 3 == 0 else plate(f"b{i}", modes=2 + i % 2) for i in range(links)]
    ends = [mbd.Ground().at(), *(body.at("right") if hasattr(body, "mesh") else body.at(0.3) for body in bodies)]
    starts = [body.at("left") if hasattr(body, "mesh") else body.at() for body in bodies]
    joints = [mbd.Spherical(a, b) for a, b in zip(ends, starts, strict=False)]
    return mbd.System(bodies, joints, gravity=GRAVITY)


def matrix(system: mbd.System) -> torch.Tensor:
    T, data = system.topology, system("data")
    q, v, a = random_state(system, 4)
    at = equations.placement(T, data, q, T.prescribed(q.new_tensor(0.2)))
    lam = torch.linspace(-1.0, 1.0, T.rows, dtype=torch.float64)[:, None, None]
    return system._saddle.matrix(data, at, Slopes(1e-6, 1e-4, v, a, lam)).detach()


def formed(system: mbd.System, A: torch.Tensor) -> torch.Tensor:
    return Elimination(system.topology)(A) @ torch.eye(A.shape[1], dtype=A.dtype).expand_as(A)


@pytest.mark.thorough
@pytest.mark.parametrize("make", [pendulum, rigid_pendulum, lambda: chain(7)], ids=["pendulum", "rigid", "chain"])
def test_the_inverse(make):
    system = make()
    A = torch.cat([matrix(system)] * 2)
    A[1] += 0.05 * torch.eye(len(A[0]), dtype=torch.float64) * A[1].diagonal()
    result, expected = formed(system, A), torch.linalg.inv(A)
    assert_close(result, expected, rtol=0, atol=1e-10 * float(expected.abs().max()))


def test_a_lane_with_a_singular_block_goes_the_dense_way():
    """A massless body that its joints hold: its block is singular, the whole matrix is not."""
    system = pendulum()
    A = torch.cat([matrix(system)] * 3)
    rows = Elimination(system.topology).groups[0][0]
    A[1, rows[:, None], rows[None]] = 0.0
    A[1, rows[0], rows[0]] = 1e-3  # the block stays singular
    A[2] = 0.0
    result = formed(system, A)
    dense = factored(A[1:2]) @ torch.eye(A.shape[1], dtype=A.dtype)[None]
    assert_close(result[1], dense[0], rtol=1e-9, atol=1e-9, equal_nan=True)
    assert bool(result[2].isnan().all())
    assert bool(result[0].isfinite().all())


@pytest.mark.thorough
def test_many_bodies_take_it_and_move_the_same(monkeypatch):
    from torchmbd.integrate import stepper

    system = chain(12)
    assert pays(system.topology)
    assert not pays(pendulum().topology)
    eliminated = mbd.simulate(system, 0.0004, steps=8)
    monkeypatch.setattr(stepper, "pays", lambda T: False)
    dense = mbd.simulate(system, 0.0004, steps=8)
    eliminated.require_ok()
    assert_close(eliminated.q, dense.q, rtol=1e-10, atol=1e-12)
