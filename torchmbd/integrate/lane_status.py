"""The status of each lane of a motion.

    ok               all numbers count
    unresolved: ...  all numbers are there, but the steps are too long for the vibrations or a contact that they should show
    failed: ...      with the reason; numbers count up to the failure only

Checked in tests/integrate/test_simulate.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchmbd.errors import warn
from torchmbd.integrate.contacts import UnresolvedContact
from torchmbd.integrate.initial_value import InitialValueProblem
from torchmbd.integrate.integrator import IntegrationResult
from torchmbd.integrate.statistics import ITERATION_ERROR, TURN, Statistics
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equations.sizes import Sizes, row_sizes
from torchmbd.multibody.system import Dynamics
from torchmbd.results.history import History
from torchmbd.results.motion_data import OK, has_failed

# Lanes with a larger iteration error, or with steps that were corrected further, have their joints checked.
IMPRECISE = 1e-3
# Errors of a step by the largest vibration of the motion. The estimate sees the fastest modes, which may hardly count: of 71
# rods of the slider-crank with 100 to 1200 steps, estimates up to 3 go with 3 % of the integral of U and 23 % of its peak at
# most, and the stiffest design with 600 steps, 0.1 and 0.7 % off, has 1.04. Above 3 nothing is known of the vibrations.
STEP_ERROR = 3.0
# Of accelerations: vibrations with less than five steps to a period.
ALTERNATION = 0.3
# A motion is possible if no body is so many sizes of the mechanism away, and none moves so far within the duration: there
# rounding of positions is a thousandth of the size. A probe of 5 m that orbits the sun is 3e10 sizes away, and moves by 2e11
# sizes in a year.
FAR = 1e13
# Violation of a joint, as a share of the size of its row, at the end of a motion whose joints could not stay closed.
_OPEN = 1e-4
UNRESOLVED = "unresolved: "


def status_of_lanes(
    history: History, duration: float, statistics: Statistics, sizes: Sizes, failed: Mapping[int, str] | None = None
) -> list[str]:
    """The status of each lane by its numbers and by the statistics of its steps, whose valid times end where it leaves.

    sizes    of coordinates and rates (sizes.py)
    failed   lanes that the integrator gave up, with the reason
    """
    finite, possible, result = _finite(history), _possible(history, duration, sizes), []
    statistics.limit_valid_times(possible)
    for lane in range(finite.shape[1]):
        gap = torch.nonzero(~finite[:, lane])
        if failed and lane in failed:
            result.append(f"failed: {failed[lane]}")
        elif len(gap):
            time = duration * int(gap[0]) / (len(history.q) - 1)
            result.append(f"failed: the motion is not finite from t = {time:.6g} s on")
        elif len(gap := torch.nonzero(~possible[:, lane])):
            time = duration * int(gap[0]) / (len(history.q) - 1)
            result.append(
                f"failed: from t = {time:.6g} s on, a body is {FAR:.0e} times the size of the mechanism away, or moves so far "
                "in the duration. So the motion is probably numerically unstable. Try: more steps, or a smaller load"
            )
        else:
            result.append(_status_of_steps(statistics, lane))
    return result


def _finite(history: History) -> Tensor:
    """True if all numbers of a state are finite [times, lanes]: a sum is where all its terms are, short of overflow."""
    return torch.stack([torch.isfinite(x.sum((1, 2))) for x in (history.q, history.v, history.vd)]).all(0)


def _possible(history: History, duration: float, sizes: Sizes) -> Tensor:
    """True if no body is far beyond the size of the mechanism, or would be at its present rates [times, lanes]."""
    far, speed = ((x[:, :, 0].abs() / s).amax(1) for x, s in ((history.q, sizes.q), (history.v, sizes.v)))
    return (far < FAR) & (duration * speed < FAR)


def _status_of_steps(statistics: Statistics, lane: int) -> str:
    """The status of a finite motion of one lane by the statistics of its steps."""
    s = statistics
    each = (s.iteration_error, s.turn, s.step_error, s.suggested_steps, s.alternation)
    iteration_error, turn, step_error, suggested_steps, alternation = (
        0.0 if x is None else float(x[lane]) for x in each
    )
    if iteration_error > ITERATION_ERROR:
        return (
            f"failed: the iteration of a step did not converge (relative error {iteration_error:.1e}). Try: more steps"
        )
    if turn > TURN:
        return f"failed: a body turns by {turn:.2g} rad in one step, more than {TURN:g} rad. Try: more steps"
    if step_error > STEP_ERROR:
        # Of a stiff body only the gross motion may be of interest, which damped vibrations leave right: the numbers stay.
        return (
            f"{UNRESOLVED}the steps do not resolve the vibrations of a flexible body (estimated error "
            f"{100 * step_error:.0f} % of the largest amplitude), so its energies are inaccurate. Try: "
            f"{suggested_steps:.0f} steps"
        )
    if alternation > ALTERNATION:
        return (
            f"{UNRESOLVED}{100 * alternation:.0f} % of the accelerations change their sign from step to step, because the "
            "steps do not resolve vibrations of a beam. These may grow. Try: more steps, a smaller spectral_radius, or damping "
            "of the beam"
        )
    return OK


def mark_open_joints(status: list[str], problem: InitialValueProblem, result: IntegrationResult) -> None:
    """Set the status of lanes whose joints are open at the end: an iteration may settle beyond a position they cannot pass."""
    dynamics, statistics = problem.dynamics, result.statistics
    error, further = statistics.iteration_error, statistics.further_corrections
    if error is None or further is None or not dynamics.topology.rows:
        return
    doubtful = (error > IMPRECISE) | (further > 0.0)
    lanes = [k for k in torch.nonzero(doubtful)[:, 0].tolist() if k not in dynamics.start_errors]
    lanes = [lane for lane in lanes if not has_failed(status[lane])]
    if not lanes:
        return
    values = replace(dynamics, data=result.data or dynamics.data).values()
    violations = _violations_at_end(values, result.history, problem.duration)
    sizes = row_sizes(dynamics.topology, dynamics.initial.size)[:, 0, 0]
    for lane in lanes:
        rows = problem.rows_at_end(result, lane)
        shares = violations[rows, lane] / sizes[rows]
        if rows and float(shares.max()) > _OPEN:
            number = rows[int(shares.argmax())]
            row, worst = dynamics.topology.row_names[number], float(violations[number, lane])
            status[lane] = (
                f"failed: the joints could not stay closed ({row} is open by {worst:.1e} m or rad at the end)"
            )


def _violations_at_end(dynamics: Dynamics, history: History, duration: float) -> Tensor:
    """Violations |Phi| [rows, lanes] of the constraints of the whole system at the last time."""
    T, q, x = dynamics.topology, history.q[-1:, :, :1], history.expansion
    t = q.new_tensor([duration])
    if x is not None:
        q = x.at_end().rows(0, q)
    at = equations.placement(T, dynamics.data, q[0], T.prescribed(t[0], dynamics.data))
    return equations.constraints(T, at).abs()[:, 0].expand(-1, q.shape[-1])


def mark_unresolved_contacts(status: list[str], contacts: Mapping[int, UnresolvedContact]) -> None:
    """Set the status of lanes with contacts that the steps do not show; lanes that failed keep their reason."""
    for lane, contact in contacts.items():
        if not has_failed(status[lane]):
            status[lane] = f"{'failed: ' if contact.fails else UNRESOLVED}{contact.message}"


def mark_doubts(status: list[str], doubts: Mapping[int, str]) -> None:
    """Set the status of lanes whose events the steps may have missed; others keep theirs."""
    for lane, doubt in doubts.items():
        if status[lane] == OK:
            status[lane] = f"{UNRESOLVED}{doubt}"


def warn_unresolved(status: Sequence[str]) -> None:
    """Warn of lanes that are unresolved, once for each reason."""
    for reason in dict.fromkeys(status):
        if reason.startswith(UNRESOLVED):
            warn(reason.removeprefix(UNRESOLVED))


def validity(history: History, status: Sequence[str], statistics: Statistics) -> Tensor:
    """Of each lane [2, 1, lanes]: how many times have numbers that count, and 1, or 0 where it has failed.

    A tensor, and an output of `Motion`: torch.func.vmap takes it apart as it does the motion.
    """
    failed = torch.tensor([has_failed(x) for x in status])
    before = _finite(history).int().cumprod(0).sum(0)  # times before the first that is not
    before = before.minimum(before if statistics.valid_times is None else statistics.valid_times).clamp_min(0)
    valid = torch.where(failed, before, len(history.q))
    return torch.stack([valid.double(), (~failed).double()])[:, None]
