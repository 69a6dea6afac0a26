"""Estimates of the errors of equal steps, of one segment or of several, from their states as they come.

    StepErrors        truncation errors
    IterationErrors   what the iterations leave
    alternations      accelerations that change their sign from step to step
    turns             rotations in one step

Source: Zienkiewicz and Xie, Earthq. Eng. Struct. Dyn. 20 (1991) 871-887.
Checked in tests/integrate/test_simulate.py, tests/integrate/phases/test_phase.py.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchmbd.integrate.statistics import ITERATION_ERROR, ROUNDING, TURN, Statistics
from torchmbd.math.pair import value
from torchmbd.multibody.equations.equations import split_v
from torchmbd.multibody.system.dynamics import Dynamics
from torchmbd.results.history import History

GOOD_STEP = 0.01  # estimated error of a step that keeps energies within 1e-3
_STILL = 1e-12  # of the size of the mechanism times kg^1/2 of a body: modal coordinates that are rounding only
_OF_PLACES = 100.0 * torch.finfo(torch.float64).eps  # of coordinates


class StepEstimates:
    """Of steps of size duration / steps [s].

    dynamics   of the states;  constant: of the error of a step, as in StepErrors
    """

    def __init__(self, dynamics: Dynamics, constant: float, duration: float, steps: int):
        self.dynamics, self.duration, self.steps, self.h = dynamics, duration, steps, duration / steps
        self.errors = StepErrors(dynamics, constant, self.h)
        self.iterations = IterationErrors(dynamics, duration, self.h)
        self.turn = torch.zeros(steps + 1, dynamics.lanes, dtype=torch.float64)
        self.alternation: Tensor | None = None
        if dynamics.topology.has_fast_elements:
            self.alternation = torch.zeros(2, steps + 1, dynamics.lanes, dtype=torch.float64)

    def update(self, first: int, states: History, errors: Tensor, counted: Tensor | None = None) -> None:
        """Go on with states at the times of number `first` and those after it, and the errors of the iterations between these.

        states    the first was the last before, but where a segment begins
        errors    [lanes, times - 1]
        counted   which lanes have states [times, lanes]; None: all
        """
        smooth = None
        if counted is not None:
            q, v, vd, lam = (torch.where(counted[:, None, None], x[:, :, :1], 0.0) for x in states.states)
            states, smooth = History(q, v, vd, lam), counted[1:] & counted[:-1]
        end = first + len(states.q)
        self.iterations.update(first, states, errors)
        self.errors.update(states, smooth)
        turn = turns(self.dynamics, states, self.h)
        self.turn[first:end] = turn if counted is None else torch.where(counted, turn, self.turn[first:end])
        if self.alternation is not None and len(states.q) > 2:
            inner, share = slice(first + 1, end - 1), alternations(self.dynamics, states)
            if smooth is not None:
                share = torch.where(smooth[1:] & smooth[:-1], share, self.alternation[:, inner])
            self.alternation[:, inner] = share

    def put_into(self, statistics: Statistics, segment: Tensor | None = None, every: int = 1) -> None:
        """Of all lanes.

        segment  number of that of each time [times, lanes], None: there is one
        every    steps between two states that are kept
        """
        statistics.steps, statistics.step_size, statistics.turn = self.steps, self.h, self.turn.amax(0)
        self.errors.put_into(statistics, self.steps)
        self.iterations.put_into(statistics, self.steps + 1)
        if self.alternation is not None:
            number = torch.zeros(self.steps + 1, 1, dtype=torch.long) if segment is None else segment
            late = second_halves(number)  # what a jump leaves has been damped since
            change, size = torch.where(late, self.alternation[:, 1:-1], 0.0).sum(1)
            statistics.alternation = change / size.clamp_min(torch.finfo(size.dtype).tiny)
        assert statistics.valid_times is not None
        valid = statistics.valid_times.minimum(first_true(self.turn > TURN).clamp_min(1))
        statistics.valid_times = (valid + every - 1) // every


class StepErrors:
    """Estimated largest error that one step of size h [s] adds, and the number of steps that would make it 1 % [lanes].

    h^2 constant |v1' - v0'| of the modal coordinates, relative to the largest of the motion; without flexible bodies, of the
    rotations [rad]. Of a Newmark method the constant is |beta - 1/6|.
    """

    def __init__(self, dynamics: Dynamics, constant: float, h: float):
        self.T, self.factor = dynamics.topology, h * h * constant
        self.modes = self.T.modes * self.T.flexible
        mass = value(dynamics.data["mass"])[: self.T.flexible, 0]
        self.still = _STILL * dynamics.initial.size * mass.clamp_min(0.0).sqrt().amax(0) if self.modes else 0.0
        self.change = self.largest = torch.zeros(dynamics.lanes, dtype=torch.float64)

    def update(self, history: History, smooth: Tensor | None = None) -> None:
        """Go on with states, the first of which was the last before; smooth: steps without a jump [steps, lanes]."""
        T, accelerations = self.T, history.vd[:, :, 0].transpose(0, 1)
        rows = split_v(T, accelerations)[2 if self.modes else 1].flatten(0, 1)
        change = rows[:, 1:] - rows[:, :-1]
        if smooth is not None:
            change = torch.where(smooth, change, 0.0)
        self.change = self.change.maximum(change.square().sum(0).sqrt().amax(0))
        modal = history.q[:, 7 * T.bodies : 7 * T.bodies + self.modes, 0]
        self.largest = self.largest.maximum(modal.square().sum(1).sqrt().amax(0))

    def put_into(self, statistics: Statistics, steps: int) -> None:
        """Errors of so many steps, and how many would do."""
        error = self.factor * self.change
        error = error / self.largest.clamp_min(self.still) if self.modes else error
        # Of resolved vibrations it falls with the third power of h, of others with the second: never too few steps.
        ratio = error / GOOD_STEP
        statistics.step_error = error
        statistics.suggested_steps = (steps * ratio.pow(0.5).maximum(ratio.pow(1 / 3).clamp_max(1.0))).ceil()


class IterationErrors:
    """Estimated errors of the iterations of steps of size h [s], and the first time of which they did not converge [lanes].

    The next correction of values would be |last|^2 / |one before|, relative to the largest acceleration of the motion, or to
    the largest rate over the duration: a uniform motion has accelerations of rounding size. Or to what the rounding of
    coordinates at the start makes of them: a system at rest has nothing else. All numbers are divided by sizes (sizes.py).
    """

    def __init__(self, dynamics: Dynamics, duration: float, h: float):
        self.duration, self.h = duration, h
        self.sizes = dynamics.sizes
        self.scale: Tensor | None = None  # so far
        self.largest = torch.zeros(dynamics.lanes, dtype=torch.float64)
        self.first_bad = torch.full((dynamics.lanes,), torch.iinfo(torch.long).max)

    def update(self, first: int, history: History, errors: Tensor) -> None:
        """Go on with states from the time of number `first` on, and errors of the steps between them [lanes, steps]."""
        if self.scale is None:
            far = (history.q[0, :, 0].abs() / self.sizes.q).amax(0)
            self.scale = ROUNDING * far / (self.h * self.h)
        largest = ((x[:, :, 0].abs() / self.sizes.v).amax(1) for x in (history.vd, history.v))
        reached, speed = (x.cummax(0).values for x in largest)
        # Up to every time: what comes after a failure is no measure of it.
        scale = self.scale.maximum(reached.maximum(speed / self.duration))
        bad = ~(ITERATION_ERROR * scale[1:] >= errors.T)
        times = first + 1 + first_true(bad)
        self.first_bad = torch.where(bad.any(0), self.first_bad.minimum(times), self.first_bad)
        self.scale, self.largest = scale[-1], self.largest.maximum(errors.amax(-1))

    def put_into(self, statistics: Statistics, times: int) -> None:
        """Relative errors, and how many of so many times are before the first bad one."""
        scale = torch.ones_like(self.largest) if self.scale is None else self.scale
        tiny = torch.finfo(scale.dtype).tiny
        statistics.iteration_error = self.largest / scale.clamp_min(tiny)
        statistics.valid_times = self.first_bad.clamp_max(times)


def alternations(dynamics: Dynamics, history: History) -> Tensor:
    """Of the accelerations of points, what changes its sign from step to step, and all of it [2, times - 2, lanes] [m/s2].

    The first is zero where it is rounding only, as for beams at rest.
    """
    a = split_v(dynamics.topology, history.vd[:, :, 0].transpose(0, 1))[0].flatten(0, 1)
    change, size = 0.25 * (a[:, 2:] - 2.0 * a[:, 1:-1] + a[:, :-2]), a[:, 1:-1]
    change, size = (x.square().sum(0).sqrt() for x in (change, size))
    return torch.stack([torch.where(change > _acceleration_by_rounding(dynamics, history), change, 0.0), size])


def rigid_alternations(dynamics: Dynamics, a: Tensor, far: Tensor, h: float) -> tuple[Tensor, Tensor]:
    """As `alternations`, of accelerations a [lanes, times, n_v] of rigid bodies [lanes, times - 2] [kg^1/2 m/s2].

    |a|^2 = m |r''|^2 + tr P0 |omega'|^2, with the second moments P0 of the mass about the origins of bodies

    far  largest coordinate of the motion [m], whose rounding does not count;  h: size of a step [s]
    """
    points, rotations, _ = split_v(dynamics.topology, a.movedim(-1, 0))  # [3, bodies, lanes, times]
    mass = value(dynamics.data["mass"])[:, 0, :, None].sqrt()
    arm = value(dynamics.data["P0"])[:, :, :, 0].diagonal().sum(-1)[..., None].sqrt()
    x = torch.cat([points * mass, rotations * arm]).flatten(0, 1)
    change = 0.25 * (x[..., 2:] - 2.0 * x[..., 1:-1] + x[..., :-2]).norm(dim=0)
    rounding = ROUNDING / h**2 * mass.amax() * far
    return torch.where(change > rounding, change, 0.0), x[..., 1:-1].norm(dim=0)


def _acceleration_by_rounding(dynamics: Dynamics, history: History) -> Tensor:
    """Largest acceleration of nodes by the elements of beams, where their places are rounded [lanes] [m/s2]."""
    T, data = dynamics.topology, dynamics.data
    assert T.beams is not None
    stiffness = value(data["beam_stiffness"])[:3, :3, :, 0].abs().amax((0, 1))  # [N/m]
    mass = value(data["mass"])[:, 0]
    rates = [stiffness[k % len(stiffness)] / mass[body] for k, body in enumerate(T.beams.bodies) if body < T.bodies]
    far = history.q[:, : 3 * T.bodies, 0].abs().amax((0, 1))
    return _OF_PLACES * far * torch.stack(torch.broadcast_tensors(0.0 * far, *rates)).amax(0)


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


def first_true(mask: Tensor) -> Tensor:
    """The first time at which a mask [times, lanes] is true, the number of times where it never is [lanes]."""
    return torch.where(mask.any(0), mask.int().argmax(0), len(mask))
