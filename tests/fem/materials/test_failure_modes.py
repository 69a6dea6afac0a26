"""Modes of failure: a hand calculation, their names, and that Puck's curve closes."""

from __future__ import annotations

import math

import pytest
import torch

from torchmbd.fem.materials import MODES, Strength

STRENGTH = Strength(Xt=1500e6, Xc=1200e6, Yt=50e6, Yc=250e6, S12=70e6, S13=70e6, S23=120e6).numbers()


def tensor(*x):
    return torch.tensor(x, dtype=torch.float64)


@pytest.mark.parametrize(
    ("criterion", "stress", "mode"),
    [
        ("hashin", (1400e6, 0, 0, 0, 0), "fiber tension"),
        ("hashin", (-1100e6, 10e6, 0, 0, 0), "fiber compression"),
        ("hashin", (100e6, 40e6, 20e6, 0, 0), "matrix tension"),
        ("hashin", (-100e6, -200e6, 20e6, 0, 0), "matrix compression"),
        ("puck", (-1100e6, 10e6, 0, 0, 0), "fiber compression"),
        ("puck", (100e6, 40e6, 20e6, 0, 0), "matrix A"),
        ("puck", (100e6, -40e6, 60e6, 0, 0), "matrix B"),
        ("puck", (100e6, -200e6, 20e6, 0, 0), "matrix C"),
        ("puck", (0, 0, 0, 60e6, 0), "transverse shear"),
        ("max_stress", (0, 0, -60e6, 0, 0), "shear 12"),
        ("interlaminar", (100e6, 0, 0, 60e6, 0), "shear between layers"),
    ],
)
def test_names(criterion, stress, mode):
    modes = MODES[criterion]
    assert modes.names[int(modes.indices(tensor(*stress), STRENGTH).argmax())] == mode


def test_hashin_by_hand():
    """s = (-300, -100, 30, 20, 10) MPa: (300/1200)^2; (100/240)^2 - ((250/240)^2 - 1) 100/250 + (3/7)^2
    + (2/7)^2 + (1/12)^2.
    """
    result = MODES["hashin"].indices(1e6 * tensor(-300.0, -100.0, 30.0, 20.0, 10.0), STRENGTH).tolist()
    matrix = (1 / 2.4) ** 2 - ((2.5 / 2.4) ** 2 - 1) * 0.4 + (3 / 7) ** 2 + (2 / 7) ** 2 + (1 / 12) ** 2
    assert result == pytest.approx([0.0, 0.0625, 0.0, matrix])


def test_hashin_without_transverse_shear_strength():
    """Infinite S23: matrix compression is -s2 / Yc."""
    strength = Strength(Xt=1500e6, Xc=1200e6, Yt=50e6, Yc=250e6, S12=70e6).numbers()
    assert MODES["hashin"](tensor(0.0, -100e6, 0.0, 0.0, 0.0), strength).item() == pytest.approx(0.4)


def test_puck_curve_is_continuous():
    """Where modes meet, in s2 = 0 and where the plane of fracture turns, their stress of failure is one."""
    direction = torch.linspace(0.0, math.pi, 20001, dtype=torch.float64)
    zero = torch.zeros_like(direction)
    stress = 1e8 * torch.stack([zero, direction.cos(), direction.sin(), zero, zero], -1)
    index = MODES["puck"](stress, STRENGTH)
    assert index.diff().abs().max() < 1e-3 * index.max()
    q, S, Yc = 0.30, 70e6, 250e6
    R = S / (2 * q) * (math.sqrt(1 + 2 * q * Yc / S) - 1)
    T = S * math.sqrt(1 + 2 * q * R / S)
    for side in (0.999999, 1.000001):
        assert MODES["puck"](tensor(0.0, -side * R, T, 0.0, 0.0), STRENGTH).item() == pytest.approx(1.0, rel=1e-5)


def test_puck_grows_with_the_load():
    stress = 1e6 * tensor(100.0, -40.0, 60.0, 5.0, 3.0)
    assert MODES["puck"](2.5 * stress, STRENGTH).item() == pytest.approx(2.5 * MODES["puck"](stress, STRENGTH).item())
