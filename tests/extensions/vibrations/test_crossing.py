"""Two vibrations of a rotor that cross as its bearings pass through symmetry: derivatives against those of the determinant.

    p(L, k) = D_y D_z - L (P speed)^2 (a_0 - L m) (b_0 - L m),  D_y = (a_0 - L m) (a_2 - L J) - a_1^2,  L = w^2

a_n, b_n: sums of k x^n of the bearings in y and z; P, J: polar and transverse inertia.
A single root has dL/dk = -p_k / p_L; two that coincide and have two shapes have the sum -2 p_Lk / p_LL.
"""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

import torchmbd as mbd
from tests.refused import refused

V, GROUND = mbd.variable, mbd.Ground()
MASS, J, POLAR = 2.0, 0.3, 0.4
PLACES, STIFFNESS, AXIAL = (-0.6, 0.8), (40.0, 30.0), 90.0  # at symmetry the bearings' moments cancel
ACCURACY = 1e-9


def rotor() -> mbd.System:
    """A rigid disk along x in two bearings, a variable of which is the y stiffness of the first."""
    disk, bearings = mbd.RigidBody("disk", MASS, (POLAR, J, J)), []
    for i, (x, k) in enumerate(zip(PLACES, STIFFNESS, strict=True)):
        y: Any = k if i else V(k)
        ends = GROUND.at(x, 0, 0), disk.at(x, 0, 0)
        bearings.append(mbd.Bushing(*ends, (AXIAL, y, k), name=f"bearing{i}"))
    return mbd.System([disk], forces=bearings)


def determinant(L: Tensor, k: Tensor, speed: float) -> Tensor:
    a, b = ([first * PLACES[0] ** n + STIFFNESS[1] * PLACES[1] ** n for n in range(3)] for first in (k, STIFFNESS[0]))
    D = [(c[0] - L * MASS) * (c[2] - L * J) - c[1] ** 2 for c in (a, b)]
    return D[0] * D[1] - L * (POLAR * speed) ** 2 * (a[0] - L * MASS) * (b[0] - L * MASS)


def slope(w: float, k: float, speed: float, roots: int) -> float:
    """Derivative of an angular frequency by k, or the sum of those of two that coincide."""
    L, b = (torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in (w * w, k))
    by = torch.autograd.grad(determinant(L, b, speed), [L, b], create_graph=True)
    if roots == 2:
        twice, mixed = torch.autograd.grad(by[0], [L, b])
        by = twice, 2.0 * mixed
    return -by[1].item() / by[0].item() / (2.0 * w)


def frequencies(k: Tensor, speed: float) -> Tensor:
    """Angular frequencies [4] of vibrations across x, rising."""
    spin: dict[str, Any] = {"spin": (speed, 0.0, 0.0), "observer": "ground"} if speed else {}
    w = 2.0 * math.pi * mbd.equilibrium(rotor(), designs={"bearing0.stiffness_y": k}, **spin).frequencies[0]
    return w[(w > 0.0) & ((w - math.sqrt(2.0 * AXIAL / MASS)).abs() > 1e-6)]


@pytest.mark.thorough
@pytest.mark.parametrize("offset", [-1e-2, -1e-4, 1e-4, 1e-2])
@pytest.mark.parametrize("speed", [0.0, 0.8])
def test_beside_symmetry(offset, speed):
    """Of each, and so of their sum and of their span."""
    k = torch.tensor([STIFFNESS[0] * (1.0 + offset)], dtype=torch.float64, requires_grad=True)
    w = frequencies(k, speed)
    assert len(w) == 4
    expected = [slope(x, k.item(), speed, 1) for x in w.tolist()]
    largest = max(map(abs, expected))
    for i in range(4):
        (by,) = torch.autograd.grad(w[i], k, retain_graph=True)
        assert by.item() == pytest.approx(expected[i], rel=0.0, abs=ACCURACY * largest)
    (span,) = torch.autograd.grad((w[1] - w[0]).square(), k, retain_graph=True)
    assert span.item() == pytest.approx(2.0 * (w[1] - w[0]).item() * (expected[1] - expected[0]), rel=0.0, abs=ACCURACY)


@pytest.mark.thorough
@pytest.mark.parametrize("speed", [0.0, 0.8])
def test_at_symmetry(speed):
    """The translations coincide at any speed: functions that are symmetric in both are exact, single ones are refused.

    Forward mode of single ones is refused too, as it does not know what is made of them; measures of clusters have it.
    """
    k = torch.tensor([STIFFNESS[0]], dtype=torch.float64, requires_grad=True)
    w = frequencies(k, speed)
    assert w[:2].tolist() == pytest.approx([math.sqrt(35.0)] * 2, rel=1e-12)
    expected = slope(math.sqrt(35.0), STIFFNESS[0], speed, 2)
    pair = w[:2]
    for f, inner in ((pair.sum(), 1.0), (pair.log().sum(), 35.0**-0.5), (pair.pow(-2).sum(), -2.0 * 35.0**-1.5)):
        (by,) = torch.autograd.grad(f, k, retain_graph=True)
        assert by.item() == pytest.approx(inner * expected, rel=ACCURACY)
    (span,) = torch.autograd.grad((w[1] - w[0]).square(), k, retain_graph=True)
    assert abs(span.item()) < ACCURACY
    for f in (w[0], w[1], w[1] - w[0]):
        with refused("number", [2, 3], kind=mbd.DesignFailure):
            torch.autograd.grad(f, k, retain_graph=True)
    cluster = mbd.vibrations.SystemFrequency(cluster=(2, 3), speed=speed, axis="x", observer="ground")
    system = rotor()

    def mean(k: Tensor) -> Tensor:
        return cluster(mbd.simulate(system, 1e-4, steps=2, designs={"bearing0.stiffness_y": k}))[0]

    assert mean(k).item() == pytest.approx(math.sqrt(35.0) / (2.0 * math.pi), rel=1e-12)
    for by in (torch.autograd.grad(mean(k), k)[0], torch.func.jacfwd(mean)(k.detach())):
        assert by.item() == pytest.approx(0.5 * expected / (2.0 * math.pi), rel=ACCURACY)
    cut = mbd.vibrations.SystemFrequency(cluster=(3, 4), speed=speed, axis="x", observer="ground")

    def half(k: Tensor) -> Tensor:
        return cut(mbd.simulate(system, 1e-4, steps=2, designs={"bearing0.stiffness_y": k}))[0]

    for gradient in (lambda: torch.autograd.grad(half(k), k), lambda: torch.func.jacfwd(half)(k.detach())):
        with refused("number", [2, 3], "eigenvalues 2, 3", kind=mbd.DesignFailure):
            gradient()
