"""Screws of components-first numbers are those of rigid_motion.py; so are wrenches, their slopes and tangents."""

import pytest
import torch

from torchmbd.math import rigid_motion
from torchmbd.math.pair import Pair
from torchmbd.math.screw import rate_slopes, screw, screw_rate, wrench_slopes, wrenches

_MOTIONS = 7


@pytest.fixture(scope="module")
def motions():
    """u [n, 3], R [n, 3, 3] up to LARGEST, and f [n, 6]."""
    g = torch.Generator().manual_seed(0)
    u, phi, f = (torch.randn(_MOTIONS, k, generator=g, dtype=torch.float64) for k in (3, 3, 6))
    sizes = torch.tensor([0.0, 1e-9, 1e-4, 0.1, 1.0, 2.0, rigid_motion.LARGEST], dtype=torch.float64)
    phi = phi / phi.norm(dim=1, keepdim=True) * sizes[:, None]
    return u, rigid_motion.exponential(phi), f


def _first(x, rank):
    """[n, components...] -> [components..., 1, n]."""
    return x.movedim(0, -1).unsqueeze(rank)


def test_logarithm(motions):
    u, R, _ = motions
    result = screw(_first(u, 1), _first(R, 2))[:, 0].T
    torch.testing.assert_close(result, rigid_motion.logarithm(u, R), rtol=1e-13, atol=1e-14)


def test_wrenches_and_slopes(motions):
    u, R, f = motions
    l = rigid_motion.logarithm(u, R)
    given = _first(l, 1), _first(f, 1)
    for result, expected in zip(wrenches(*given), rigid_motion.end_wrenches(l, f), strict=True):
        torch.testing.assert_close(result[:, 0].T, expected, rtol=1e-12, atol=1e-12)
    result = torch.cat(wrench_slopes(*given))[:, :, 0].permute(2, 0, 1)
    torch.testing.assert_close(result, rigid_motion.wrench_slopes(l, f), rtol=1e-12, atol=1e-12)


def test_tangents(motions):
    u, R, _ = motions
    spin = torch.ones(_MOTIONS, 3, dtype=torch.float64)
    dR = R @ rigid_motion.hat(spin)
    result = screw(Pair.of(_first(u, 1), _first(spin, 1)), Pair.of(_first(R, 2), _first(dR, 2))).tangent[:, 0].T
    expected = torch.func.jvp(rigid_motion.logarithm, (u, R), (spin, dR))[1]
    torch.testing.assert_close(result, expected, rtol=1e-10, atol=1e-10)


def test_slopes_of_rates(motions):
    u, R, f = motions
    l, other = rigid_motion.logarithm(u, R), f.roll(1, 0)
    ends = _first(f, 1), _first(other, 1)
    unit = Pair.of(_first(l, 1), torch.eye(6, dtype=torch.float64)[..., None].expand(6, 6, _MOTIONS))
    expected = screw_rate(unit, *ends).tangent
    torch.testing.assert_close(rate_slopes(_first(l, 1), *ends)[:, :, 0], expected, rtol=1e-12, atol=1e-12)
