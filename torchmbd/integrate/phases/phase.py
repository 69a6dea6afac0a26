"""Phases of a simulation: which joints are locked or released, and what ends them.

    mbd.simulate(system, 3.0, phases=[
        mbd.Phase(until=mbd.Event(angle), lock=["latch_hinge"]),      until the event
        mbd.Phase(until=2.0, release=["spring_hook"]),                until t = 2 s
        mbd.Phase(until=mbd.Event(turn), laws={"motor": second}),     another piece of a law that jumps
        mbd.Phase(),                                                  to the end of the simulation
    ])

The joints of a phase are those of the system without the released ones; a locked joint is held where it is when the
phase begins (multibody/joints/lock.py). Bodies, structure stage and attached vectors are those of one whole system with all
joints and all locks; a phase has some of its constraint rows (multibody/system/selection.py). Multipliers are those of all
rows of the whole.
A law of a force that jumps, such as eq. (39), is a phase for each of its continuous pieces: its jumps are located, not
smoothed.
Gradients through switches, forward and reverse, are those of the discrete map: of steps, sizes of the last and first step
of a phase, times of events, jumps. Where a switch passes a point of the grid that map jumps by O(h^2): gradients are those of
one side. One-step methods have both modes (adjoint.py), methods of torchdiffeq forward tangents only.
Checked in tests/integrate/phases/test_phase.py, tests/sensitivity/test_laws_that_jump.py, test_phase_adjoint.py.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from torchmbd.errors import InputError, unknown
from torchmbd.integrate.phases.events import Event
from torchmbd.math.checked_numbers import is_real
from torchmbd.math.gradients import refuse_lost_gradients
from torchmbd.multibody.forces.action import Action, Law
from torchmbd.multibody.forces.laws import check_law
from torchmbd.multibody.joints import Drive, Joint
from torchmbd.multibody.joints.joint import AttachmentTable
from torchmbd.multibody.joints.lock import Lock
from torchmbd.multibody.system import System
from torchmbd.multibody.system.saddle import Saddle
from torchmbd.multibody.system.selection import selected
from torchmbd.multibody.system.topology import Topology


@dataclass(frozen=True)
class Phase:
    """One phase of a simulation.

    until    when it ends: a time [s], or an Event; None: with the simulation (the last phase only)
    lasting  how long it lasts [s], instead of `until`
    lock     joints, or their names, that are held where they are when the phase begins
    release  joints, or their names, that do not act
    laws     names of force elements of one action each -> laws that act in their places
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

    until: float | Event | None = None
    lasting: float | None = None
    lock: Sequence[Joint | str] = ()
    release: Sequence[Joint | str] = ()
    laws: Mapping[str, Law] = field(default_factory=dict)
    impact: float | Callable | None = None
    name: str | None = None

    def __post_init__(self) -> None:
        if self.until is not None and self.lasting is not None:
            raise InputError(f"until={self.until!r} and lasting={self.lasting!r} are both given; allowed: one of them")
        for key in ("until", "lasting"):
            x = getattr(self, key)
            if x is not None and not isinstance(x, Event) and not _positive(x):
                allowed = "a positive time, or an Event" if key == "until" else "a positive time"
                raise InputError(f"{key} of a phase is {x!r} s; allowed: {allowed}")
        for key in ("lock", "release"):
            x = getattr(self, key)
            if isinstance(x, str) or not isinstance(x, Sequence) or not all(isinstance(j, (str, Joint)) for j in x):
                raise InputError(f"{key} of a phase is {x!r}; allowed: a list of joints or of their names")
        if not isinstance(self.laws, Mapping):
            raise InputError(f"laws of a phase is {self.laws!r}; allowed: names of force elements -> laws")
        if self.name is not None and not isinstance(self.name, str):
            raise InputError(f"name of a phase is {self.name!r}; allowed: a string")
        if self.impact is not None and not isinstance(self.until, Event):
            raise InputError(f"impact of a phase is given, but until={self.until!r}; allowed: an Event, its gap")
        refuse_lost_gradients("impact of a phase", self.impact, "constant tensors")
        number = is_real(self.impact) and 0.0 <= float(self.impact) <= 1.0  # pyright: ignore[reportArgumentType]
        if self.impact is not None and not callable(self.impact) and not number:
            raise InputError(f"impact of a phase is {self.impact!r}; allowed: from 0 to 1, or a map of the velocities")


def _positive(x: Any) -> bool:
    return isinstance(x, (int, float)) and not isinstance(x, bool) and 0.0 < x < math.inf


@dataclass(frozen=True, eq=False)
class PhaseModel:
    """A phase of one system.

    topology, saddle  its joints and locks;  rows: its constraint rows among those of the whole
    start             rows of the joints that close the mechanism before the locks take hold
    """

    phase: Phase
    name: str
    topology: Topology
    saddle: Saddle
    rows: list[int]
    start: list[int]
    locks: list[Lock]
    row_names: tuple[str, ...]


def plan(system: System, phases: Sequence[Phase], duration: float) -> tuple[System, list[PhaseModel]]:
    """The system with all joints and locks, and its phases; InputError names what a phase cannot have."""
    if not isinstance(phases, (list, tuple)) or not phases or not all(isinstance(phase, Phase) for phase in phases):
        raise InputError(f"phases is {phases!r}; allowed: a list of at least one mbd.Phase")
    names = [phase.name or str(i) for i, phase in enumerate(phases, 1)]
    joints = [joint.name for joint in system.joints]
    for labels, kind in ((names, "phases"), (joints, "joints")):
        twice = sorted({name for name in labels if labels.count(name) > 1})
        if twice:
            raise InputError(
                f"{kind} have the names {', '.join(twice)} more than once; allowed with phases: unique names"
            )
    _check_order(phases, names, duration)
    locked = [_joints_named(system, name, phase.lock, "lock") for name, phase in zip(names, phases, strict=True)]
    released = [
        _joints_named(system, name, phase.release, "release") for name, phase in zip(names, phases, strict=True)
    ]
    for name, locked_joints, released_joints in zip(names, locked, released, strict=True):
        _check_locks(name, system, locked_joints, released_joints)
    locks = [
        [Lock(joint, f"lock of {joint.name} in phase {name}") for joint in joints_of_phase]
        for name, joints_of_phase in zip(names, locked, strict=True)
    ]
    whole = system.with_joints([*system.joints, *itertools.chain.from_iterable(locks)])
    phase_models = []
    for k, phase in enumerate(phases):
        closing = {joint.name for joint in system.joints} - {joint.name for joint in released[k]}
        rows = _rows(whole.topology, closing | {lock.name for lock in locks[k]})
        closing_rows = _rows(whole.topology, closing)
        topology = replace(selected(whole.topology, rows), actions=_actions_of_phase(whole, names[k], phase.laws))
        phase_models.append(
            PhaseModel(
                phase, names[k], topology, Saddle(topology), rows, closing_rows, locks[k], whole.topology.row_names
            )
        )
    return whole, phase_models


def _rows(T: Topology, joints: set[str]) -> list[int]:
    return [i for i, name in enumerate(T.row_joints) if name in joints]


def _actions_of_phase(system: System, phase: str, laws: Mapping[str, Law]) -> tuple[Action, ...]:
    """The actions of the forces, with the laws of a phase instead of those of the named forces."""
    named = {force.name: force for force in system.forces}
    changed = {kind: list(kind.laws) for kind in system.topology.actions}
    of_kind, count = {type(kind): kind for kind in system.topology.actions}, Counter()
    for name, law in laws.items():
        if name not in named:
            raise unknown(f"in laws of phase {phase!r} the force", name, named)
        own = [force for force in system.forces if force.name == name]
        if len(own) > 1 or len(list(own[0].actions(AttachmentTable()))) != 1:
            raise InputError(f"laws of phase {phase!r} names {name!r}; allowed: one force element of a single action")
        check_law(f"{name} in phase {phase}", law)
    for force in system.forces:
        for action in force.actions(AttachmentTable()):
            if force.name in laws:
                changed[of_kind[action.kind]][count[action.kind]] = laws[force.name]
            count[action.kind] += 1
    return tuple(replace(kind, laws=tuple(laws_of_kind)) for kind, laws_of_kind in changed.items())


def _check_order(phases: Sequence[Phase], names: Sequence[str], duration: float) -> None:
    """InputError unless every phase but the last has an end, at increasing times."""
    for name, phase in zip(names[:-1], phases[:-1], strict=True):
        if phase.until is None and phase.lasting is None:
            raise InputError(f"phase {name!r} never ends; allowed: until or lasting for every phase but the last")
    if phases[-1].until is not None or phases[-1].lasting is not None:
        raise InputError(
            f"phase {names[-1]!r} is the last and has an end of its own; allowed: the last phase lasts until the "
            f"duration of the simulation (add mbd.Phase() after it)"
        )
    times = [0.0, *(p.until for p in phases if isinstance(p.until, (int, float))), duration]
    if any(a >= b for a, b in itertools.pairwise(times)):
        raise InputError(
            f"until of the phases is {times[1:-1]} s; allowed: increasing times before duration={duration:g} s"
        )


def _joints_named(system: System, phase: str, joints: Sequence[Joint | str], argument: str) -> list[Joint]:
    """Joints of the system by name or as they are; InputError names one that the system does not have."""
    named = {joint.name: joint for joint in system.joints}
    result = []
    for x in joints:
        name = x if isinstance(x, str) else x.name
        if name not in named or (isinstance(x, Joint) and named[name] is not x):
            raise unknown(f"in {argument} of phase {phase!r} the joint", name, named)
        result.append(named[name])
    return result


def _check_locks(phase: str, system: System, locked: Sequence[Joint], released: Sequence[Joint]) -> None:
    """InputError for locks that do not go with the other joints of a phase."""
    for joint in locked:
        if joint in released:
            raise InputError(f"phase {phase!r} both locks and releases {joint.name!r}; allowed: one of them")
        if isinstance(joint, Drive):
            raise InputError(f"phase {phase!r} locks the drive {joint.name!r}; allowed: release it, lock its joint")
        bodies = {joint.a.body.name, joint.b.body.name}
        for drive in system.joints:
            driven = isinstance(drive, Drive) and {drive.a.body.name, drive.b.body.name} == bodies
            if driven and drive not in released:
                raise InputError(
                    f"phase {phase!r} locks {joint.name!r}, which {drive.name!r} drives; "
                    f"allowed: release={[drive.name]!r} in this phase"
                )
