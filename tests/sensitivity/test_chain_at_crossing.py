"""The whole chain where two retained frequencies are equal: angles -> K -> modes -> motion -> integral of energy.

A rod held at its center has modes that are even and odd under a half turn about its normal. Their frequencies cross
along a ply angle; a bisection finds the angle. There a differentiated eigensolver divides by zero; here nothing happens.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

import torchmbd as mbd
from torchmbd.examples.slider_crank import build

pytestmark = pytest.mark.usefixtures("compiled")

ANGLES = "rod.laminate.angles"
DURATION, STEPS, MODES = 0.004, 40, 6
TIGHT = {"steps": STEPS, "iterations": (4, 4), "refresh": 1}
ENERGY = mbd.StrainEnergy("rod")
# other angles [deg], bracket of the first one, the pair of modes (from zero), options of the rod
DESIGNS = {
    "two layers, modes 1 and 2": ((22.0,), (-41.0, -37.0), 0, {}),
    "one layer, modes 4 and 5": ((), (27.5, 30.5), 3, {}),
    "craig-bampton": ((), (26.5, 28.4), 4, {"modes": 2, "reduction": "craig-bampton", "interface": ("left", "right")}),
}


def frequencies_and_modes(system: mbd.System, angles: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Eigenvalues [m], modes [N, m] and the diagonal of the mass [N] of one design."""
    rod = system.body("rod")
    result = torch.func.functional_call(system, {ANGLES: angles}, ("rod",))
    mass = rod.matrices.lumped_mass(rod.laminate.mass_per_area, rod.laminate.rotary_inertia_per_area).detach()
    return result["Kr"].detach().diagonal(), result["psi"].detach().flatten(0, 1), mass


def crossing(system: mbd.System, others: tuple[float, ...], bracket: tuple[float, float], first: int) -> Tensor:
    """Angles [rad] at which eigenvalues first and first + 1 are equal: modes are followed by modal assurance."""

    def design(degrees: float) -> Tensor:
        return mbd.deg([degrees, *others])

    low, high = bracket
    at_low, modes, mass = frequencies_and_modes(system, design(low))
    sign = torch.sign(at_low[first + 1] - at_low[first])
    for _ in range(40):
        middle = (low + high) / 2
        values, result, _ = frequencies_and_modes(system, design(middle))
        overlap = modes[:, first : first + 2].mT @ (mass[:, None] * result[:, first : first + 2])
        crossed = overlap.square().flip(1).trace() > overlap.square().trace()
        difference = values[first : first + 2].diff() * (-1 if crossed else 1)
        low, high = (middle, high) if sign * difference > 0 else (low, middle)
    return design((low + high) / 2)


def gradient_by_differences(
    system: mbd.System, angles: Tensor, measure: mbd.Integral | mbd.Max, h: float
) -> np.ndarray:
    """Central differences of fourth order of the same discrete map, all neighbors in one batch."""
    n = len(angles)
    eye = torch.eye(n, dtype=torch.float64)
    designs = torch.cat([angles + k * h * eye for k in (-2, -1, 1, 2)])
    values = measure.value(mbd.simulate(system, DURATION, designs={ANGLES: designs}, **TIGHT).require_ok())
    f = values.numpy().reshape(4, n)
    return (f[0] - f[3] + 8 * (f[2] - f[1])) / (12 * h)


@pytest.mark.thorough
@pytest.mark.parametrize("name", DESIGNS)
def test_gradients_through_the_motion_where_two_retained_frequencies_are_equal(name):
    others, bracket, first, options = DESIGNS[name]
    system = build(
        1 + len(others), [0.0] * (1 + len(others)), (6, 2), **({"modes": MODES, "kind": "triangle"} | options)
    )
    angles = crossing(system, others, bracket, first)
    values, _, _ = frequencies_and_modes(system, angles)
    assert abs(float(values[first + 1] / values[first]) - 1) < 1e-10, "no crossing"
    slopes = torch.func.jvp(
        lambda a: torch.linalg.eigvalsh(torch.func.functional_call(system, {ANGLES: a}, ("rod",))["Kr"]),
        (angles + 1e-3,),
        (torch.ones_like(angles),),
    )[1]
    assert abs(float(slopes[first + 1] - slopes[first])) > 1e-2 * float(values[first]), "touching, not crossing"
    motion = mbd.simulate(
        system, DURATION, gradients="forward", variables=[ANGLES], designs={ANGLES: angles[None]}, **TIGHT
    )
    for measure in (mbd.Integral(ENERGY), mbd.Max(ENERGY)):
        result = measure.value_and_gradient(motion.require_ok()).gradient[0].numpy()
        expected = gradient_by_differences(system, angles, measure, 1e-4)
        assert np.abs(result - expected).max() < 1e-6 * np.abs(expected).max()
