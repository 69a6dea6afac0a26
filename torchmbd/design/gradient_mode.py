"""The cheaper mode of gradients, by an estimate of the costs of a motion with its gradients.

    forward   F0 + F1 variables      simulations; tangents go along with the motion
    reverse   R0 + R1 numbers        the adjoint goes back once with all numbers that have gradients

The coefficients are processor times of the slider-crank with compiled steps (2,000 steps, 1 to 8 variables, 1 to 16 numbers),
by the time of a motion without gradients: forward 2.1 to 2.9, reverse 1.4 to 3.5. They are constants and not measured for
each problem: equal problems have the same mode, so the same numbers. `torchmbd check` measures both modes.
Checked in tests/design/test_gradient_mode.py.
"""

from __future__ import annotations

_FORWARD = (2.0, 0.1)  # F0, F1
_REVERSE = (1.5, 0.12)  # R0, R1


def cheaper_mode(variables: int, numbers: int) -> str:
    """Return "forward" or "reverse", for a method with an adjoint; numbers: rows of the objective and of the constraints."""
    forward, reverse = (a + b * count for (a, b), count in ((_FORWARD, variables), (_REVERSE, numbers)))
    return "reverse" if reverse <= forward else "forward"
