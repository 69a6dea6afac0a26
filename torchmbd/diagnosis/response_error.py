"""Errors of responses: the same motion with finer steps, with Richardson's extrapolation, and with more modes.

    by_steps = (v_half - v) r^2 / (r^2 - 1)     of methods of second order: v = true + c h^2 + ..., with r times the steps
                                                v_half = true + c h^2/r^2 + ...
    by_steps = v_tight - v          of adaptive methods: tolerances a hundredth, twice the outputs
    by_modes = v_richer - v         flexible bodies with half as many vibration modes again (bodies/refinement.py)
    by_mesh = (v_finer - v) 4/3     flexible bodies with twice as many cells in each direction (bodies/refinement.py)

Half of a step is a little less: r n steps share no factor with n, r = 2.3 or a little more. A load whose period divides a step
of one motion takes one value in all of its steps, and others in those of the other motion. Factors of four are those of r = 2.

Two coarse motions may agree by chance. Where they differ by more than a thousandth, a motion with twice the step must agree
with them to a tenth, or show that the error falls as it should: by four, accepted from two to eight; of tolerances, at least
by two. Where it does not, where the two differ by more than a tenth, or the status of the lane is not "ok", a motion with a
quarter of the step decides in the same way. Differences are shares of the response's size (`Measure.size`), which neither
another origin nor a constant part changes.
Source: Richardson, Phil. Trans. R. Soc. A 210 (1911) 307-357.
Checked in tests/diagnosis/test_response_errors.py, tests/diagnosis/test_errors_of_motions.py.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError, SimulationFailure
from torchmbd.multibody.bodies.refinement import has_reduction, obstacle
from torchmbd.results.motion_data import OK, has_failed
from torchmbd.results.response_error import ResponseError, rows_of
from torchmbd.results.trajectory import Repeated, Trajectory

_LARGE = 0.1  # of the size: differences that need a motion with a quarter of the step
SMALL = 1e-3  # of the size: one of a thousand pairs of motions by unresolved steps agrees so well by chance
_ROUNDING = 1e-10  # of the value: differences that are rounding and the residuals of Newton's iterations
_OF_MESH = 4.0 / 3.0  # elements of second order
_BLIND = 0.5  # of the reduction of the error by half the step: below it, both motions with longer steps miss something
_LEAST, _MOST = 2.0, 8.0  # of the reduction of the error by half the step; four for second order
_FALL = 4.0  # of the error by half the step, of methods of second order
_INSTANTS = 8  # of a motion, at which a function of it is compared with its value


def response_error(
    motion: Trajectory,
    response: Callable[[Any], Tensor],
    modes: bool = True,
    mesh: bool = True,
    enough: float = 0.0,
    least: Callable[[Tensor], Tensor] = torch.zeros_like,
) -> ResponseError:
    """The errors of a response of a motion; InputError for what has no estimate by steps.

    enough   error by steps, as a share of the size or of `least`, that is resolved without a look at a third motion
    least    least size of a number; a function of the value returns it, of the shape of the value
    """
    if not callable(response):
        raise InputError("response", response, "a measure, such as mbd.Max(...)")
    again = motion.require_repetition()
    with torch.no_grad():
        value = _numbers(response, motion)
        if hasattr(response, "size") and hasattr(response, "change"):
            size, change = response.size(motion), response.change(motion).abs()  # pyright: ignore[reportAttributeAccessIssue]
        else:
            size = change = change_by_motion(response, motion)
        # The range of a constant is rounding: no differences are judged by less than the rounding of the value.
        size = size.maximum(least(value)).maximum(_ROUNDING * value.abs())
        by_steps, reasons = _by_steps(motion, again, response, value, size, enough * size)
        by_modes, lacks, by_mesh, misses = None, "", None, ""
        if modes:
            fixed = _without_reduction(motion)
            by_modes, lacks = _by_bodies(response, value, lambda: again.richer(motion), "more modes", fixed)
        if mesh:
            fixed = _without_finer_mesh(motion)
            by_mesh, misses = _by_bodies(
                response, value, lambda: again.with_finer_meshes(motion), "a finer mesh", fixed
            )
            by_mesh = None if by_mesh is None else by_mesh * _OF_MESH
        unknown = tuple(f"{name}: {why}" for name, why in (("by_modes", lacks), ("by_mesh", misses)) if why)
    resolved = torch.tensor([not reason for reason in reasons])
    note = "; ".join(dict.fromkeys(_notes(response)))
    return ResponseError(
        repr(response), value, size, change, by_steps, resolved, tuple(reasons), note, by_modes, by_mesh, unknown
    )


def change_by_motion(response: Callable[[Any], Tensor], motion: Any) -> Tensor:
    """The largest difference of a function of a motion from its numbers where the machine rests at some of the times."""
    value, last = _numbers(response, motion), len(motion.t) - 1
    change = torch.zeros_like(value)
    for index in sorted({round(k * last / _INSTANTS) for k in range(_INSTANTS + 1)}):
        change = torch.fmax(change, (value - _numbers(response, motion.at_rest(index))).abs())
    return change


def _by_steps(
    motion: Trajectory, again: Repeated, response: Any, value: Tensor, size: Tensor, enough: Tensor
) -> tuple[Tensor, list[str]]:
    """Error by the steps, and why lanes are not resolved; errors up to `enough`, of the shape of the value, are.

    size   what differences are compared with, of the same shape
    """
    half = again.finer(2)
    order, finer = again.order, _numbers(response, half)
    if finer.shape != value.shape:
        raise InputError(
            "response",
            response,
            allowed="must return as many numbers for every number of steps, such as mbd.Max(...) of a history",
            noun=f"response {response!r}",
            state=f"returns a shape {list(value.shape)}, and with smaller steps {list(finer.shape)}",
        )
    by_half = _remainder(again, half, order)
    first, rounding = finer - value, _ROUNDING * value.abs().maximum(finer.abs())
    error = first / (1.0 - by_half)
    sound = torch.tensor([status == OK for status in motion.status])
    certain = sound & _all(first.abs() <= (_LARGE * size).maximum(rounding))
    believed = certain & _all(first.abs() <= (SMALL * size).maximum(rounding)) | sound & _all(error.abs() <= enough)
    if order and not believed[certain].all():
        believed |= certain & _confirmed(again, response, value, error, size)
    doubtful = ~believed if order else ~certain
    reasons = [""] * motion.lanes
    if doubtful.any():
        quarter = again.finer(4)
        finest = _numbers(response, quarter)
        second, by_quarter = finest - finer, _remainder(again, quarter, order)
        ratio = first / second
        if order:
            better = first + second * by_half / (by_half - by_quarter)
            ratio = _FALL * ratio * (by_half - by_quarter) / (1.0 - by_half)
        else:
            better = first + second
        error = torch.where(_wide(doubtful, value), better, error)
        falls = (ratio >= _LEAST) & (ratio <= _MOST) if order else ratio.abs() >= _LEAST
        falls |= first.abs() <= rounding
        agree = (first.abs() <= _LARGE * size) & (second.abs() <= _LARGE * size) & _wide(sound, value)
        falls = rows_of(falls | agree)
        for lane in doubtful.nonzero().flatten().tolist():
            reasons[lane] = _reason([m.status[lane] for m in (half, quarter)], falls[lane], rows_of(ratio)[lane])
    for lane in range(motion.lanes):
        if not reasons[lane] and not error[lane].isfinite().all():
            reasons[lane] = "the response has no number, here or with finer steps"
    return error, reasons


def _remainder(again: Repeated, finer: Trajectory, order: int | None) -> float:
    """Share of the error of a motion that finer steps leave; 0 of adaptive methods."""
    return (again.steps / finer.require_repetition().steps) ** order if order else 0.0


def _confirmed(again: Repeated, response: Any, value: Tensor, error: Tensor, size: Tensor) -> Tensor:
    """True if a motion with twice the step says that values with this step and half of it do not agree by chance [lanes]."""
    coarse = again.coarser()
    if coarse is None:
        return torch.zeros(len(value), dtype=torch.bool)
    before = value - _numbers(response, coarse)
    ratio = _FALL / (_FALL - 1.0) * before / error
    # Motions of n and n / 2 steps may show one value of a load, which that of r n steps does not: then they agree too well.
    agree = (before.abs() <= _LARGE * size) & (ratio.abs() >= _BLIND)
    return _all(agree | (ratio >= _LEAST) & (ratio <= _MOST))


def _by_bodies(
    response: Any, value: Tensor, simulate: Callable[[], Any], change: str, fixed: list[str]
) -> tuple[Tensor | None, str]:
    """Change of a response by a change of the flexible bodies, or None; and what it lacks.

    simulate   the motion with this change; None: no body has it
    fixed      why some bodies do not have it
    """
    lacks = "; ".join(fixed)
    try:
        other = simulate()
        numbers = value if other is None else _numbers(response, other)
    except (InputError, SimulationFailure) as error:
        return None, str(error)
    if other is None:
        return None if fixed else torch.zeros_like(value), lacks
    if numbers.shape != value.shape:
        return None, f"the response has numbers {list(value.shape)}, with {change} {list(numbers.shape)}"
    failed = [f"with {change} the motion is {status}" for status in other.status if has_failed(status)]
    return numbers - value, "; ".join([*fixed, *failed[:1]])


def _without_reduction(motion: Any) -> list[str]:
    return [
        f"modes of {body.name!r} were given, and there are no others"
        for body in _flexible(motion)
        if not has_reduction(body)
    ]


def _without_finer_mesh(motion: Any) -> list[str]:
    beams = [f"{beam.name!r} is not refined: it is an exact beam" for beam in motion.system.beams]
    obstacles = {body.name: obstacle(body) for body in _flexible(motion)}
    return beams + [f"{name!r} is not refined: {why}" for name, why in obstacles.items() if why]


def _flexible(motion: Any) -> list[Any]:
    T = motion.dynamics.topology
    return [motion.system.body(name) for name in T.names[: T.flexible]]


def _all(x: Tensor) -> Tensor:
    return rows_of(x).all(1)


def _wide(lanes: Tensor, x: Tensor) -> Tensor:
    """Values [lanes] for all numbers of x [lanes, ...]."""
    return lanes.reshape(-1, *[1] * (x.ndim - 1))


def _numbers(response: Callable[[Any], Tensor], motion: Any) -> Tensor:
    x = response(motion)
    if not isinstance(x, Tensor) or not x.ndim or len(x) != motion.lanes:
        raise InputError(
            "response",
            allowed="must return a tensor [lanes] or [lanes, rows]",
            state=f"returns {x!r}",
            noun=f"response {response!r}",
        )
    return x.detach()


def _notes(response: Any) -> list[str]:
    """What the estimates of a measure and of the measures that it combines are worth."""
    notes = [str(getattr(response, "error_note", ""))]
    return [note for note in notes if note] + [n for part in getattr(response, "operands", ()) for n in _notes(part)]


def _reason(statuses: list[str], falls: Tensor, ratio: Tensor) -> str:
    """Why a lane with a large difference is not resolved; "" where the third motion confirms the estimate."""
    failed = next((status for status in statuses if status != OK), None)
    if failed is not None:
        return f"with finer steps the motion is {failed}"
    if falls.all():
        return ""
    worst = ratio[~falls][0].item()
    return f"half the step divides the error by {worst:.2g}, but by about 4 if the steps are small enough"
