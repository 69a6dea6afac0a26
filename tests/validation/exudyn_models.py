"""The IFToMM mechanisms as Exudyn has them, next to what its tests print: `python -m tests.validation.exudyn_models`.

    four-bar   fourBarMechanismIftomm.py: the tip of the first bar after 10 s in steps of 1 ms, its center after 4 s in steps
               of 10 ms, and the largest errors of the energy (generalized-alpha, spectral radius 0.95)
    Bricard    bricardMechanism.py: bars of 0.1 m x 0.1 m; the norm of all displacements after 1 s, of the first point of each
               bar and of its Euler parameters. The file prints this number plus two: the freedom of the mechanism, and its
               one redundant equation.

Source: github.com/jgerstmayr/EXUDYN at e44aca1, main/pythonDev/TestModels. Checked in test_exudyn_models.py.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

import torchmbd as mbd
from tests.validation.rigid_benchmarks import bricard, n_four_bar, n_four_bar_at
from tests.validation.test_rigid_benchmarks import energy

TIP = (0.3284112372, 0.9445348375)  # [m] after 10 s, 10000 steps
ENERGY = 0.001143193966  # [J]
CENTER = (0.05815092990659491, 0.49660695660597587)  # [m] after 4 s, 400 steps
COARSE_ENERGY = 0.1721665271840173 - CENTER[0]  # [J] the largest error in these 4 s
BRICARD = 4.172189649307425 - 2.0


def four_bar(duration: float, steps: int) -> tuple[Tensor, float]:
    """Tip of the first bar at the end [3], and the largest error of the energy."""
    motion = mbd.simulate(
        n_four_bar(), duration, steps=steps, spectral_radius=0.95, refresh=0, gradients="none"
    ).require_ok()
    _, total = energy(motion)
    return motion.body("upright_0").at((0.0, 0.5, 0.0)).position[0, -1], float(abs(total - total[0]).max())


def four_bar_tip(t: float) -> tuple[float, float]:
    """The closed solution."""
    [angle] = n_four_bar_at(torch.tensor([t]).numpy())
    return math.sin(angle), math.cos(angle)


def bricard_norm(steps: int = 1000, **options) -> float:
    """Norm of the displacements after 1 s."""
    motion = mbd.simulate(bricard(0.1), 1.0, steps=steps, gradients="none", **options).require_ok()
    total = torch.zeros(())
    for k in range(5):
        view = motion.body(f"rod_{k}")
        for x in (view.at((0.0, -0.5, 0.0)).position[0], view.p[0]):
            total = total + (x[-1] - x[0]).square().sum()
    return float(total.sqrt())


def main() -> None:
    """Print the tables."""
    torch.set_num_threads(1)
    print(f"{'four-bar, first bar':22}{'x [m]':>24}{'y [m]':>24}{'energy error [J]':>24}")
    print(f"{'':22}" + 3 * f"{'Exudyn':>12}{'ours':>12}")
    for name, duration, steps, part, printed in (
        ("tip, 10 s, 1 ms", 10.0, 10000, 1.0, (*TIP, ENERGY)),
        ("center, 4 s, 10 ms", 4.0, 400, 0.5, (*CENTER, COARSE_ENERGY)),
    ):
        tip, error = four_bar(duration, steps)
        own = part * float(tip[0]), part * float(tip[1]), error
        print(f"{name:22}" + "".join(f"{a:12.7f}{b:12.7f}" for a, b in zip(printed, own, strict=True)), flush=True)
        exact = [part * x for x in four_bar_tip(duration)]
        print(f"{'  closed solution':22}" + "".join(f"{'':12}{x:12.7f}" for x in exact), flush=True)
    print(f"\nBricard, norm of displacements after 1 s: printed {BRICARD:.6f}")
    print(f"  ours, steps of 1 ms: {bricard_norm(spectral_radius=0.9):.6f}", flush=True)
    print(f"  ours, dopri8:        {bricard_norm(20, method='dopri8', rtol=1e-9, atol=1e-10):.6f}")


if __name__ == "__main__":
    main()
