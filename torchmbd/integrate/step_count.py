"""The number of equal steps of a motion where the caller gives none: by its loads and vibrations, not by the highest mode.

    first   enough to follow loads and drives as functions of time: straight lines between the steps are off by 1 % (L1 norm);
            at least 200, without flexible bodies 1000
    then    as many as the estimated error of a step asks for (estimates.py), and contacts (contacts.py), until both are met
    then    without flexible bodies and beams: as many as keep the phase of vibrations on springs, at most 20,000
    most    20 per period of the fastest retained mode: every mode is resolved

Some steps end where held values of a controller change (jumps.py).

A vibration of rigid bodies that turns its phase by phi in each of n steps is n phi^3 / 12 late at the end. Its size among all
accelerations gives phi (diagnosis/rigid_vibrations.py), and the mean time of these the number n in which the error grows.
Source of phi^3 / 12: Hughes, The Finite Element Method, ch. 9 (the trapezoidal rule; numerical damping adds little).

Modes that nothing excites cost no steps. Laws are sampled at 2048 times: a shorter pulse is not seen before it acts.
Checked in tests/integrate/test_step_count.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence

import torch
from torch import Tensor

from torchmbd.errors import InputError, warn
from torchmbd.integrate.estimates import GOOD_STEP, rigid_alternations
from torchmbd.integrate.held_times import held_times_of, steps_at
from torchmbd.integrate.initial_value import InitialValueProblem
from torchmbd.integrate.integrator import IntegrationResult, Integrator
from torchmbd.integrate.lane_status import ALTERNATION, status_of_lanes
from torchmbd.integrate.ode import fastest_vibration
from torchmbd.integrate.statistics import TURN
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equations.times_as_lanes import as_lanes
from torchmbd.multibody.system import Dynamics
from torchmbd.results.motion_data import OK, has_failed

FEWEST, RIGID = 200, 1000  # steps
_MOST_RIGID = 20_000
_SAMPLES = 2048  # of laws of time
_SHARE = 0.01  # of a law that straight lines between the steps may miss
_FINER = 4.0  # times the steps whose error is GOOD_STEP: errors of many periods add up
_NEAR = 1.5  # times the error aimed at: not worth another motion
_MORE = 1.1  # times the steps that the estimate says
_PHASE = 0.01  # [rad] of a vibration of rigid bodies, mean over the motion: an error of 1 % of its size
_LATE = 0.1  # [rad] the same, of which a warning tells
_UNKNOWN = 4  # times the steps of a motion that failed
_MOST_MORE = 8  # times the steps of a motion has the next: the estimate of a coarse motion is a rough one
_LEAST_SHARE = 1000  # of the steps that resolve every mode: a motion of which not even so few fit is refused at once


def choose_steps(
    integrator: Integrator, problem: InitialValueProblem, check_memory: Callable[[int], None]
) -> tuple[int, IntegrationResult | None]:
    """The number of steps that a motion of values needs, and this motion.

    Methods without estimates of their error get the steps that all modes need, and are not tried: their result is None.
    check_memory   raises InputError for a number of steps that does not fit into memory
    """
    dynamics, duration = problem.dynamics, problem.duration
    round_up = rounding(integrator, dynamics, duration)
    most = round_up(all_modes(dynamics, duration))
    if not integrator.adjoint:
        most = min(most, round_up(RIGID)) if "Kr" not in dynamics.data else most
        check_memory(most)
        return most, None
    try:
        check_memory(most // _LEAST_SHARE)
    except InputError:
        check_memory(most)  # the message names the steps that resolve every mode
    steps = min(round_up(first_steps(problem)), most)
    while True:
        check_memory(steps)
        result = problem.integrate(integrator, steps)
        # What was given up, as a phase that never ends, is with more steps as well.
        status = status_of_lanes(result.history, duration, result.statistics, result.sizes)
        status = [OK if lane in result.failed else reason for lane, reason in enumerate(status)]
        needed = needed_steps(steps, result, status, dynamics.start_errors)
        late = _late(result, duration / steps)
        if late > _NEAR**2 * _PHASE:
            needed = max(needed, math.ceil(steps * min((late / _PHASE) ** 0.5, _MOST_MORE)))
        if needed <= steps or steps >= most:
            if late > _LATE:
                _warn_late(late, steps)
            return steps, result
        steps = min(round_up(needed), most)


def rounding(integrator: Integrator, dynamics: Dynamics, duration: float) -> Callable[[int], int]:
    """Rounds a number of steps up to one that suits the integrator, and where held values of controllers change."""
    fitting = steps_at(held_times_of(dynamics, duration), duration)
    multiple = math.lcm(integrator.round_up_steps(1), fitting or 1)
    return lambda steps: -(-steps // multiple) * multiple


def all_modes(dynamics: Dynamics, duration: float) -> int:
    """Twenty steps per period of the fastest retained mode, at least 200 in all."""
    if "Kr" not in dynamics.data:
        return _MOST_RIGID
    return max(FEWEST, math.ceil(20.0 * duration * fastest_vibration(dynamics) / (2.0 * math.pi)))


def first_steps(problem: InitialValueProblem) -> int:
    """Enough for loads and drives of the first design; see the module header."""
    least = FEWEST if "Kr" in problem.dynamics.data else RIGID
    with torch.no_grad():
        laws = _laws(problem.values().select_lanes([0]))
    for count in (2**k for k in range(6, 12)):
        if all(_followed(f, _SAMPLES // count) for f in laws):
            return max(least, count)
    return max(least, _SAMPLES)


def needed_steps(steps: int, result: IntegrationResult, status: Sequence[str], start_errors: Collection[int]) -> int:
    """How many steps the lanes of a motion of so many need; lanes without an initial state (`start_errors`) need no more."""
    needed, s, contacts = steps, result.statistics, result.contacts
    assert s.turn is not None
    assert s.step_error is not None
    assert s.suggested_steps is not None
    for lane, reason in enumerate(status):
        if lane in start_errors:
            continue
        if lane in contacts:
            needed = max(needed, steps * contacts[lane].substeps)
        turn, error = float(s.turn[lane]), float(s.step_error[lane])
        if turn > TURN:
            needed = max(needed, math.ceil(_MORE * steps * turn / TURN) if math.isfinite(turn) else _UNKNOWN * steps)
        elif has_failed(reason) or not math.isfinite(error):
            needed = max(needed, _UNKNOWN * steps)
        elif error > _NEAR * GOOD_STEP / _FINER**2:
            needed = max(needed, math.ceil(_MORE * _FINER * float(s.suggested_steps[lane])))
    return min(needed, _MOST_MORE * steps)


def _late(result: IntegrationResult, h: float) -> float:
    """Mean phase [rad] by which vibrations of rigid bodies on springs are late in steps of size h: the largest of all lanes."""
    history, dynamics = result.history, result.history.run.recorded.values()
    T = dynamics.topology
    if T.flexible or T.has_fast_elements or not T.actions or not T.bodies:
        return 0.0
    accelerations, places = history.vd[:, :, 0].permute(2, 0, 1), history.q[:, : 3 * T.bodies, 0]
    change, size = rigid_alternations(dynamics, accelerations, places.abs().amax(), h)
    total = size.sum(1).clamp_min(torch.finfo(size.dtype).tiny)
    share = change.sum(1) / total
    steps = (size * torch.arange(1, size.shape[1] + 1)).sum(1) / total
    phi = 2.0 * share.clamp_max(1.0).sqrt().asin()
    late = torch.where(share > ALTERNATION, torch.inf, steps * phi**3 / 12.0)  # phi may be that of a faster one
    return float(late.nan_to_num(0.0, posinf=torch.inf).amax())


def _warn_late(late: float, steps: int) -> None:
    more = f"steps={math.ceil(steps * (late / _PHASE) ** 0.5) if math.isfinite(late) else _UNKNOWN * steps}"
    other = "method='rk4', whose phase error is of the fourth order in the step, or " if math.isfinite(late) else ""
    warn(
        f"{steps} steps are the most that simulate chooses for rigid bodies, and their vibrations on springs are late: "
        f"by {late:.1g} rad in the mean. Try: {other}{more}"
    )


def _followed(f: Tensor, stride: int) -> bool:
    """True if straight lines between every `stride`-th of the samples f [k, samples + 1] stay near all of them."""
    if not f.numel() or stride < 1:
        return True
    x = torch.linspace(0.0, 1.0, stride + 1, dtype=f.dtype)[:-1]
    ends = f[:, ::stride]
    lines = (ends[:, :-1, None] * (1.0 - x) + ends[:, 1:, None] * x).flatten(1)
    off = (lines - f[:, :-1]).abs().mean(1)
    size = (f - f.mean(1, keepdim=True)).abs().mean(1)
    return bool((off <= _SHARE * size.max()).all())


def _laws(problem: InitialValueProblem) -> list[Tensor]:
    """Samples [k, samples + 1] of what drives prescribe and of forces at the initial state, for each kind of them."""
    T, data = problem.dynamics.topology, problem.dynamics.data
    times = torch.linspace(0.0, problem.duration, _SAMPLES + 1, dtype=torch.float64)
    laws = []
    for kind in T.primitives:
        if kind.prescribes:
            laws += [part[..., 0].flatten(1).T for part in kind.prescribed(times, data)]
    if T.actions:
        q, v = (x[..., :1].expand(*x.shape[:-1], len(times)) for x in problem.closed_start)
        at = equations.placement(T, data, q, as_lanes(T.schedule(times, data)))
        states = equations.action_states(T, data, at, v)
        laws += [f.flatten(0, -2) for f in equations.strengths(T, data, states, at.t) if f.shape[-1] == len(times)]
    return [f for f in laws if bool(torch.isfinite(f).all())]
