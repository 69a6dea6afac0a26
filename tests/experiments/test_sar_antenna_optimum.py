"""Laminates of the antenna as design variables: two angles, four and eight are the same antenna."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchmbd as mbd
from experiments.models.sar_antenna import build
from experiments.paper import antenna_optimum
from experiments.paper.antenna_geometry import figures
from experiments.paper.antenna_optimum import LAYERS, START, problem

pytestmark = pytest.mark.usefixtures("compiled")


@pytest.fixture(autouse=True)
def short(monkeypatch):
    monkeypatch.setattr(antenna_optimum, "DURATION", 0.5)


def coarse(*angles):
    p = problem(20, *angles, modes=2)
    p.simulation = p.simulation.with_arguments(iterations=(5, 2))
    return p


@pytest.mark.thorough
def test_gradient_of_two_angles_is_the_sum_over_their_layers():
    """By the chain rule: theta1 is the angle of the outer layers of both panels."""
    two, eight = coarse(START), coarse(LAYERS, LAYERS)
    assert (len(two.names), len(coarse(START, START).names), len(eight.names)) == (2, 4, 8)
    [a], [b] = (p.evaluate(p.start[None], gradients=True) for p in (two, eight))
    assert abs(a.objective / b.objective - 1.0) < 1e-9
    layers = b.objective_gradient.reshape(2, 4).sum(0)
    np.testing.assert_allclose(a.objective_gradient, [layers[0] + layers[3], layers[1] + layers[2]], rtol=1e-6)


@pytest.mark.thorough
def test_statics_of_the_joints_are_exact_with_craig_bampton():
    """Deflection of a corner of panel 2 under a force at another, of the reduced and of the whole mesh."""
    body = build(modes=2, reduction="craig-bampton").body("panel2")
    a, b = (body.mesh.node(f"corner_right_{k}") for k in ("bottom", "top"))
    with torch.no_grad():
        result = body.structure()
        K = body.assembly.stiffness().dense()
    force = torch.zeros(len(body.mesh.nodes) * 6, dtype=torch.float64)
    force[6 * a + 2] = 1.0
    exact = torch.zeros_like(force)
    exact[body.free] = torch.linalg.solve(K, force[body.free])
    psi = result["psi"][:, 2]
    reduced = torch.linalg.solve(result["Kr"], psi[a]) @ psi[b]
    rounding = 10 * torch.finfo(torch.float64).eps * float(torch.linalg.cond(result["Kr"]))
    assert rounding < 2e-7
    torch.testing.assert_close(reduced, exact[6 * b + 2], rtol=rounding, atol=0.0)


@pytest.mark.thorough
def test_a_line_tells_the_optimization():
    result = mbd.optimize(coarse(START), method="mmfd", max_iterations=1)
    text = antenna_optimum.line(result)
    assert text.startswith(f"{result.history[0].objective:.6f} -> ")
    assert "deg" in text


def test_spread_over_geometries(tmp_path):
    """Heavier trusses bend the panels more; the picture and a sentence."""
    cases = {"as it is": {"modes": 2}, "heavy": {"modes": 2, "radius": 7e-3}}
    result = figures(tmp_path, cases, steps=20, duration=0.4)
    assert result["heavy/initial"] != result["as it is/initial"]
    for name in cases:
        share = result[f"{name}/optimum"] / result[f"{name}/initial"]
        assert result[f"{name}/reduction_percent"] == pytest.approx(100.0 * (1.0 - share))
    assert "reductions of 2 geometries" in result["sentence"]
    assert (tmp_path / "geometry.png").stat().st_size > 1000
