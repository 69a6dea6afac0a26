"""Laws of time that jump: where they do, and warnings where no step ends there (why one should: integrate/held_times.py).

Functions of users are sampled (math/jumps.py), once for an element with its parameters and a duration; a warning names jumps.
Held values of controllers have a warning where no number of steps ends at their jumps.
Checked in tests/diagnosis/test_jumps.py.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor, nn

from torchmbd.errors import InputError, Path, user_line, warn
from torchmbd.integrate.held_times import MOST, SAME, held_times, steps_at, substeps_at, within_phases
from torchmbd.integrate.integrator import Integrator
from torchmbd.integrate.ode import ADAPTIVE
from torchmbd.integrate.phases.phase import Phase
from torchmbd.math.forward_mode import jvp
from torchmbd.math.jumps import distinct, jump_times
from torchmbd.math.module_call import outside_transforms
from torchmbd.math.torch_law import OUT_OF_RANGE
from torchmbd.multibody.forces.controller import Controller
from torchmbd.multibody.forces.parametric_law import is_library_law
from torchmbd.multibody.forces.signals import Time
from torchmbd.multibody.joints import Drive
from torchmbd.multibody.joints.joint import AttachmentTable
from torchmbd.multibody.joints.laws import ConstantSpeed, Sine, SmoothStep

_SHOWN = 3  # times in a message

# Element -> duration -> its numbers, and times of its jumps.
_known: WeakKeyDictionary[Any, dict[float, tuple[list[bytes], list[float]]]] = WeakKeyDictionary()


def warn_of_jumps(
    system: Any,
    duration: float,
    steps: int | None,
    integrator: Integrator,
    phases: Sequence[Phase],
) -> None:
    """Warn of laws that jump where no step ends, or whose value at a jump is that of one side.

    Methods that choose their own steps find jumps of forces themselves.
    """
    with torch.no_grad():
        for joint in system.joints:
            if isinstance(joint, Drive):
                _warn_of_drive(joint, duration)
        if integrator.name in ADAPTIVE:
            return
        controllers = [
            x for x in system.forces if isinstance(x, Controller) and any(isinstance(y, Time) for y in x.inputs)
        ]
        held = distinct((t for x in controllers for t in held_times(x.control, duration)), duration)
        count = steps or steps_at(held, duration)
        divides = integrator.refines and count and substeps_at(within_phases(held, phases, duration), duration, count)
        for force in controllers:
            if not divides:
                _warn_of_held(force, duration, steps, count, phases)
            _warn_of_module(force, duration)
        for name, times in _jumps_of_laws(system, duration, phases):
            _warn_of_force(name, times)


def _jumps_of_laws(system: Any, duration: float, phases: Sequence[Phase]) -> Iterator[tuple[str, list[float]]]:
    """Name and jumps of each law of a force but controllers, of the system and of its phases, where it acts."""
    for force in system.forces:
        if not isinstance(force, Controller):
            times = _jumps_of_force(force, duration)
            yield force.name, [t for t in times if _acts(force.name, phases, t)]
    for number, phase in enumerate(phases):
        for name, law in phase.laws.items():
            of_time = [] if is_library_law(law) else [_at_a_state(law)]
            times = _sampled((name, "law"), of_time, duration)
            yield name, [t for t in times if _within(phases, number, t)]


def _jumps(
    path: Path, element: Any, functions: Callable[[], list], duration: float, without: Sequence[float] = ()
) -> list[float]:
    """Times of the jumps of an element's functions of time, sampled once for a duration; path: the keys to their law."""
    known, numbers = _known.setdefault(element, {}), _numbers(element)
    if duration not in known or known[duration][0] != numbers:
        known[duration] = numbers, _sampled(path, functions(), duration, without)
    return known[duration][1]


def _numbers(element: Any) -> list[bytes]:
    """Values of parameters and buffers of an element, which may move its jumps."""
    modules = (getattr(element, "module", None), getattr(element.variables, "module", None))
    states = (x for m in modules if isinstance(m, nn.Module) for x in (*m.parameters(), *m.buffers()))
    return outside_transforms(lambda *x: [y.detach().numpy().tobytes() for y in x], *states)


def _sampled(
    path: Path, functions: Sequence[Callable[[Tensor], Tensor]], duration: float, without: Sequence[float] = ()
) -> list[float]:
    """Times of the jumps of functions of time; none of a law that ends before: the motion need not come to this state or time.

    InputError names a law that raises anything else.
    """
    times: list[float] = []
    for f in functions:
        try:
            times += jump_times(f, duration, without)
        except InputError:
            raise
        except OUT_OF_RANGE:
            continue
        except Exception as error:  # a function of users may raise any error
            allowed = "a torch function of all states and times, or one that raises a ValueError or an IndexError where it ends"
            state = f"raises {error!r} in {user_line(error)} for some time from 0 to {duration:.6g} s"
            raise InputError(path, f, allowed, state=state) from error
    return distinct(times, duration)


def _jumps_of_force(force: Any, duration: float) -> list[float]:
    """Of those of its laws that are functions of a user."""

    def functions() -> list[Callable[[Tensor], Tensor]]:
        laws = [action.law for action in force.actions(AttachmentTable())]
        return [_at_a_state(law) for law in laws if not is_library_law(law)]

    return _jumps((force.name, "law"), force, functions, duration)


def _jumps_of_module(force: Controller, duration: float) -> list[float]:
    """Of a controller, its inputs but the time fixed in general position; without those of held values."""

    def functions() -> list[Callable[[Tensor], Tensor]]:
        clock = torch.cat([torch.full((x.size,), isinstance(x, Time)) for x in force.inputs])
        rest = 0.1 + 0.37 * torch.arange(len(clock), dtype=torch.float64).cos()
        return [lambda t: force.module(torch.where(clock, t, rest)[None])[0]]

    return _jumps((force.name, "module"), force, functions, duration, held_times(force.control, duration))


@torch.no_grad()
def refuse_jumps(system: Any, duration: float, phases: Sequence[Phase]) -> None:
    """InputError names the first law that jumps in time, in a motion that is differentiated by its duration: steps move with
    the duration, jumps do not; the derivative of the steps would move both.

    It looks at the laws of forces, in the system and in its phases, and at the laws of drives with their rates.
    """
    controllers = [x for x in system.forces if isinstance(x, Controller)]
    of_laws = [
        *((x.name, held_times(x.control, duration) or _jumps_of_module(x, duration)) for x in controllers),
        *_jumps_of_laws(system, duration, phases),
        *((x.name, _jumps_of_drive(x, duration)) for x in system.joints if isinstance(x, Drive)),
    ]
    for name, times in of_laws:
        if times:
            raise InputError(
                "duration",
                allowed="given without a gradient, or with a law that does not jump",
                state=f"cannot be differentiated, because the law of {name!r} jumps at {_shown(times)}",
            )


def _at_a_state(law: Any) -> Callable[[Tensor], Tensor]:
    """A law f(s, s', t) as a function of time, at some s and s' in general position."""
    s = torch.full((1, 1, 1), 0.37, dtype=torch.float64)
    return lambda t: law(s + getattr(law, "center", 0.0), 0.8 * s, t)[0, 0]


def _warn_of_force(name: str, times: Sequence[float]) -> None:
    if times:
        t = times[0]
        warn(
            f"the law of {name!r} jumps at {_shown(times)}. A step evaluates the law at its ends, so the force acts up to "
            "half a step early or late, and the error is of first order in the step. Try: one law for each phase, "
            f"phases=[mbd.Phase(until={t:.6g}, laws={{{name!r}: first}}), mbd.Phase(laws={{{name!r}: second}})], for a "
            'force along one axis; or a Controller with mbd.ControlHistory(..., kind="hold"); or method="dopri5"'
        )


def _acts(name: str, phases: Sequence[Phase], t: float) -> bool:
    """True if the law that a force has in the system acts at time t."""
    return any(name not in phase.laws and _within(phases, k, t) for k, phase in enumerate(phases))


def _within(phases: Sequence[Phase], number: int, t: float) -> bool:
    """True if a phase may last to, or from, time t: where it begins and ends is known of times, not of events."""
    begin: float | None = 0.0
    for k, phase in enumerate(phases):
        end = phase.end_time
        if phase.length is not None and begin is not None:
            end = begin + phase.length
        if k == number:
            after = begin is None or t >= begin * (1.0 + SAME)  # a law that changes where it begins has its new value
            return after and (end is None or t <= end * (1.0 + SAME))
        begin = end
    return False


def _warn_of_held(
    force: Controller, duration: float, steps: int | None, count: int | None, phases: Sequence[Phase]
) -> None:
    """Of held values whose changes are not ends of the steps, a multiple of `count`; None: of no number of steps."""
    held = held_times(force.control, duration)
    within = within_phases(held, phases, duration)
    fitting = steps_at(within, duration)
    if within and (count is None or fitting is None or count % fitting):
        fit = (
            f"steps, a multiple of {fitting}"
            if fitting
            else "a duration in a simple ratio to the duration of the values"
        )
        allowed = f"{fit}, or no steps" if fitting else fit
        warn(
            f"values of the controller {force.name!r} change at {_shown(within)}, where none of "
            f"{f'{steps} steps' if steps else f'up to {MOST} steps'} ends. So the values act up to half a step early or late, "
            f'and the error is of first order in the step. Try: {allowed}, or method="dopri5"'
        )


def _warn_of_module(force: Controller, duration: float) -> None:
    times = _jumps_of_module(force, duration)
    if times:
        warn(
            f"the module of the controller {force.name!r} jumps at {_shown(times)}. A step evaluates the module at its ends, "
            "so it acts up to half a step early or late, and the error is of first order in the step. Try: a module that does "
            'not jump in time, with mbd.ControlHistory(..., kind="hold") for the jumps, or method="dopri5"'
        )


def _jumps_of_drive(drive: Drive, duration: float) -> list[float]:
    """Times at which a prescribed position or rate jumps; a whole turn is not a jump."""
    law = drive.law.law
    if isinstance(law, (ConstantSpeed, SmoothStep, Sine)):
        return []

    def of_time(t: Tensor) -> Tensor:
        x, rate = jvp(law, (t,), (torch.ones_like(t),))[:2]
        return torch.stack([x, rate] if drive.travels else [x.cos(), x.sin(), rate])

    return _jumps((drive.name, "law"), drive, lambda: [of_time], duration)


def _warn_of_drive(drive: Drive, duration: float) -> None:
    times = _jumps_of_drive(drive, duration)
    if times:
        warn(
            f"the law of the drive {drive.name!r}, or its rate, jumps at {_shown(times)}. This is an impact, so the forces "
            "there increase with the number of steps. Try: a law with a continuous rate, such as mbd.SmoothStep, or "
            f"mbd.Phase(until={times[0]:.6g}) before a phase with another drive"
        )


def _shown(times: Sequence[float]) -> str:
    more = f" and {len(times) - _SHOWN} more times" if len(times) > _SHOWN else ""
    return "t = " + ", ".join(f"{t:.6g}" for t in times[:_SHOWN]) + f" s{more}"
