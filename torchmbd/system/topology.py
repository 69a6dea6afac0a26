"""The topology of a system: who is attached to what, as index tensors. Constants of the model, no numbers of a design.

Order of the unknowns (flexible bodies come first):

    q = r [3, bodies] | p [4, bodies] | w [modes, flexible]         coordinates
    v = r' [3, bodies] | omega [3, bodies] | w' [modes, flexible]   rates; omega in body axes
    lam: rows of the primitives, kind by kind (joints/primitive.py)

`modes` is the largest number of modes; bodies with fewer are padded with modes that never move.
The ground is body number `bodies` in `vector_body`.

Sums over attached vectors are gathers from a padded table (`Fold`): one gather and one sum whatever the number of
joints, and no atomic additions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchmbd.bodies import Ground
from torchmbd.errors import InputError
from torchmbd.joints.joint import Attached, Equation, Joint, Scribe
from torchmbd.joints.primitive import KINDS, Primitive, prescribed
from torchmbd.numerics.pair import cat, linear


class Fold:
    """Sum columns of a number into groups: [k, n, ...] -> [k, groups, ...]."""

    def __init__(self, group: Sequence[int], groups: int, device: torch.device | None = None):
        members: list[list[int]] = [[] for _ in range(groups)]
        for column, g in enumerate(group):
            if g >= 0:
                members[g].append(column)
        width = max((len(m) for m in members), default=0)
        padding = len(group)  # an extra column of zeros
        self.groups, self.width = groups, width
        table: list[list[int]] = [m + [padding] * (width - len(m)) for m in members]
        self.table = torch.tensor([m[k] for k in range(width) for m in table], dtype=torch.long)
        self.padded = any(padding in m for m in table)

    def __call__(self, *parts):
        """Fold the columns of all parts, side by side."""
        if self.width == 0:
            return linear(lambda y: y.new_zeros(y.shape[0], self.groups, *y.shape[2:]), parts[0])
        columns = list(parts)
        if self.padded:
            columns.append(linear(lambda y: torch.zeros_like(y[:, :1]), columns[0]))
        x = cat(columns, 1) if len(columns) > 1 else columns[0]
        x = x.index_select(1, self.table)
        return x if self.width == 1 else x.unflatten(1, (self.width, self.groups)).sum(1)


@dataclass(frozen=True, eq=False)
class Topology:
    """Index tensors of one system; see the module header."""

    names: tuple[str, ...]  # bodies, flexible first
    flexible: int
    modes: int
    own_modes: tuple[int, ...]  # retained modes of each flexible body
    attached: tuple[Attached, ...]  # vectors, those of flexible bodies first
    attached_flexible: int
    vector_body: Tensor  # [vectors]; the ground is len(names)
    vector_origin: Tensor  # [vectors] body whose r is added: len(names) (zero) for axes and the ground
    vector_flexible: Tensor  # [attached_flexible] flexible body of each
    primitives: tuple[Primitive, ...]
    slots: Tensor  # vectors of all arguments of all primitives, in order
    row_names: tuple[str, ...]
    vector_fold: Fold  # slots of constraint forces -> vectors
    body_fold: Fold  # [forces of points | torques] of vectors -> [forces | torques] of bodies
    modal_fold: Fold  # modal forces of flexible vectors -> flexible bodies

    @property
    def bodies(self) -> int:
        return len(self.names)

    @property
    def n_q(self) -> int:
        return 7 * self.bodies + self.modes * self.flexible

    @property
    def n_v(self) -> int:
        return 6 * self.bodies + self.modes * self.flexible

    @property
    def rows(self) -> int:
        return len(self.row_names)

    def arguments(self, g: Any) -> list[list[Any]]:
        """The vectors [3, n, ...] of each primitive's arguments, out of all attached vectors: one gather."""
        g = g.index_select(1, self.slots)
        result, start = [], 0
        for primitive in self.primitives:
            n = len(primitive.members[0])
            result.append([g[:, start + k * n : start + (k + 1) * n] for k in range(len(primitive.members))])
            start += n * len(primitive.members)
        return result

    def prescribed(self, t: Tensor, derivatives: bool = False) -> list[tuple | None]:
        """What the laws of driven primitives prescribe at time t, for each kind of primitive."""
        return [prescribed(p.data, t, derivatives) if p.driven else None for p in self.primitives]

    def row_slices(self) -> list[tuple[Primitive, slice]]:
        """Each kind of primitive with its rows among all."""
        result, start = [], 0
        for primitive in self.primitives:
            stop = start + primitive.rows * len(primitive.members[0])
            result.append((primitive, slice(start, stop)))
            start = stop
        return result

    def r_slice(self, body: int) -> list[int]:
        """Rows of q with the origin of a body."""
        return [i * self.bodies + body for i in range(3)]

    def p_slice(self, body: int) -> list[int]:
        """Rows of q with the Euler parameters of a body."""
        return [3 * self.bodies + i * self.bodies + body for i in range(4)]

    def w_slice(self, flexible: int) -> list[int]:
        """Rows of q with the modal coordinates of a flexible body (its own modes, without padding)."""
        return [7 * self.bodies + a * self.flexible + flexible for a in range(self.own_modes[flexible])]


def build(bodies: Sequence[Any], joints: Sequence[Joint]) -> Topology:
    """Order the bodies, scribe all joints and make the index tensors."""
    order = sorted(bodies, key=lambda body: not hasattr(body, "mesh"))
    number = {id(body): i for i, body in enumerate(order)}
    flexible = sum(hasattr(body, "mesh") for body in order)
    ground = len(order)
    scribe = Scribe()
    equations = [(joint, equation) for joint in joints for equation in _checked(joint, scribe, number)]
    bends = [number.get(id(x.body), ground) < flexible for x in scribe.vectors]
    arrangement = sorted(range(len(bends)), key=lambda i: not bends[i])
    position = {old: new for new, old in enumerate(arrangement)}
    attached = tuple(scribe.vectors[i] for i in arrangement)
    body_of = [number.get(id(x.body), ground) for x in attached]
    n_flexible_vectors = sum(bends)
    primitives, row_names = _group(equations, position)
    slots = [int(i) for primitive in primitives for member in primitive.members for i in member]
    n = len(order)
    force_of = [body if x.is_point and body < n else -1 for x, body in zip(attached, body_of, strict=True)]
    torque_of = [n + body if body < n else -1 for body in body_of]
    own = tuple(body.modes for body in order[:flexible])
    return Topology(
        names=tuple(body.name for body in order),
        flexible=flexible,
        modes=max(own, default=0),
        own_modes=own,
        attached=attached,
        attached_flexible=n_flexible_vectors,
        vector_body=torch.tensor(body_of, dtype=torch.long),
        vector_origin=torch.tensor(
            [b if x.is_point else ground for x, b in zip(attached, body_of, strict=True)], dtype=torch.long
        ),
        vector_flexible=torch.tensor(body_of[:n_flexible_vectors], dtype=torch.long),
        primitives=primitives,
        slots=torch.tensor(slots, dtype=torch.long),
        row_names=row_names,
        vector_fold=Fold(slots, len(attached)),
        body_fold=Fold(force_of + torque_of, 2 * n),
        modal_fold=Fold(body_of[:n_flexible_vectors], flexible),
    )


def _checked(joint: Joint, scribe: Scribe, number: dict[int, int]) -> list[Equation]:
    for frame in (joint.a, joint.b):
        if id(frame.body) not in number and not isinstance(frame.body, Ground):
            raise InputError(
                f"joint {joint.name!r} is attached to body {frame.body.name!r}, which is not among the bodies of the system"
            )
    return list(joint.equations(scribe))


def _group(
    equations: list[tuple[Joint, Equation]], position: dict[int, int]
) -> tuple[tuple[Primitive, ...], tuple[str, ...]]:
    """Collect the equations kind by kind; rows of a kind run component first."""
    primitives, names = [], []
    for kind in KINDS:
        mine = [(joint, equation) for joint, equation in equations if equation.kind is kind]
        if not mine:
            continue
        members = tuple(
            torch.tensor([position[equation.vectors[k]] for _, equation in mine]) for k in range(len(kind.arguments))
        )
        primitives.append(kind(members, tuple(equation.data for _, equation in mine)))
        for component in range(kind.rows):
            suffix = f" {'xyz'[component]}" if kind.rows == 3 else ""
            names += [f"{joint.name}: {kind.__name__.lower()}{suffix}" for joint, _ in mine]
    return tuple(primitives), tuple(names)
