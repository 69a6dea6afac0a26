"""One system in several threads: the numbers of one."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from torch import Tensor

import torchmbd as mbd
from tests.mechanisms import pendulum

NAME = "rod.laminate.angles"


@pytest.mark.thorough
def test_three_threads_have_the_numbers_of_one():
    """Parameters are replaced in place while the structure stage runs; other threads wait."""
    system = pendulum()
    energy = mbd.Integral(mbd.StrainEnergy("rod"))

    def run(angle: float) -> tuple[Tensor, ...]:
        designs = {NAME: mbd.deg([[angle, -angle]])}
        motion = mbd.simulate(system, 0.01, steps=10, designs=designs, gradients="forward", variables=[NAME])
        result = energy.value_and_gradient(motion)
        own = system("data")["Kr"].detach()
        assert result.gradient is not None
        return motion.q, motion.body("rod").psi, result.value, result.gradient, own

    angles = [10.0, 25.0, 40.0] * 3
    alone = [run(angle) for angle in angles[:3]] * 3
    with ThreadPoolExecutor(3) as threads:
        together = list(threads.map(run, angles))
    for one, other in zip(alone, together, strict=True):
        assert all(map(torch.equal, one, other))
