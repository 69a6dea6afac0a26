"""The topology of given bodies, joints and forces: their order among the unknowns (topology.py), and the index tensors.

Checked in tests/multibody/equations/.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.math.checked_numbers import is_real
from torchmbd.math.gradients import refuse_gradients
from torchmbd.multibody.bodies import Ground
from torchmbd.multibody.equations.base_points import base_points
from torchmbd.multibody.equations.beams import Beams
from torchmbd.multibody.equations.index_maps import SegmentSum, SparseMap
from torchmbd.multibody.equations.prescribed_body import PrescribedBody
from torchmbd.multibody.equations.topology import Topology
from torchmbd.multibody.equations.turns import Turns
from torchmbd.multibody.forces.action import KINDS as ACTIONS
from torchmbd.multibody.forces.action import Action
from torchmbd.multibody.forces.force import Applied, ForceElement
from torchmbd.multibody.joints.joint import Attached, AttachmentTable, Equation, Joint
from torchmbd.multibody.joints.primitive import KINDS, Primitive


def build(bodies: Sequence[Any], joints: Sequence[Joint], forces: Sequence[ForceElement] = ()) -> Topology:
    """The topology of a system; InputError for joints and forces on bodies that are not among `bodies`."""
    _refuse_repeated("joints", joints)
    _refuse_repeated("forces", forces)
    order = sorted(bodies, key=lambda body: not hasattr(body, "mesh"))
    number = {id(body): i for i, body in enumerate(order)}
    flexible = sum(hasattr(body, "mesh") for body in order)
    ground = len(order)
    attachments = AttachmentTable()
    _refuse_other_joints(joints)
    equations = [(joint, equation) for joint in joints for equation in _equations(joint, attachments, number)]
    applied = [action for force in forces for action in _actions(force, attachments, number)]
    ends = [pair for force in forces for pair in force.beams(attachments)]
    on_flexible = [number.get(id(x.body), ground) < flexible for x in attachments.vectors]
    vector_order = sorted(range(len(on_flexible)), key=lambda i: not on_flexible[i])
    position = {old: new for new, old in enumerate(vector_order)}
    attached = tuple(attachments.vectors[i] for i in vector_order)
    primitives, row_names, row_joints, angles = _group(equations, position)
    body_of = [number.get(id(x.body), ground) for x in attached]
    return assemble(
        names=[body.name for body in order],
        mode_counts=tuple(body.modes for body in order[:flexible]),
        attached=attached,
        body_of=body_of,
        primitives=primitives,
        row_names=row_names,
        row_joints=row_joints,
        actions=_group_actions(applied, position),
        beams=[position[pair[k]] for k in range(2) for pair in ends],
        turns=Turns.of(angles, attached, body_of),
        base_points=base_points(order, _held(equations, attachments.vectors)),
    )


def assemble(
    *,
    names: Sequence[str],
    mode_counts: tuple[int, ...],
    attached: tuple[Attached, ...],
    body_of: list[int],
    primitives: tuple[Primitive, ...],
    row_names: tuple[str, ...],
    row_joints: tuple[str, ...],
    actions: tuple[Action, ...] = (),
    prescribed_bodies: tuple[PrescribedBody, ...] = (),
    rates: Tensor | None = None,
    beams: Sequence[int] = (),
    turns: Turns | None = None,
    base_points: Tensor | None = None,
) -> Topology:
    """The topology of named bodies, flexible ones first, with its index tensors.

    body_of   number of the body of each attached vector; known bodies are counted after the bodies
    beams     attached points of the starts of all beam elements, then of their ends
    Others as in `Topology`.
    """
    n, flexible, ground = len(names), len(mode_counts), len(names) + len(prescribed_bodies)
    argument_vectors, action_vectors = (
        [int(i) for kind in kinds for member in kind.members for i in member] for kinds in (primitives, actions)
    )
    vector_flexible = [body for body in body_of if body < flexible]
    force_of = [body if x.is_point and body < n else -1 for x, body in zip(attached, body_of, strict=True)]
    torque_of = [n + body if body < n else -1 for body in body_of]
    return Topology(
        names=tuple(names),
        flexible=flexible,
        modes=max(mode_counts, default=0),
        mode_counts=mode_counts,
        attached=attached,
        attached_flexible=len(vector_flexible),
        vector_body=torch.tensor(body_of, dtype=torch.long),
        vector_origin=torch.tensor(
            [b if x.is_point else ground for x, b in zip(attached, body_of, strict=True)], dtype=torch.long
        ),
        vector_flexible=torch.tensor(vector_flexible, dtype=torch.long),
        primitives=primitives,
        argument_vectors=torch.tensor(argument_vectors, dtype=torch.long),
        row_names=row_names,
        row_joints=row_joints,
        vector_sum=SegmentSum(argument_vectors, len(attached)),
        body_sum=SegmentSum(force_of + torque_of, 2 * n),
        modal_sum=SegmentSum(vector_flexible, flexible),
        actions=actions,
        action_vectors=torch.tensor(action_vectors, dtype=torch.long) if actions else None,
        action_sum=SegmentSum(action_vectors, len(attached)) if actions else None,
        beams=Beams.of(beams, body_of, n) if beams else None,
        prescribed_bodies=prescribed_bodies,
        rates=rates,
        spread=None if rates is None else SparseMap(rates),
        gather=None if rates is None else SparseMap(rates.T),
        turns=turns,
        base_points=base_points,
    )


def _held(equations: Sequence[tuple[Joint, Equation]], vectors: Sequence[Attached]) -> list[Any]:
    """Bodies whose origin is a point of an equation of a joint with the ground."""
    held = []
    for joint, equation in equations:
        points = [x for x in (vectors[i] for i in equation.vectors) if x.is_point]
        if any(isinstance(frame.body, Ground) for frame in joint.frames):
            held += [x.body for x in points if not bool(x.vector.any())]
    return held


def _refuse_repeated(argument: str, elements: Sequence[Any]) -> None:
    """InputError if a list has one joint or force element several times."""
    for element, times in Counter(elements).items():
        if times > 1:
            raise InputError(
                (argument, element.name),
                allowed="listed once",
                state=f"is listed {times} times",
                noun=f"{argument}: {element.name!r}",
            )


def _refuse_other_joints(joints: Sequence[Joint]) -> None:
    """InputError for a coupling of joints that are not among these."""
    present = {id(joint) for joint in joints}
    for joint in joints:
        for other in joint.joints:
            if id(other) not in present:
                raise InputError(
                    ("joints", joint.name),
                    hint=f"joints=[..., {other.name}, {joint.name}]",
                    noun=f"joint {joint.name!r}",
                    state=f"couples {other.name!r}, which is not among the joints of the system",
                )


def _equations(joint: Joint, attachments: AttachmentTable, number: dict[int, int]) -> list[Equation]:
    for frame in joint.frames:
        if id(frame.body) not in number and not isinstance(frame.body, Ground):
            raise InputError(
                ("joints", joint.name),
                allowed="attached to bodies of the system",
                noun=f"joint {joint.name!r}",
                state=f"is attached to body {frame.body.name!r}, which is not among the bodies of the system",
            )
    equations = _check_kinds(joint, list(joint.equations(attachments)), Primitive, KINDS)
    for equation in equations:
        if equation.kind.constants:
            _check_constants(joint.name, equation)
    return equations


def _check_constants(name: str, equation: Equation) -> None:
    """InputError unless an equation has as many finite numbers as its kind takes."""
    count, kind = equation.kind.constants, equation.kind.__name__.lower()
    refuse_gradients(f"a constant of {name!r} ({kind})", equation.data)
    values = equation.data if isinstance(equation.data, (tuple, list)) else (equation.data,)
    if len(values) != count or not all(is_real(x) and math.isfinite(x) for x in values):
        raise InputError(
            (name, "constants"),
            equation.data,
            f"{count} finite numbers for an equation of the kind {kind}",
        )


def _actions(force: ForceElement, attachments: AttachmentTable, number: dict[int, int]) -> list[Applied]:
    for frame in (*force.frames, *force.measured):
        if id(frame.body) not in number and not isinstance(frame.body, Ground):
            raise InputError(
                ("forces", force.name),
                allowed="must act on bodies of the system",
                noun=f"force {force.name!r}",
                state=f"acts on body {frame.body.name!r}, which is not among the bodies of the system",
            )
    return _check_kinds(force, list(force.actions(attachments)), Action, ACTIONS)


Part = TypeVar("Part", Equation, Applied)


def _check_kinds(owner: Joint | ForceElement, parts: list[Part], base: type, kinds: tuple[type, ...]) -> list[Part]:
    """The equations of a joint, or actions of a force; InputError for a kind that has not their base class."""
    for part in parts:
        if not (isinstance(part.kind, type) and issubclass(part.kind, base)):
            names = ", ".join(kind.__name__ for kind in kinds)
            name = getattr(part.kind, "__name__", repr(part.kind))
            raise InputError(
                (owner.name,),
                allowed=f"must have the kind {names}, or another {base.__name__}",
                noun=repr(owner.name),
                state=f"has the kind {name!r}",
            )
    return parts


def _in_order(parts: Iterable[Equation | Applied], kinds: tuple[type, ...]) -> list[Any]:
    """The kinds that occur, those of `kinds` first."""
    present = dict.fromkeys(part.kind for part in parts)
    return [kind for kind in kinds if kind in present] + [kind for kind in present if kind not in kinds]


def _group_actions(applied: list[Applied], position: dict[int, int]) -> tuple[Action, ...]:
    """The actions, one object for each kind; position: of attached vectors in the order of the topology."""
    result = []
    for kind in _in_order(applied, ACTIONS):
        members = [action for action in applied if action.kind is kind]
        vectors = tuple(
            torch.tensor([position[action.vectors[k]] for action in members]) for k in range(len(kind.arguments))
        )
        result.append(kind(vectors, tuple(action.law for action in members)))
    return tuple(result)


def _group(
    equations: list[tuple[Joint, Equation]], position: dict[int, int]
) -> tuple[tuple[Primitive, ...], tuple[str, ...], tuple[str, ...], list[tuple[int, ...]]]:
    """The primitives, one object for each kind, and name and joint of each row; rows of a kind run component by component.

    The last result has the vectors of each counted angle.
    """
    primitives, names, owners = [], [], []
    angles: dict[tuple[int, ...], int] = {}
    for kind in _in_order((equation for _, equation in equations), KINDS):
        members = [(joint, equation) for joint, equation in equations if equation.kind is kind]
        vectors = tuple(
            torch.tensor([position[equation.vectors[k]] for _, equation in members]) for k in range(len(kind.arguments))
        )
        turns = []
        for k in range(kind.angles):
            each = zip(*(x.tolist() for x in vectors[3 * k : 3 * k + 3]), strict=True)
            turns.append(torch.tensor([angles.setdefault(angle, len(angles)) for angle in each]))
        primitives.append(kind(vectors, tuple(equation.data for _, equation in members), tuple(turns)))
        for component in range(kind.rows):
            suffix = f" {'xyz'[component]}" if kind.rows == 3 else ""
            names += [f"{joint.name}: {kind.word or kind.__name__.lower()}{suffix}" for joint, _ in members]
            owners += [joint.name for joint, _ in members]
    return tuple(primitives), _numbered(names), tuple(owners), list(angles)


def _numbered(names: list[str]) -> tuple[str, ...]:
    """Names of rows; a number is appended to those that occur several times."""
    count = Counter(names)
    seen: Counter[str] = Counter()
    result = []
    for name in names:
        seen[name] += 1
        result.append(f"{name} {seen[name]}" if count[name] > 1 else name)
    return tuple(result)
