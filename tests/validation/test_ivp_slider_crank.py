"""The elastic slider-crank of the test set for IVP solvers (experiments/peers/ivp_slider_crank.py): published numbers."""

from __future__ import annotations

import pytest
import torch

import torchmbd as mbd
from experiments.peers.ivp_slider_crank import PUBLISHED, build, ours, reference

#: by `reference(True)`, with quadratic stiffness
NONLINEAR = {
    "phi2": -0.331173887628,
    "x3": 0.169736973924,
    "q1": -1.1807672469e-4,
    "q2": 2.3651463929e-5,
    "q3": -5.4750258450e-6,
    "q4": -8.7025366757e-6,
    "lambda1": -87.397340183,
    "lambda2": -163.552900086,
    "lambda3": 29.319751672,
}
#: at 10,000 steps; the undamped axial vibrations of 2 kHz and more are last to converge
NEAR = {"phi2": 1e-6, "x3": 1e-6, "q1": 5e-3, "q2": 1e-3, "q3": 5e-3, "q4": 5e-3}


@pytest.mark.slow
@pytest.mark.parametrize(("nonlinear", "wanted"), [(False, PUBLISHED), (True, NONLINEAR)])
def test_motion_at_the_end(nonlinear: bool, wanted: dict[str, float], native: None):
    result = ours(nonlinear, 10_000)
    for name, value in wanted.items():
        assert result[name] == pytest.approx(value, rel=NEAR.get(name, 5e-3)), name


@pytest.mark.thorough
@pytest.mark.parametrize("nonlinear", [False, True])
def test_motion_is_that_of_the_equations_of_the_source(nonlinear: bool, native: None):
    """After a third of a turn."""
    expected, result = reference(nonlinear, 1e-8, 0.014), ours(nonlinear, 700, 0.014)
    for name, value in expected.items():
        assert result[name] == pytest.approx(value, rel=NEAR.get(name, 5e-3)), name


@pytest.mark.thorough
def test_the_equations_of_the_source_have_the_published_numbers():
    result = reference(accuracy=1e-7)
    for name, value in PUBLISHED.items():
        assert result[name] == pytest.approx(value, rel=1e-4), name


@pytest.mark.thorough
def test_energy_is_that_which_the_drive_gives(native: None):
    motion = mbd.simulate(build(True), 0.01, steps=1000, gradients="none", backend="native").require_ok()
    energies = motion.energies
    assert float(energies.balance.abs().max()) < 5e-4 * float(energies.strain.max())
    assert float((energies.strain - motion.body("rod").strain_energy).abs().max()) < 1e-9


@pytest.mark.thorough
@pytest.mark.parametrize("backend", ["eager", "native"])
def test_gradients_pass_the_quadratic_stiffness(backend: str, native: None):
    def loss(w: torch.Tensor) -> torch.Tensor:
        designs = {"rod.modal": w}
        motion = mbd.simulate(system, 2e-3, steps=40, backend=backend, designs=designs).require_ok()
        return mbd.Integral(mbd.StrainEnergy("rod"))(motion).sum() + motion.body("rod").w[0, -1].square().sum()

    system = build(True)
    w = torch.tensor([2e-4, -1e-4, 1e-5, -1e-5], dtype=torch.float64, requires_grad=True)
    system.body("rod").bent(torch.nn.Parameter(w.detach()))
    (reverse,) = torch.autograd.grad(loss(w), w)
    forward = torch.func.jacfwd(loss)(w.detach())
    step = 1e-8 * torch.eye(4, dtype=torch.float64)
    with torch.no_grad():
        differences = torch.stack([(loss(w + d) - loss(w - d)) / 2e-8 for d in step])
    torch.testing.assert_close(reverse, forward, rtol=1e-8, atol=0.0)
    torch.testing.assert_close(reverse, differences, rtol=1e-5, atol=0.0)
