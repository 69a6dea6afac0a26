"""Estimates of the errors of the steps of a motion: truncation errors, alternating accelerations, rotations in one step.

Source: Zienkiewicz and Xie, Earthq. Eng. Struct. Dyn. 20 (1991) 871-887.
Checked in tests/integrate/test_simulate.py.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchmbd.integrate.statistics import Statistics
from torchmbd.math.pair import value
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.multibody.system.equations import split_v
from torchmbd.results.history import History

GOOD_STEP = 0.01  # estimated error of a step that keeps energies within 1e-3
_STILL = 1e-12  # [kg^1/2 m] modal coordinates that are rounding only
_ROUNDING = 100.0 * torch.finfo(torch.float64).eps  # of coordinates


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

    def put_into(self, statistics: Statistics, steps: int) -> None:
        """Errors of so many steps, and how many would do."""
        error = self.factor * self.change
        error = error / self.largest.clamp_min(_STILL) if self.modes else error
        # Of resolved vibrations it falls with the third power of h, of others with the second: never too few steps.
        ratio = error / GOOD_STEP
        statistics.step_error = error
        statistics.suggested_steps = (steps * ratio.pow(0.5).maximum(ratio.pow(1 / 3).clamp_max(1.0))).ceil()


def alternations(dynamics: Dynamics, history: History) -> Tensor:
    """Of the accelerations of points, what changes its sign from step to step, and all of it [2, times - 2, lanes] [m/s2].

    The first is zero where it is rounding only, as of beams at rest.
    """
    a = split_v(dynamics.topology, history.vd[:, :, 0].transpose(0, 1))[0].flatten(0, 1)
    change, size = 0.25 * (a[:, 2:] - 2.0 * a[:, 1:-1] + a[:, :-2]), a[:, 1:-1]
    change, size = (x.square().sum(0).sqrt() for x in (change, size))
    return torch.stack([torch.where(change > _acceleration_by_rounding(dynamics, history), change, 0.0), size])


def _acceleration_by_rounding(dynamics: Dynamics, history: History) -> Tensor:
    """Largest acceleration of nodes by the elements of beams, where their places are rounded [lanes] [m/s2]."""
    T, data = dynamics.topology, dynamics.data
    assert T.beams is not None
    stiffness = value(data["beam_stiffness"])[:3, :3, :, 0].abs().amax((0, 1))  # [N/m]
    mass = value(data["mass"])[:, 0]
    rates = [stiffness[k % len(stiffness)] / mass[body] for k, body in enumerate(T.beams.bodies) if body < T.bodies]
    far = history.q[:, : 3 * T.bodies, 0].abs().amax((0, 1))
    return _ROUNDING * far * torch.stack(torch.broadcast_tensors(0.0 * far, *rates)).amax(0)


def alternating_share(parts: Tensor, counted: Tensor) -> Tensor:
    """Share [lanes] of the accelerations that changes its sign from step to step.

    parts     as of `alternations`
    counted   the steps that count [times - 2, lanes]: what a jump leaves has been damped since
    """
    change, size = torch.where(counted, parts, 0.0).sum(1)
    return change / size.clamp_min(torch.finfo(size.dtype).tiny)


def second_halves(number: Tensor) -> Tensor:
    """Inner times of the second half of each phase [times - 2, lanes].

    number   of the phase at each time [times, lanes], -1: of none
    """
    later = torch.zeros_like(number, dtype=torch.bool)
    for k in range(int(number.max()) + 1):
        inside = number == k
        later |= inside & (2 * inside.cumsum(0) > inside.sum(0))
    middle = number[1:-1]
    return later[1:-1] & (middle == number[:-2]) & (middle == number[2:])


def turns(dynamics: Dynamics, history: History, h: float) -> Tensor:
    """Largest rotation of a body in a step from each time [times, lanes] [rad]."""
    omega = split_v(dynamics.topology, history.v[:, :, 0].transpose(0, 1))[1]
    return h * omega.square().sum(0).sqrt().amax(0)
