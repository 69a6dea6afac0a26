"""Segments: the parts of a motion between its switches, one for each phase; a motion without phases is one segment.

    state before --entry--> state --regular steps--> state --exit--> state at the switch

    entry    marks of locks, jump, impact, consistent accelerations (phases/switch.py); of the first one the initial state
    steps    equal ones, of the condensed system of the segment (phases/loop.py)
    exit     a last step, whose size is solved for (phases/loop.py); the last segment has none

Bodies, structure stage and attached vectors are those of one whole system with all joints and all locks; a segment has some
of its constraint rows (`Topology.selected`). Multipliers are those of all rows of the whole.
Segments are made once for a system and a list of phases.
Checked in tests/integrate/phases/test_phase.py, tests/contracts/test_segments.py.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from torch import Tensor

from torchmbd.errors import InputError, unknown
from torchmbd.integrate.phases.events import Event
from torchmbd.integrate.phases.phase import ONE_PHASE, Phase
from torchmbd.multibody.equations.topology import Topology
from torchmbd.multibody.forces.action import Action, Law
from torchmbd.multibody.forces.laws import check_law
from torchmbd.multibody.joints import Drive, Joint
from torchmbd.multibody.joints.joint import AttachmentTable
from torchmbd.multibody.joints.lock import Lock
from torchmbd.multibody.saddle.condensation import Condensation, condense
from torchmbd.multibody.saddle.matrix import Saddle
from torchmbd.multibody.start.initial import InitialConditions
from torchmbd.multibody.system import Dynamics, System

DURATION = "duration of the motion"  # among the data [1, 1], where the motion has a gradient by it
MOST_LISTS = 8  # lists of phases whose segments a system keeps


@dataclass(frozen=True, eq=False)
class Segment:
    """A segment of the motions of one system.

    number            in the list of segments
    topology, saddle  its joints and locks;  rows: its constraint rows among those of the whole
    closing           the joints that close the mechanism before the locks take hold, and their saddle point
    initial           initial conditions of these joints: of the first segment
    condensation      of the joints to the ground; None: nothing is condensed
    """

    number: int
    phase: Phase
    name: str
    topology: Topology
    saddle: Saddle
    rows: list[int]
    locks: list[Lock]
    closing: tuple[Topology, Saddle]
    initial: InitialConditions
    condensation: Condensation | None

    @property
    def time_name(self) -> str:
        """Name, in the data, of its end or its duration, if the motion has a gradient with respect to this time."""
        return f"end of phase {self.name}"

    def has_equations_of(self, other: Segment) -> bool:
        """True if the same rows and laws act in another one, and no lock, which would hold other positions."""
        same_unknowns = Condensation.are_alike(self.condensation, other.condensation)
        if self.rows != other.rows or self.locks or other.locks or not same_unknowns:
            return False
        pairs = zip(self.topology.actions, other.topology.actions, strict=True)
        return all(a is b for x, y in pairs for a, b in zip(x.laws, y.laws, strict=True))

    @property
    def ends_by_event(self) -> bool:
        """True if a function of the motion ends it: of designs and mode shapes as well."""
        return isinstance(self.phase.until, Event)

    @classmethod
    def of(cls, dynamics: Dynamics, phase: Phase, number: int) -> Segment:
        """A segment in which all joints act and none is locked."""
        return cls(
            number=number,
            phase=phase,
            name=phase.name or str(number + 1),
            topology=dynamics.topology,
            saddle=dynamics.saddle,
            rows=list(range(dynamics.topology.rows)),
            locks=[],
            closing=(dynamics.topology, dynamics.saddle),
            initial=dynamics.initial,
            condensation=dynamics.initial.condensed,
        )


def single_segment(dynamics: Dynamics) -> list[Segment]:
    """The segment of a motion without switches."""
    return [Segment.of(dynamics, *ONE_PHASE, 0)]


def keep_equations(segments: Sequence[Segment], whole: Topology) -> bool:
    """True if all joints and laws of the whole system act in every segment."""
    return all(segment.topology is whole for segment in segments)


def actions_of(segments: Sequence[Segment], whole: Topology) -> tuple[tuple[Action, ...], ...]:
    """Applied forces of each segment; none where every one has those of the whole system."""
    return () if keep_equations(segments, whole) else tuple(segment.topology.actions for segment in segments)


def segments_of(system: System, phases: Sequence[Phase], duration: float) -> tuple[System, list[Segment]]:
    """The system with all joints and locks, and its segments; InputError names what a phase cannot have."""
    if not isinstance(phases, (list, tuple)) or not phases or not all(isinstance(phase, Phase) for phase in phases):
        raise InputError("phases", phases, "a list of at least one mbd.Phase")
    check_order(phases, duration)
    names = _names(phases)
    for known, result in system.segments_of_phases:
        if len(known) == len(phases) and all(a is b for a, b in zip(known, phases, strict=True)):
            return result
    if len(phases) > 1 or any(phase.lock or phase.release for phase in phases):
        _check_names(system, names)
    result = _segments(system, phases, names)
    system.segments_of_phases.append((tuple(phases), result))
    del system.segments_of_phases[:-MOST_LISTS]
    return result


def times_of(segments: Sequence[Segment]) -> dict[str, Tensor]:
    """Times of phases that are being differentiated, as data [1, 1]."""
    return {part.time_name: part.phase.time[None, None] for part in segments if part.phase.time is not None}


def _segments(system: System, phases: Sequence[Phase], names: Sequence[str]) -> tuple[System, list[Segment]]:
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
    whole = system.with_joints([*system.joints, *itertools.chain.from_iterable(locks)]) if any(locks) else system
    result: list[Segment] = []
    for k, phase in enumerate(phases):
        acting = {joint.name for joint in system.joints} - {joint.name for joint in released[k]}
        result.append(_segment(whole, k, names[k], phase, acting, locks[k], result))
    return whole, result


def _segment(
    whole: System,
    number: int,
    name: str,
    phase: Phase,
    acting: set[str],
    locks: list[Lock],
    before: Sequence[Segment],
) -> Segment:
    """The segment of a phase in which the joints `acting` and `locks` act."""
    model = whole.equations()
    T = model.topology
    closing_rows = _rows(T, acting)
    if len(closing_rows) == T.rows and not phase.laws:
        return Segment.of(model, phase, number)
    rows = _rows(T, acting | {lock.name for lock in locks})
    actions = _actions_of_phase(whole, name, phase.laws)
    topology = replace(T.selected(rows), actions=actions)
    saddle = Saddle(topology)
    closing = topology, saddle
    if locks:
        of_joints = replace(T.selected(closing_rows), actions=actions)
        closing = of_joints, Saddle(of_joints)
    always = set(rows).intersection(*(segment.rows for segment in before))
    constant = [i for i, row in enumerate(rows) if row in always]
    q = model.initial.q
    return Segment(
        number=number,
        phase=phase,
        name=name,
        topology=topology,
        saddle=saddle,
        rows=rows,
        locks=locks,
        closing=closing,
        initial=replace(model.initial, topology=closing[0]),
        condensation=condense(topology, q, model.initial.size, constant, [lock.name for lock in locks])
        if topology.rows
        else None,
    )


def _check_names(system: System, names: Sequence[str]) -> None:
    """InputError for phases or joints of one name: locks and rows are found by these."""
    for labels, kind in ((names, "phases"), ([joint.name for joint in system.joints], "joints")):
        twice = sorted({name for name in labels if labels.count(name) > 1})
        if twice:
            raise InputError(
                kind,
                allowed="must have unique names with phases",
                state=f"have the names {', '.join(twice)} more than once",
                noun=kind,
            )


def _rows(T: Topology, joints: set[str]) -> list[int]:
    return [i for i, name in enumerate(T.row_joints) if name in joints]


def _actions_of_phase(system: System, phase: str, laws: Mapping[str, Law]) -> tuple[Action, ...]:
    """The actions of the forces, with the laws of a phase instead of those of the named forces."""
    named = {force.name: force for force in system.forces}
    changed = {kind: list(kind.laws) for kind in system.topology.actions}
    of_kind, count = {type(kind): kind for kind in system.topology.actions}, Counter()
    for name, law in laws.items():
        if name not in named:
            raise unknown(f"laws of phase {phase!r}: force", name, named, ("phases", phase, "laws"))
        matches = [force for force in system.forces if force.name == name]
        if len(matches) > 1 or len(list(matches[0].actions(AttachmentTable()))) != 1:
            raise InputError(
                ("phases", phase, "laws"),
                name,
                "must name one force element of a single action",
                state=f"names {name!r}",
                noun=f"laws of phase {phase!r}",
            )
        check_law(f"{name} in phase {phase}", law)
    for force in system.forces:
        for action in force.actions(AttachmentTable()):
            if force.name in laws:
                changed[of_kind[action.kind]][count[action.kind]] = laws[force.name]
            count[action.kind] += 1
    return tuple(replace(kind, laws=tuple(laws_of_kind)) for kind, laws_of_kind in changed.items())


def _names(phases: Sequence[Phase]) -> list[str]:
    return [phase.name or str(i) for i, phase in enumerate(phases, 1)]


def check_order(phases: Sequence[Phase], duration: float) -> None:
    """InputError unless every phase but the last has an end, at increasing times."""
    names = _names(phases)
    for name, phase in zip(names[:-1], phases[:-1], strict=True):
        if phase.until is None and phase.lasting is None:
            raise InputError(
                ("phases", name, "until"),
                allowed="must have until or lasting, because it is not the last",
                noun=f"phase {name!r}",
                state="never ends",
            )
    if phases[-1].until is not None or phases[-1].lasting is not None:
        raise InputError(
            ("phases", names[-1]),
            allowed="must have neither, because it ends with the duration",
            state="is the last phase, but it has until or lasting",
            noun=f"phase {names[-1]!r}",
        )
    times = [0.0, *(p.end_time for p in phases if p.end_time is not None), duration]
    if any(a >= b for a, b in itertools.pairwise(times)):
        allowed, ends = f"increasing times before duration={duration:g} s", times[1:-1]
        raise InputError(("phases", "until"), ends, allowed, noun="until of the phases", shown=f"{ends} s")


def _joints_named(system: System, phase: str, joints: Sequence[Joint | str], argument: str) -> list[Joint]:
    """Joints of the system by name or as they are; InputError names one that the system does not have."""
    named = {joint.name: joint for joint in system.joints}
    result = []
    for x in joints:
        name = x if isinstance(x, str) else x.name
        if name not in named or (isinstance(x, Joint) and named[name] is not x):
            raise unknown(f"{argument} of phase {phase!r}: joint", name, named, ("phases", phase, argument))
        result.append(named[name])
    return result


def _wrong_lock(joint: Joint, released: Sequence[Joint]) -> tuple[str, str] | None:
    """Return what is allowed in place of a lock that no system can have, and what is wrong with it."""
    if joint in released:
        return "must do one of both", f"both locks and releases {joint.name!r}"
    if isinstance(joint, Drive):
        return "must release it and lock its joint", f"locks the drive {joint.name!r}"
    if joint.joints:
        return "must lock one of its joints", f"locks the coupling {joint.name!r}"
    return None


def _check_locks(phase: str, system: System, locked: Sequence[Joint], released: Sequence[Joint]) -> None:
    """InputError for locks that do not go with the other joints of a phase."""
    for joint in locked:
        wrong = _wrong_lock(joint, released)
        if wrong:
            allowed, state = wrong
            raise InputError(("phases", phase, "lock"), joint.name, allowed, state=state, noun=f"phase {phase!r}")
        bodies = {joint.a.body.name, joint.b.body.name}
        for drive in system.joints:
            driven = isinstance(drive, Drive) and {drive.a.body.name, drive.b.body.name} == bodies
            if driven and drive not in released:
                raise InputError(
                    ("phases", phase, "lock"),
                    joint.name,
                    state=f"locks {joint.name!r}, which {drive.name!r} drives",
                    noun=f"phase {phase!r}",
                    hint=f"release={[drive.name]!r} in this phase",
                )
