"""Are the gradients exact? `python -m experiments.paper.gradients`

Gradients of the integral and of the peak of U at general angles of one, two and three layers:

1. generalized-alpha, tight iteration, against central differences of the same discrete map;
2. generalized-alpha, default iteration, against the tight one;
3. torchdiffeq (dopri8, augmented state) against central differences of itself at tight tolerances, over a shorter time;
4. forward against reverse mode, both through the same fixed steps of torchdiffeq's rk4.

Every figure is the largest difference over the largest entry of the gradient.
"""

from __future__ import annotations

import numpy as np
import torch
import torchdiffeq

import torchmbd as mbd
from torchmbd.examples.slider_crank import DURATION, build

DESIGNS = {1: [0.3], 2: [0.5, -0.9], 3: [0.4, -0.7, 1.1]}  # [rad]
ENERGY = mbd.StrainEnergy("rod")


def problem(layers: int, duration: float = DURATION, modes: int = 8, **simulation) -> mbd.Problem:
    """Integral of U as objective, peak of U as constraint."""
    system = build(layers, modes=modes, cells=(24, 4))
    return mbd.Problem(system, duration, mbd.Integral(ENERGY), [mbd.Max(ENERGY) <= 1.0], **simulation)


def gradients(p: mbd.Problem, x: list[float]) -> np.ndarray:
    """Exact gradients [2, n] of objective and constraint."""
    [e] = p.evaluate(np.array([x]), gradients=True)
    if e.objective_gradient is None or e.constraint_gradients is None:
        raise mbd.SimulationFailure(e.status)
    return np.vstack([e.objective_gradient, e.constraint_gradients])


def differences(p: mbd.Problem, x: list[float], h: float) -> np.ndarray:
    """Fourth-order central differences [2, n], all perturbed designs in one batch."""
    n = len(x)
    shifts = np.concatenate([k * h * np.eye(n) for k in (-2, -1, 1, 2)])
    evaluations = p.evaluate(np.array(x) + shifts, gradients=False)
    f = np.array([[e.objective, *e.constraints] for e in evaluations]).reshape(4, n, 2)
    return ((f[0] - f[3] + 8 * (f[2] - f[1])) / (12 * h)).T


def relative(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Largest difference over the largest entry, for each response."""
    return np.abs(a - b).max(1) / np.abs(b).max(1)


def forward_and_reverse(layers: int, duration: float = 2e-4, steps: int = 20) -> float:
    """Largest relative difference of the gradient of the final strain energy between the two modes."""
    system = build(layers, np.degrees(DESIGNS[layers]).tolist(), cells=(8, 2), modes=4)
    motion = mbd.simulate(system, duration, method="rk4", steps=steps, gradients="forward")
    forward = ENERGY.series(motion).gradient
    f = system()
    dynamics = f.dynamics
    t = torch.linspace(0, duration, steps + 1, dtype=torch.float64)
    z = torchdiffeq.odeint(f, f.initial_state(), t, method="rk4")
    w = z[-1, 0, dynamics.topology.w_slice(0)]  # type: ignore[index]
    (0.5 * w @ dynamics.data["Kr"][:, :, 0, 0, 0] @ w).backward()
    reverse = system.body("rod").laminate.angles.grad
    assert forward is not None
    return float((forward[0, -1] - reverse).abs().max() / reverse.abs().max())


def main() -> None:
    torch.set_num_threads(1)
    print("layers  route                                            integral of U   peak of U")
    for layers, x in DESIGNS.items():
        tight = problem(layers, steps=600, iterations=(5, 5), refresh=1)
        exact = gradients(tight, x)
        default = gradients(problem(layers, steps=600), x)
        ode = problem(layers, 2e-3, modes=4, method="dopri8", steps=40, rtol=1e-11, atol=1e-13)
        rows = {
            "generalized-alpha, tight, against differences": relative(exact, differences(tight, x, 2e-5)),
            "generalized-alpha, default, against tight": relative(default, exact),
            "dopri8 against differences": relative(gradients(ode, x), differences(ode, x, 1e-4)),
        }
        for name, figures in rows.items():
            print(f"L{layers}      {name:48s} {figures[0]:.1e}         {figures[1]:.1e}", flush=True)
        print(f"L{layers}      {'forward against reverse (final U)':48s} {forward_and_reverse(layers):.1e}", flush=True)


if __name__ == "__main__":
    main()
