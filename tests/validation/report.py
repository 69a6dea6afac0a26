"""Errors of the rigid benchmarks over 10 s (heavy top: 2 s): `python -m tests.validation.report`.

Largest distance from the reference over time, and largest change of the energy over the largest kinetic energy.
References: closed solutions (rigid_benchmarks.py).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

import torchmbd as mbd
from tests.validation.rigid_benchmarks import (
    bricard,
    bricard_at,
    heavy_top,
    heavy_top_at,
    n_four_bar,
    n_four_bar_at,
    simple_pendulum,
    simple_pendulum_at,
)
from tests.validation.test_rigid_benchmarks import energy, run


def print_line(name: str, motion: mbd.Trajectory, found: np.ndarray, wanted: np.ndarray) -> None:
    """Name, method, error [m] and drift of the energy."""
    kinetic, total = energy(motion)
    drift = np.abs(total - total[0]).max() / kinetic.max()
    print(f"{name:42s} {np.abs(found - wanted).max():9.1e}  {drift:9.1e}", flush=True)


def pendulum() -> None:
    motion = run(simple_pendulum(), 10.0, 20)
    result = motion.body("bob").at((-1.0, 0.0, 0.0)).position[0, :, :2].numpy()
    print_line("A01 simple pendulum, dopri8", motion, result, simple_pendulum_at(motion.t.numpy()))


def four_bar(name: str, motion: mbd.Trajectory) -> None:
    th = n_four_bar_at(motion.t.numpy())
    result = motion.body("upright_2").at((0.0, 0.5, 0.0)).position[0, :, :2].numpy()
    print_line(f"A02 N-four-bar, {name}", motion, result, np.stack([2.0 + np.sin(th), np.cos(th)], -1))


def four_bars() -> None:
    four_bar("dopri8", run(n_four_bar(), 10.0, 200))
    for steps in (1000, 2000, 10000):
        motion = mbd.simulate(n_four_bar(), 10.0, steps=steps, refresh=0, gradients="none").require_ok()
        four_bar(f"generalized-alpha, {1e4 / steps:g} ms", motion)


def chain() -> None:
    motion = run(bricard(), 10.0, 16, rtol=1e-9, atol=1e-10)
    result = torch.stack([motion.body(f"rod_{k}").at((0.0, 0.5, 0.0)).position[0] for k in range(5)], 1).numpy()
    print_line("A04 Bricard's mechanism, dopri8", motion, result, bricard_at(motion.t.numpy()))


def top() -> None:
    motion = run(heavy_top(), 2.0, 20)
    result = motion.body("top").at((0.0, 1.0, 0.0)).position[0, :, 2].numpy()
    print_line("heavy top, dopri8", motion, result, heavy_top_at(motion.t.numpy()))


def main() -> None:
    torch.set_num_threads(1)
    print(f"{'mechanism, method':42s} error [m]  energy drift")
    parts: tuple[Callable[[], None], ...] = (pendulum, four_bars, chain, top)
    for part in parts:
        part()


if __name__ == "__main__":
    main()
