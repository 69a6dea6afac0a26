"""Estimates of what a motion leaves to be desired: errors of steps, and rotations in one step.

Source: Zienkiewicz and Xie, Earthq. Eng. Struct. Dyn. 20 (1991) 871-887.
Checked in tests/integrators/test_simulate.py.
"""

from __future__ import annotations

from torch import Tensor

from torchmbd.integrators.history import History
from torchmbd.system.dynamics import Dynamics
from torchmbd.system.equations import split_v

GOOD_STEP = 0.01  # estimated error of a step that keeps energies within 1e-3
_STILL = 1e-12  # [kg^1/2 m] modal coordinates that are rounding only


def step_errors(dynamics: Dynamics, history: History, constant: float, h: float) -> dict[str, Tensor]:
    """Estimated largest error that one step of size h adds, and the number of steps that would make it 1 % [lanes].

    h^2 constant |v1' - v0'| of the modal coordinates, relative to the largest of the motion; without flexible bodies, of the
    rotations [rad]. Of a Newmark method the constant is |beta - 1/6|.
    """
    T = dynamics.topology
    modes = T.modes * T.flexible
    accelerations = history.vd[:, :, 0].transpose(0, 1)
    rows = split_v(T, accelerations)[2 if modes else 1].flatten(0, 1)
    change = rows[:, 1:] - rows[:, :-1]
    error = h * h * constant * change.square().sum(0).sqrt().amax(0)
    if modes:
        largest = history.q[:, T.n_q - modes :, 0].square().sum(1).sqrt().amax(0)
        error = error / largest.clamp_min(_STILL)
    steps = len(history.q) - 1
    return {"step_error": error, "suggested_steps": (steps * (error / GOOD_STEP).sqrt()).ceil()}


def turns(dynamics: Dynamics, history: History, h: float) -> Tensor:
    """Largest rotation of a body in a step from each time [times, lanes] [rad]."""
    omega = split_v(dynamics.topology, history.v[:, :, 0].transpose(0, 1))[1]
    return h * omega.square().sum(0).sqrt().amax(0)
