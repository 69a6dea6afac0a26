"""How far a panel of the antenna is from flat while the sun warms one of its faces: a measure for experiment files.

    w = -(kappa_x x^2 + kappa_xy x y + kappa_y y^2) / 2         of a panel that nothing hinders (fem/materials/expansion.py)
    rms^2 = (kappa_x^2 a^4 / 180 + kappa_xy^2 a^2 b^2 / 144 + kappa_y^2 b^4 / 180) / 4     from its best plane, over a x b

The difference of the temperatures of its faces is chosen, and so are the coefficients of expansion (sar_antenna_data.py).
configs/sar_antenna/flatness.yaml: the front of this measure and the strain energy of the deployment.
Checked in tests/experiments/test_sar_antenna.py: against a body of elements.
"""

from __future__ import annotations

import torch
from torch import Tensor

import torchmbd as mbd
from experiments.models.sar_antenna_data import LENGTH, PLY, WIDTH


def flatness(motion: mbd.Trajectory, body: str, kelvin: float) -> Tensor:
    """Root mean square deviation of a panel from its best plane [lanes] [m]; kelvin: its front face is warmer by this."""
    laminate, gradient = motion.system.body(body).laminate, kelvin / (4 * PLY)
    curvature = motion.of_designs(lambda: laminate.expansion(gradient=gradient).curvature)
    shares = torch.tensor([LENGTH**4 / 180, WIDTH**4 / 180, (LENGTH * WIDTH) ** 2 / 144], dtype=torch.float64)
    return (0.5 * (curvature**2 @ shares).sqrt()).expand(motion.lanes)
