"""Description of a system: `system.describe()` prints bodies, joints, rank, degrees of freedom, mass and first frequencies.

    freedoms = 6 bodies + modes - rank of Phi_q          mobility = 6 bodies - rank of Phi_q by the rigid coordinates

at the assembled initial position; what assembling moves is listed (closing.py). Frequencies are those of small vibrations about
it, which is taken for an equilibrium; bodies that nothing ties to the ground fall, and vibrate as without gravity. A mechanism
that no rigid displacement closes is described where the bodies were put, without vibrations.
Checked in tests/multibody/system/test_description.py.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import torch

from torchmbd.errors import InputError
from torchmbd.math.pair import value
from torchmbd.multibody.bodies.rigid import Ground
from torchmbd.multibody.equilibrium.equilibrium import vibrations
from torchmbd.multibody.joints.joint import AttachmentTable
from torchmbd.multibody.saddle.rank import Rank, jacobians, rank_of, rank_of_columns
from torchmbd.multibody.start.closing import Closing
from torchmbd.multibody.start.initial import DoesNotClose

_SHOWN = 6  # frequencies in the table


@dataclass(frozen=True)
class Entry:
    """A line of a table: name, kind, and numbers by their title."""

    name: str
    kind: str
    numbers: dict[str, Any]


@dataclass(frozen=True)
class Description:
    """Of the first design of a system. mass [kg]; frequencies [Hz], nan where the position is unstable.

    redundant    rows ("joint: row") that follow from others
    separate     groups of bodies that no joint ties to the ground
    repeated     joints whose equations another joint before them has
    closing      joints that are open where the bodies were put, and bodies that the start moves
    closes       False: no rigid displacement closes these joints, and there are no frequencies
    """

    bodies: tuple[Entry, ...]
    joints: tuple[Entry, ...]
    forces: tuple[Entry, ...]
    rows: int
    rank: int
    redundant: tuple[str, ...]
    freedoms: int
    mobility: int
    mass: float
    frequencies: tuple[float, ...] = field(repr=False)
    separate: tuple[tuple[str, ...], ...] = ()
    repeated: tuple[str, ...] = ()
    closing: Closing = field(default_factory=Closing)
    closes: bool = True

    def __str__(self) -> str:
        first = ", ".join(f"{f:.4g}" for f in self.frequencies[:_SHOWN])
        lines = [
            *_table("body", self.bodies),
            "",
            *_table("joint", self.joints),
            "",
            *_table("force", self.forces),
            "",
            f"rows        {self.rows}, rank {self.rank}",
            f"redundant   {', '.join(self.redundant) or 'none'}",
            f"freedoms    {self.freedoms} ({self.mobility} of rigid bodies)",
            f"total mass  {self.mass:.6g} kg",
            f"vibrations  {first} Hz"
            if first
            else f"vibrations  {'none' if self.closes else 'not known of open joints'}",
        ]
        lines += [f"free        {', '.join(group)}: no joint to the ground" for group in self.separate]
        lines += [f"repeated    {name}: an earlier joint has these equations" for name in self.repeated]
        lines += [f"open        {joint} where the bodies were put" for joint in self.closing.joints]
        lines += [f"moved       {body} to close the joints" for body in self.closing.bodies]
        lines += ["not closed  no rigid displacement closes these joints; start='equilibrium' bends bodies"] * (
            not self.closes
        )
        return "\n".join(lines)


def describe(system: Any) -> Description:
    """Describe a system at its assembled initial position, or where the bodies were put if that does not exist."""
    dynamics = system.dynamics().values().select_lanes([0])
    T = dynamics.topology
    with torch.no_grad():
        try:
            q, _ = dynamics.initial.solve(dynamics)
            closing, closes = dynamics.initial.closing(dynamics), True
        except DoesNotClose:
            (q, closing), closes = dynamics.initial.open(dynamics), False
        J = jacobians(dynamics, q[:, 0, 0][None], torch.zeros(1, dtype=q.dtype))[0].numpy()
    rank = rank_of(T, J) if T.rows else Rank(0, ())
    rigid = rank_of_columns(J[:, : 6 * T.bodies]) if T.rows else 0
    mass = dict(zip(T.names, value(dynamics.data["mass"])[:, 0, 0].tolist(), strict=True))
    freedoms = 6 * T.bodies + sum(T.mode_counts) - rank.rank
    return Description(
        bodies=tuple(_body(body, mass[body.name]) for body in system.bodies),
        joints=tuple(map(_joint, system.joints)),
        forces=tuple(_force(force) for force in system.forces),
        rows=T.rows,
        rank=rank.rank,
        redundant=rank.redundant,
        freedoms=freedoms,
        mobility=6 * T.bodies - rigid,
        mass=sum(mass.values()),
        frequencies=tuple(vibrations(_falling(system, dynamics)).frequencies.tolist()) if freedoms and closes else (),
        separate=_separate(system.bodies, [*system.joints, *(f for f in system.forces if f.beams(AttachmentTable()))]),
        repeated=_repeated(system.joints),
        closing=closing,
        closes=closes,
    )


def _falling(system: Any, dynamics: Any) -> Any:
    """The dynamics without gravity on groups of bodies that nothing ties to the ground."""
    loose = [name for group in _separate(system.bodies, [*system.joints, *system.forces]) for name in group]
    if "gravity" not in dynamics.data or not loose:
        return dynamics
    held = torch.tensor([float(name not in loose) for name in dynamics.topology.names], dtype=torch.float64)
    return dynamics.with_data(dynamics.data | {"gravity": dynamics.data["gravity"] * held[:, None, None]})


def check_connected(bodies: list[Any], joints: list[Any], forces: list[Any], free: list[str]) -> None:
    """InputError if joints exist and a body has no joint and no force; `free` names bodies that fly on purpose.

    A flexible beam counts as one body, and its elements do not count as forces.
    """
    unknown = [name for name in free if name not in [body.name for body in bodies]]
    if unknown:
        raise InputError(
            "free", unknown, f"must name bodies, {[body.name for body in bodies]}", state=f"names {unknown}"
        )
    frames = [frame for joint in joints for frame in joint.frames] + [x for force in forces for x in force.frames]
    connected = {id(frame.body) for frame in frames}
    parts = {id(x) for body in bodies for x in getattr(body, "node_bodies", [body])}
    apart = [body for body in bodies if not any(id(x) in connected for x in getattr(body, "node_bodies", [body]))]
    loose = [body.name for body in apart if body.name not in free]
    if joints and loose:
        others = {x.body.name for x in frames if id(x.body) not in parts and not isinstance(x.body, Ground)}
        shown = ", ".join(map(repr, sorted(others)))
        hint = f"; joints or forces hold bodies that are not in this list: {shown}" if others else ""
        raise InputError(
            "bodies",
            state=f"holds {', '.join(map(repr, loose))}{hint}",
            noun="no joint and no force",
            hint=f"a joint for every body, or free={loose} for bodies that are meant to be free",
        )


def _body(body: Any, mass: float) -> Entry:
    if hasattr(body, "mesh"):
        return Entry(body.name, "flexible", {"mass [kg]": f"{mass:.6g}", "modes": body.modes})
    return Entry(body.name, "rigid", {"mass [kg]": f"{mass:.6g}", "modes": 0})


def _joint(joint: Any) -> Entry:
    rows = sum(equation.kind.rows for equation in joint.equations(AttachmentTable()))
    return Entry(joint.name, type(joint).__name__, {"rows": rows, "between": " - ".join(map(repr, joint.frames))})


def _repeated(joints: list[Any]) -> tuple[str, ...]:
    """Names of joints with equations between the vectors of an earlier joint, whatever the laws of drives."""
    table, seen, repeated = AttachmentTable(), set(), []
    for joint in joints:
        key = tuple((equation.kind, tuple(equation.vectors)) for equation in joint.equations(table))
        if key in seen:
            repeated.append(joint.name)
        seen.add(key)
    return tuple(repeated)


def _force(force: Any) -> Entry:
    shown = force.frames if len(force.frames) < 4 else (force.frames[0], force.frames[-1])
    return Entry(force.name, type(force).__name__, {"on": " - ".join(map(repr, shown))})


def _separate(bodies: list[Any], ties: list[Any]) -> tuple[tuple[str, ...], ...]:
    """Groups of bodies without a path of joints and beam elements to the ground; ties: these joints and force elements."""
    group = {body.name: {body.name} for body in bodies} | {"ground": {"ground"}}
    for first, second in (pair for tie in ties for pair in pairwise(frame.body.name for frame in tie.frames)):
        first, second = group[first], group[second]
        if first is not second:
            first |= second
            for name in second:
                group[name] = first
    separate = {id(members): members for members in group.values() if "ground" not in members}
    return tuple(tuple(body.name for body in bodies if body.name in members) for members in separate.values())


def _table(title: str, entries: tuple[Entry, ...]) -> list[str]:
    if not entries:
        return [f"no {title}"]
    rows = [[title, "kind", *entries[0].numbers], *([e.name, e.kind, *map(str, e.numbers.values())] for e in entries)]
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
