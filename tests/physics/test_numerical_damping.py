"""One-step integrators on a linear oscillator: the recursions of their sources, and the damping that these promise.

As published, forces of both ends of a step are averaged; here accelerations are. For a constant mass it is the same motion.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import torchmbd as mbd

pytestmark = pytest.mark.usefixtures("compiled")

STEP, STEPS, WAY = 1e-3, 60, 0.01  # [s]; [m] in a step, at the speed of the start


def motion(method: str, omega: float, **options: Any) -> mbd.Trajectory:
    """A mass on a guide, on a spring of circular frequency omega [rad/s], that starts with a speed where it is at rest."""
    ground, body = mbd.Ground(), mbd.RigidBody("mass", 2.0, (1e-3, 2e-3, 3e-3), velocity=(WAY / STEP, 0.0, 0.0))
    guide = mbd.Prismatic(ground.at(), body.at(), axis="x")
    spring = mbd.SpringDamper(ground.at(-1.0, 0.0, 0.0), body.at(), 2.0 * omega**2, 0.0, 1.0)
    system = mbd.System([body], [guide], [spring])
    return mbd.simulate(system, STEP * STEPS, method, steps=STEPS, gradients="none", halvings=0, **options)


def amplification(omega: float, am: float, af: float) -> np.ndarray:
    """Matrix of a step for (x, h v, h^2 a), by Newmark's updates and (Chung and Hulbert 1993, eq. 4)

    (1 - am) a1 + am a0 + omega^2 ((1 - af) x1 + af x0) = 0;  am = 0, af = -alpha: Hilber, Hughes, Taylor 1977, eq. 1
    """
    gamma = 0.5 - am + af
    beta, k = 0.25 * (0.5 + gamma) ** 2, (STEP * omega) ** 2
    new = np.array([[1.0, 0.0, -beta], [0.0, 1.0, -gamma], [(1.0 - af) * k, 0.0, 1.0 - am]])
    old = np.array([[1.0, 1.0, 0.5 - beta], [0.0, 1.0, 1.0 - gamma], [-af * k, 0.0, -am]])
    return np.linalg.solve(new, old)


# Parameters as published, and the spectral radius at infinite frequency.
METHODS = {
    **{f"generalized_alpha {r}": ({"spectral_radius": r}, (2 * r - 1) / (r + 1), r / (r + 1), r) for r in (0.0, 0.6, 0.9)},
    **{f"hht_alpha {a}": ({"alpha": a}, 0.0, -a, (1 + a) / (1 - a)) for a in (-1 / 3, -0.2, -0.05)},
}  # fmt: skip


@pytest.mark.thorough("generalized_alpha 0.0-300.0")
@pytest.mark.parametrize("omega", [300.0, 5e3, 1e5])
@pytest.mark.parametrize("name", METHODS)
def test_the_motion_is_that_of_the_published_recursion(name, omega):
    options, am, af, _ = METHODS[name]
    result = motion(name.split()[0], omega, **options)
    A = amplification(omega, am, af)
    x = np.array([0.0, WAY, 0.0])
    for i in range(STEPS + 1):
        assert float(result.q[0, i, 0]) == pytest.approx(x[0], abs=1e-8 * WAY), i
        assert STEP * float(result.v[0, i, 0]) == pytest.approx(x[1], abs=1e-8 * WAY), i
        x = A @ x


@pytest.mark.parametrize("name", METHODS)
def test_high_frequencies_decay_with_the_spectral_radius_of_the_source(name):
    """The roots of a step, read off a motion: x of four times in a row hang together linearly."""
    options, am, af, radius = METHODS[name]
    omega = 1e6
    x = motion(name.split()[0], omega, **options).q[0, :10, 0].numpy()
    rows = np.stack([x[k : k + 4] for k in range(6)])
    recurrence = np.linalg.lstsq(rows[:, :3], rows[:, 3], rcond=None)[0]
    result = max(abs(np.roots([1.0, *-recurrence[::-1]])))
    assert result == pytest.approx(max(abs(np.linalg.eigvals(amplification(omega, am, af)))), abs=5e-3)
    assert result == pytest.approx(radius, abs=0.015)
