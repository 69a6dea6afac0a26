"""Estimates of the errors of the steps of a motion: truncation errors, alternating accelerations, rotations in one step.

Source: Zienkiewicz and Xie, Earthq. Eng. Struct. Dyn. 20 (1991) 871-887.
Checked in tests/integrate/test_simulate.py.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.multibody.system.equations import split_v
from torchmbd.results.history import History

GOOD_STEP = 0.01  # estimated error of a step that keeps energies within 1e-3
_STILL = 1e-12  # [kg^1/2 m] modal coordinates that are rounding only


class StepErrors:
    """Estimated largest error that one step of size h [s] adds, and the number of steps that would make it 1 % [lanes].

    h^2 constant |v1' - v0'| of the modal coordinates, relative to the largest of the motion; without flexible bodies, of the
    rotations [rad]. Of a Newmark method the constant is |beta - 1/6|.
    """

    def __init__(self, dynamics: Dynamics, constant: float, h: float):
        self.T, self.factor = dynamics.topology, h * h * constant
        self.modes = self.T.modes * self.T.flexible
        self.change = self.largest = torch.zeros(dynamics.lanes, dtype=torch.float64)

    def update(self, history: History, smooth: Tensor | None = None) -> None:
        """Go on with states, the first of which was the last before; smooth: steps without a jump [steps, lanes]."""
        T, accelerations = self.T, history.vd[:, :, 0].transpose(0, 1)
        rows = split_v(T, accelerations)[2 if self.modes else 1].flatten(0, 1)
        change = rows[:, 1:] - rows[:, :-1]
        if smooth is not None:
            change = torch.where(smooth, change, 0.0)
        self.change = self.change.maximum(change.square().sum(0).sqrt().amax(0))
        modal = history.q[:, T.n_q - self.modes :, 0]
        self.largest = self.largest.maximum(modal.square().sum(1).sqrt().amax(0))

    def statistics(self, steps: int) -> dict[str, Tensor]:
        """ "step_error" and "suggested_steps" [lanes]."""
        error = self.factor * self.change
        error = error / self.largest.clamp_min(_STILL) if self.modes else error
        # Of resolved vibrations it falls with the third power of h, of others with the second: never too few steps.
        ratio = error / GOOD_STEP
        return {
            "step_error": error,
            "suggested_steps": (steps * ratio.pow(0.5).maximum(ratio.pow(1 / 3).clamp_max(1.0))).ceil(),
        }


def alternations(dynamics: Dynamics, history: History) -> Tensor:
    """Of the accelerations of points, what changes its sign from step to step, and all of it [2, times - 2, lanes] [m/s2]."""
    a = split_v(dynamics.topology, history.vd[:, :, 0].transpose(0, 1))[0].flatten(0, 1)
    change = 0.25 * (a[:, 2:] - 2.0 * a[:, 1:-1] + a[:, :-2])
    return torch.stack([x.square().sum(0).sqrt() for x in (change, a[:, 1:-1])])


def turns(dynamics: Dynamics, history: History, h: float) -> Tensor:
    """Largest rotation of a body in a step from each time [times, lanes] [rad]."""
    omega = split_v(dynamics.topology, history.v[:, :, 0].transpose(0, 1))[1]
    return h * omega.square().sum(0).sqrt().amax(0)
