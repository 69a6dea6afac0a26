"""Phases of a simulation: which joints are locked or released, and what ends them.

    mbd.simulate(system, 3.0, phases=[
        mbd.Phase(until=mbd.Event(angle), lock=["latch_hinge"]),      until the event
        mbd.Phase(until=2.0, release=["spring_hook"]),                until t = 2 s
        mbd.Phase(until=mbd.Event(turn), laws={"motor": second}),     another piece of a law that jumps
        mbd.Phase(),                                                  to the end of the simulation
    ])

The joints of a phase are those of the system without the released ones; a locked joint is held where it is when the
phase begins (multibody/joints/lock.py). segment.py makes a part of the motion of each phase.
A law of a force that jumps, such as eq. (39), is a phase for each of its continuous pieces: its jumps are located, not
smoothed.
Gradients through switches, forward and reverse, are those of the discrete map: of steps, sizes of the last and first step
of a phase, times of events, `until` and `lasting`, jumps. Where a switch passes a point of the grid that map jumps by O(h^2):
gradients are those of one side. One-step methods have both modes (phases/adjoint.py), methods of torchdiffeq forward tangents
only.
Checked in tests/integrate/phases/test_phase.py, tests/sensitivity/test_laws_that_jump.py, test_phase_adjoint.py,
test_phase_times.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.integrate.phases.events import Event
from torchmbd.math.checked_numbers import is_real
from torchmbd.math.gradients import is_differentiated, refuse_gradients, untransformed
from torchmbd.multibody.forces.action import Law
from torchmbd.multibody.joints import Joint


@dataclass(frozen=True)
class Phase:
    """One phase of a simulation.

    until    when it ends: a time [s], or an Event; None: at the end of the simulation (the last phase only)
    lasting  how long it lasts [s], instead of `until`
             (times may be tensors [] that are being differentiated: the motion has gradients with respect to them)
    lock     joints, or their names, that are held where they are when the phase begins
    release  joints, or their names, that do not act
    laws     names of force elements of one action each -> laws that replace theirs
    impact   at the event that ends the phase: the coefficient of restitution of the event's function as a gap,
             from 0 to 1; or a map of the velocities, motion -> [lanes, times, n_v]
    name     for messages; default: its number, from 1

    >>> bob = mbd.RigidBody("bob", 1.0, (0.01, 0.01, 0.01), position=(0, -1, 0))
    >>> hook = mbd.Fixed(mbd.Ground().at(0, -1, 0), bob.at(), name="hook")
    >>> system = mbd.System([bob], [hook], gravity=(0, 0, -9.81))
    >>> phases = [mbd.Phase(until=0.1), mbd.Phase(release=["hook"])]
    >>> motion = mbd.simulate(system, 0.3, steps=30, phases=phases)
    >>> round(mbd.Final(mbd.Position("bob", "z"))(motion).item(), 4)  # a free fall of 0.2 s
    -0.1962
    """

    until: float | Tensor | Event | None = None
    lasting: float | Tensor | None = None
    lock: Sequence[Joint | str] = ()
    release: Sequence[Joint | str] = ()
    laws: Mapping[str, Law] = field(default_factory=dict)
    impact: float | Callable | None = None
    name: str | None = None

    def __post_init__(self) -> None:
        if self.until is not None and self.lasting is not None:
            raise InputError(
                "until",
                self.until,
                "must not be given together",
                state="are both given",
                noun=f"until={self.until!r} and lasting={self.lasting!r}",
            )
        for key in ("until", "lasting"):
            x = getattr(self, key)
            if x is not None and not isinstance(x, Event) and not _positive(x):
                allowed = "a positive time, or an Event" if key == "until" else "a positive time"
                raise InputError(
                    key,
                    x,
                    f"{allowed}, also as a float64 tensor [] that is not a Parameter",
                    noun=f"{key} of a phase",
                    shown=f"{x!r} s" if isinstance(x, (int, float)) else None,
                )
        for key in ("lock", "release"):
            x = getattr(self, key)
            if isinstance(x, str) or not isinstance(x, Sequence) or not all(isinstance(j, (str, Joint)) for j in x):
                raise InputError(key, x, "a list of joints or of their names", noun=f"{key} of a phase")
        if not isinstance(self.laws, Mapping):
            raise InputError("laws", self.laws, "a mapping name of a force element -> law", noun="laws of a phase")
        if self.name is not None and not isinstance(self.name, str):
            raise InputError("name", self.name, "a string", noun="name of a phase")
        if self.impact is not None and not isinstance(self.until, Event):
            raise InputError(
                "impact",
                allowed="given with until=mbd.Event(gap), because an impact happens at an event",
                noun="impact of a phase",
                state=f"is given, but until={self.until!r}",
            )
        refuse_gradients("impact", self.impact, "a number, or a map of the velocities")
        number = is_real(self.impact) and 0.0 <= float(self.impact) <= 1.0  # pyright: ignore[reportArgumentType]
        if self.impact is not None and not callable(self.impact) and not number:
            raise InputError("impact", self.impact, "0 to 1, or a map of the velocities", noun="impact of a phase")

    @property
    def end_time(self) -> float | None:
        """`until` as a number [s]; None where it is an event, or none."""
        return None if self.until is None or isinstance(self.until, Event) else _number(self.until)

    @property
    def length(self) -> float | None:
        """`lasting` as a number [s]."""
        return None if self.lasting is None else _number(self.lasting)

    @property
    def time(self) -> Tensor | None:
        """`until` or `lasting` where it is a tensor that is being differentiated."""
        x = self.until if self.lasting is None else self.lasting
        return x if isinstance(x, Tensor) and is_differentiated(x) else None


ONE_PHASE = (Phase(),)  # of a motion without switches: all joints and laws of the system act throughout


def _number(x: float | Tensor) -> float:
    return untransformed(x).item() if isinstance(x, Tensor) else float(x)


def _positive(x: Any) -> bool:
    if isinstance(x, Tensor):
        # A Parameter would be taken for a design variable: those of a phase are none of the system's.
        number = x.dtype == torch.float64 and not untransformed(x).dim() and not isinstance(x, torch.nn.Parameter)
        x = _number(x) if number else math.nan
    return isinstance(x, (int, float)) and not isinstance(x, bool) and 0.0 < x < math.inf
