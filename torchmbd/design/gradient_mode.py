"""The cheaper mode of gradients, by an estimate of the costs of a motion with its gradients.

    forward   F0 + F1 variables      simulations; tangents go along with the motion
    reverse   R0 + R1 numbers        the adjoint goes back once with all numbers that have gradients

The coefficients belong to the backend that makes the steps. They are constants and not measured for each problem: equal
problems have the same mode, so the same numbers. `torchmbd check` measures both modes.
Checked in tests/design/test_gradient_mode.py.
"""

from __future__ import annotations

from torchmbd.integrate.backend import Backend


def cheaper_mode(variables: int, numbers: int, backend: type[Backend]) -> str:
    """Return "forward" or "reverse", for a method with an adjoint; numbers: rows of the objective and of the constraints."""
    costs = (backend.forward_cost, variables), (backend.reverse_cost, numbers)
    forward, reverse = (a + b * count for (a, b), count in costs)
    return "reverse" if reverse <= forward else "forward"
