"""Thermal and moisture expansion against closed forms, in general position, with gradients of two independent routes."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch.func import functional_call
from torch.testing import assert_close

import torchmbd as mbd
from tests.refused import refused

E1, E2, G, NU, A1, A2 = 128e9, 10.1e9, 5.36e9, 0.23, -0.3e-6, 28e-6
CARBON = mbd.Ply(E1, E2, G, G, 3.6e9, NU, 1586.0, alpha1=A1, alpha2=A2, beta1=0.0, beta2=0.4)
STEEL = mbd.Ply.isotropic(210e9, 0.0, 7850.0, alpha=12e-6)
BRASS = mbd.Ply.isotropic(100e9, 0.0, 8500.0, alpha=19e-6)


def test_bimetal_of_timoshenko():
    """Curvature of a strip of two metals; without Poisson's ratio the plate is a beam (Timoshenko 1925, eq. 4)."""
    lower, upper, change = 0.8e-3, 1.3e-3, 75.0
    result = mbd.Laminate([BRASS, STEEL], [0.0, 0.0], [lower, upper]).expansion(change)
    h, m, n = lower + upper, lower / upper, 100.0 / 210.0
    curvature = 6 * (12e-6 - 19e-6) * change * (1 + m) ** 2
    curvature /= h * (3 * (1 + m) ** 2 + (1 + m * n) * (m**2 + 1 / (m * n)))
    assert_close(
        result.curvature, torch.tensor([curvature, curvature, 0.0], dtype=torch.float64), rtol=1e-12, atol=1e-14
    )


def test_an_unsymmetric_strip_is_a_saddle():
    """[0/90]: the closed form of two plies of thickness t, kappa_x = -kappa_y (Hyer 1981, linear theory)."""
    t, change = 0.125e-3, -120.0
    d = 1 - NU**2 * E2 / E1
    Q11, Q22, Q12 = E1 / d, E2 / d, NU * E2 / d
    S = Q11 + Q22
    N = (Q11 * A1 + Q12 * A2 + Q12 * A1 + Q22 * A2) * t * change  # equal along x and y
    M = ((Q12 * A1 + Q22 * A2) - (Q11 * A1 + Q12 * A2)) * t**2 / 2 * change  # of x, and its opposite of y
    A, C, B, D, F = S * t, 2 * Q12 * t, (Q22 - Q11) * t**2 / 2, S * t**3 / 3, 2 * Q12 * t**3 / 3
    curvature = (M - B * N / (A + C)) / (D - F - B**2 / (A + C))
    result = mbd.Laminate(CARBON, mbd.deg([0, 90]), t).expansion(change)
    assert_close(
        result.curvature, torch.tensor([curvature, -curvature, 0.0], dtype=torch.float64), rtol=1e-6, atol=1e-12
    )
    assert abs(curvature) > 5.0


@pytest.mark.parametrize("turn", [0.0, 0.3])
def test_a_quasi_isotropic_laminate_expands_alike_along_all_directions(turn):
    """alpha = (U1 + U4)-form of Jones: (Q11 a1 + Q12 (a1 + a2) + Q22 a2) / (Q11 + Q22 + 2 Q12), without curvature."""
    d = 1 - NU**2 * E2 / E1
    Q11, Q22, Q12 = E1 / d, E2 / d, NU * E2 / d
    alpha = (Q11 * A1 + Q12 * (A1 + A2) + Q22 * A2) / (Q11 + Q22 + 2 * Q12)
    result = mbd.Laminate(CARBON, mbd.deg([0, 60, -60]) + turn, 0.2e-3, symmetric=True).expansion(10.0)
    assert_close(result.strain, 10 * alpha * torch.tensor([1.0, 1, 0], dtype=torch.float64), rtol=1e-6, atol=1e-15)
    assert_close(result.curvature, torch.zeros(3, dtype=torch.float64), rtol=0, atol=1e-12)


def test_residual_stresses_of_a_cross_ply():
    """[0/90]s: the closed form of equal strains e along x and y, whose forces cancel; plies fail across the fibers first."""
    change = -150.0
    d = 1 - NU**2 * E2 / E1
    Q11, Q22, Q12 = E1 / d, E2 / d, NU * E2 / d
    e = change * (Q11 * A1 + Q12 * (A1 + A2) + Q22 * A2) / (Q11 + Q22 + 2 * Q12)
    along = Q11 * (e - A1 * change) + Q12 * (e - A2 * change)
    across = Q12 * (e - A1 * change) + Q22 * (e - A2 * change)
    stress = mbd.Laminate(CARBON, mbd.deg([0, 90]), 0.25e-3, symmetric=True).expansion(change).stress
    expected = torch.tensor([along, across, 0.0], dtype=torch.float64).expand(4, 2, 3)
    assert_close(stress, expected, rtol=1e-6, atol=1e-3)
    assert across > 0.0 > along
    assert along == pytest.approx(-across, rel=1e-9)


def test_a_gradient_bends_a_homogeneous_plate_freely():
    """kappa = alpha T1, without stresses, also where the surface of the nodes is not in the middle."""
    plate = mbd.Laminate(CARBON, [0.4], 2e-3, offset=0.7e-3)
    result = plate.expansion(temperature=5.0, gradient=3e3)
    c, s = torch.cos(torch.tensor(0.4, dtype=torch.float64)), torch.sin(torch.tensor(0.4, dtype=torch.float64))
    alpha = torch.stack([A1 * c**2 + A2 * s**2, A1 * s**2 + A2 * c**2, 2 * (A1 - A2) * c * s])
    assert_close(result.strain, 5.0 * alpha, rtol=1e-9, atol=0)
    assert_close(result.curvature, 3e3 * alpha, rtol=1e-9, atol=0)
    assert float(result.stress.detach().abs().max()) < 1e-2


def test_stresses_of_a_free_laminate_carry_no_force():
    """An unbalanced stack of two materials: the integrals of its stresses, of plies made by hand, are zero."""
    angles = mbd.deg([20, -50, 75, 10])
    steel = mbd.Ply.isotropic(210e9, 0.3, 7850.0, alpha=12e-6, beta=0.0)
    stack = mbd.Laminate([CARBON, CARBON, steel, CARBON], angles, [1e-3, 2e-3, 0.5e-3, 1.5e-3])
    result = stack.expansion(temperature=-80.0, gradient=2e3, moisture=0.01)
    c, s = torch.cos(angles), torch.sin(angles)
    bottom, top = result.stress.unbind(-2)
    held, t = 0.0, stack.thickness
    for stress in (bottom, top):
        s1, s2, s12 = stress.unbind(-1)
        x = torch.stack([c * c * s1 + s * s * s2 - 2 * c * s * s12, s * s * s1 + c * c * s2 + 2 * c * s * s12], -1)
        xy = c * s * (s1 - s2) + (c * c - s * s) * s12
        at = torch.cat([x, xy[:, None]], -1)
        assert float(at.detach().abs().max()) > 1e6
        held = held + (at * t[:, None]).sum(0) / 2
    assert_close(held, torch.zeros(3, dtype=torch.float64), rtol=0, atol=1e-6)


@pytest.mark.thorough
def test_gradients_are_those_of_differences():
    """Forward, reverse and central differences by angles, thicknesses and the coefficient of a ply agree."""
    ply = mbd.Ply(E1, E2, G, G, 3.6e9, NU, 1586.0, alpha1=A1, alpha2=mbd.variable(A2))
    stack = mbd.Laminate(ply, mbd.deg([20, -50, 75]), [1e-3, 2e-3, 1.5e-3])
    names = ("angles", "thickness", "ply.alpha2")
    start = tuple(stack.get_parameter(name).detach().clone() for name in names)

    class Numbers(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.stack = stack

        def forward(self) -> torch.Tensor:
            result = self.stack.expansion(-100.0, 2e3)
            return torch.cat([result.curvature, 1e3 * result.strain, 1e-9 * result.stress.flatten()])

    model = Numbers()

    def numbers(*values: torch.Tensor) -> Any:
        return functional_call(model, {f"stack.{name}": x for name, x in zip(names, values, strict=True)}, ())

    places = tuple(range(len(names)))
    forward: Any = torch.func.jacfwd(numbers, argnums=places)(*start)
    reverse: Any = torch.func.jacrev(numbers, argnums=places)(*start)
    for k, x in enumerate(start):
        assert_close(forward[k], reverse[k], rtol=1e-9, atol=1e-12 * float(forward[k].abs().max()))
        step = 1e-5 * float(x.detach().abs().max())
        for j in range(x.numel()):
            shift = torch.zeros_like(x).flatten().index_fill(0, torch.tensor([j]), step).reshape(x.shape)
            ends = [numbers(*(y + sign * shift if i == k else y for i, y in enumerate(start))) for sign in (1.0, -1.0)]
            slope = forward[k].reshape(forward[k].shape[0], -1)[:, j]
            assert_close((ends[0] - ends[1]) / (2 * step), slope, rtol=1e-6, atol=1e-7 * float(forward[k].abs().max()))


def test_lanes_of_designs_and_of_temperatures():
    """Rows of angles and of temperatures are those of single laminates."""
    angles, change = (
        mbd.deg(torch.tensor([[0.0, 90.0], [30.0, -20.0]])),
        torch.tensor([-100.0, 40.0], dtype=torch.float64),
    )
    stack = mbd.Laminate(CARBON, angles[0], 1e-3)
    vars(many := mbd.Laminate.stacked([stack, stack]))["angles"] = angles
    result = many.expansion(change)
    for k in range(2):
        single = mbd.Laminate(CARBON, angles[k], 1e-3).expansion(float(change[k]))
        for whole, part in zip(result, single, strict=True):
            assert_close(whole[k], part, rtol=1e-12, atol=1e-12)


def test_bad_input_is_refused():
    """Plies without coefficients are named where a change acts on them, and only there."""
    plain = mbd.Ply(E1, E2, G, G, 3.6e9, NU, 1586.0, alpha1=A1)
    stack = mbd.Laminate([CARBON, plain], [0.0, 0.0], 1e-3)
    for arguments, path in (
        (
            {"temperature": 1.0},
            "alpha2",
        ),
        ({"gradient": 1.0}, "alpha2"),
        ({"moisture": 1.0}, "beta1"),
        ({"temperature": float("nan")}, "temperature"),
        ({"moisture": "wet"}, "moisture"),
    ):
        changes: dict[str, Any] = arguments
        with refused(path):
            stack.expansion(**changes)
    assert not any(bool(x.any()) for x in stack.expansion())
    for name in ("alpha1", "beta2"):
        coefficients: dict[str, Any] = {name: float("inf")}
        with refused(name):
            mbd.Ply(E1, E2, G, G, G, NU, 1586.0, **coefficients)
    with refused("alpha", float("nan")):
        mbd.Ply.isotropic(mbd.variable(70e9), 0.3, 2700.0, alpha=float("nan"))
