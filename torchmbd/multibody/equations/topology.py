"""The topology of a system: the bodies of attached vectors, the vectors of joints and forces, as index tensors. It is constant
for all designs.

Order of the unknowns (flexible bodies come first):

    q = r [3, bodies] | p [4, bodies] | w [modes, flexible] | tau   coordinates; tau: counted angles (turns.py), mostly none;
                                                                    r: base points (base_points.py), mostly origins
    v = r' [3, bodies] | omega [3, bodies] | w' [modes, flexible]   rates; omega in body axes
    lam: rows of the primitives, kind by kind (multibody/joints/primitive.py)

`modes` is the largest number of modes; bodies and designs with fewer are padded with modes that never move. A topology belongs
to the designs of a batch by its numbers of modes alone (`with_modes`).
Known bodies, whose motion is known, follow the bodies in `vector_body`: the prescribed bodies of a condensation
(prescribed_body.py), and the ground last. `rates`, in a condensed system, gives the rates of all bodies from independent ones;
v and a then hold the independent ones, and only `split_v` and `dynamic_residual` treat the two cases apart.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, overload

import torch
from torch import Tensor

from torchmbd.math.pair import linear, value
from torchmbd.multibody.equations.beams import Beams
from torchmbd.multibody.equations.coupling import Coupling
from torchmbd.multibody.equations.index_maps import SegmentSum, SparseMap
from torchmbd.multibody.equations.prescribed_body import PrescribedBody
from torchmbd.multibody.equations.turns import Turns
from torchmbd.multibody.forces.action import Action
from torchmbd.multibody.forces.feedback import Links
from torchmbd.multibody.joints.joint import Attached
from torchmbd.multibody.joints.primitive import Primitive


class Prescribed(NamedTuple):
    """Prescribed quantities at one time: values of laws for each kind of primitive, and poses of the known bodies."""

    laws: list[tuple | None]
    A: Tensor  # rotations [3, 3, known bodies, 1, 1], the ground last
    r: Tensor  # origins [3, known bodies, 1, 1]
    t: Any  # the time [1, 1] or []; [1, lanes] or [lanes] where each lane is at its own

    def values(self) -> Prescribed:
        """The same without tangents."""
        laws = [None if law is None else tuple(value(x) for x in law) for law in self.laws]
        return self._replace(laws=laws, A=value(self.A), r=value(self.r), t=value(self.t))


@dataclass(frozen=True, eq=False)
class Schedule(Sequence[Prescribed]):
    """Prescribed quantities at n times, as in Prescribed with an axis of times in front; a sequence of those of each time."""

    laws: list[tuple | None]
    A: Tensor
    r: Tensor
    t: Any

    @classmethod
    def of(cls, at: Prescribed) -> Schedule:
        """That of one time."""
        laws = [None if law is None else tuple(linear(_at_one_time, x) for x in law) for law in at.laws]
        return cls(laws, *(linear(_at_one_time, x) for x in at[1:]))

    def __len__(self) -> int:
        return len(self.t)

    @overload
    def __getitem__(self, i: int) -> Prescribed: ...
    @overload
    def __getitem__(self, i: slice) -> Schedule: ...
    def __getitem__(self, i: int | slice) -> Prescribed | Schedule:
        laws = [None if law is None else tuple(x[i] for x in law) for law in self.laws]
        kind = Schedule if isinstance(i, slice) else Prescribed
        return kind(laws, self.A[i], self.r[i], self.t[i])


def _at_one_time(x: Tensor) -> Tensor:
    return x.unsqueeze(0)


@dataclass(frozen=True, eq=False)
class Topology:
    """Index tensors of one system; see the module header."""

    names: tuple[str, ...]  # bodies, flexible first
    flexible: int
    modes: int
    mode_counts: tuple[int, ...]  # modes of each flexible body, of the design that retains most
    attached: tuple[Attached, ...]  # vectors, those of flexible bodies first
    attached_flexible: int
    vector_body: Tensor  # [vectors]; the ground is len(names)
    vector_origin: Tensor  # [vectors] body whose r is added: len(names) (zero) for axes and the ground
    vector_flexible: Tensor  # [attached_flexible] flexible body of each
    primitives: tuple[Primitive, ...]
    argument_vectors: Tensor  # vectors of all arguments of all primitives, in order
    row_names: tuple[str, ...]
    row_joints: tuple[str, ...]  # the joint of each row
    vector_sum: SegmentSum  # constraint forces of the arguments -> vectors
    body_sum: SegmentSum  # [forces of points | torques] of vectors -> [forces | torques] of bodies
    modal_sum: SegmentSum  # modal forces of flexible vectors -> flexible bodies
    actions: tuple[Action, ...] = ()
    action_vectors: Tensor | None = None  # vectors of all arguments of all actions, in order
    action_sum: SegmentSum | None = None  # applied forces of the arguments -> vectors
    beams: Beams | None = None  # elements of beams between rigid bodies
    prescribed_bodies: tuple[PrescribedBody, ...] = ()
    rates: Tensor | None = None  # [rates of all bodies, independent rates]
    spread: SparseMap | None = None  # `rates` as a map: independent rates -> rates of all bodies
    gather: SparseMap | None = None  # its transpose: forces on all bodies -> forces on independent rates
    turns: Turns | None = None  # angles that count full turns
    base_points: Tensor | None = (
        None  # in body axes [3, bodies, 1, 1]; None: origins, also where the system is condensed
    )

    def with_modes(self, mode_counts: tuple[int, ...]) -> Topology:
        """The topology of the same system whose flexible bodies have other numbers of modes; of one that is not condensed."""
        if mode_counts == self.mode_counts:
            return self
        return replace(self, modes=max(mode_counts, default=0), mode_counts=mode_counts)

    @cached_property
    def links(self) -> Links:
        """The controllers, with the actions that they read and set."""
        return Links([law for action in self.actions for law in action.laws])

    @cached_property
    def coupling(self) -> Coupling:
        """The directions from which matrices of tangents follow."""
        return Coupling.of(self)

    @property
    def bodies(self) -> int:
        return len(self.names)

    @property
    def n_q(self) -> int:
        return 7 * self.bodies + self.modes * self.flexible + self.turn_count

    @property
    def turn_count(self) -> int:
        """Number of counted angles."""
        return 0 if self.turns is None else len(self.turns)

    @property
    def n_v(self) -> int:
        return self.n_rates if self.rates is None else self.rates.shape[1]

    @cached_property
    def rate_kinds(self) -> Tensor:
        """Kinds of the rates [n_v]: 0 for angular velocities, 1 for velocities, 2 + k for modes of flexible body k."""
        n = 3 * self.bodies
        kinds = torch.tensor([1] * n + [0] * n + [2 + k for k in range(self.flexible)] * self.modes, dtype=torch.long)
        if self.rates is None:
            return kinds
        # Joints guide a body by independent rates. Most are rates of the body itself, rows with a single 1; others are angles.
        rows = torch.nonzero(((self.rates != 0.0).sum(1) == 1) & (self.rates.abs().amax(1) == 1.0))[:, 0]
        return kinds.new_zeros(self.n_v).index_copy(0, self.rates[rows].abs().argmax(1), kinds[rows])

    @cached_property
    def coordinate_kinds(self) -> Tensor:
        """Kinds of the coordinates [n_q]: 0 for angles and Euler parameters, 1 for displacements, 2 + k as in `rate_kinds`."""
        n, modal = self.bodies, [2 + k for k in range(self.flexible)] * self.modes
        return torch.tensor([1] * (3 * n) + [0] * (4 * n) + modal + [0] * self.turn_count, dtype=torch.long)

    @property
    def n_rates(self) -> int:
        """Rates of all bodies."""
        return 6 * self.bodies + self.modes * self.flexible

    @property
    def vectors(self) -> int:
        """Attached vectors."""
        return len(self.attached)

    @property
    def known_bodies(self) -> int:
        """Number of bodies with a known motion: the prescribed ones and the ground."""
        return 1 + len(self.prescribed_bodies)

    @property
    def rows(self) -> int:
        return len(self.row_names)

    @property
    def has_fast_elements(self) -> bool:
        """True if elements of exact beams act: their axial vibrations, and nodes that are let go, are faster than steps."""
        return self.beams is not None

    def arguments(self, g: Any) -> list[list[Any]]:
        """The vectors [3, n, ...] of each primitive's arguments, out of all attached vectors: one gather."""
        return _arguments(g.index_select(1, self.argument_vectors), self.primitives)

    def action_arguments(self, g: Any) -> list[list[Any]]:
        """The same for the actions."""
        return _arguments(g.index_select(1, self.action_vectors), self.actions)

    def base_point(self, body: int) -> Tensor | None:
        """Base point of a body in body axes [3]; None: its origin, or that of the ground."""
        return None if self.base_points is None or body >= self.bodies else self.base_points[:, body, 0, 0]

    def from_base_point(self, i: int, x: Tensor) -> Tensor:
        """Attached vector i, of components x [..., 3] in body axes: a point is given from the origin, and measured from r."""
        c = self.base_point(int(self.vector_origin[i]))
        return x if c is None else x - c

    def from_origin(self, i: int, x: Tensor) -> Tensor:
        """The reverse of `from_base_point`."""
        c = self.base_point(int(self.vector_origin[i]))
        return x if c is None else x + c

    def vectors_in_design(self) -> list[Tensor]:
        """The attached vectors in the present design [*lanes, 3], points from the base points of their bodies."""
        return [self.from_base_point(i, attached.now()) for i, attached in enumerate(self.attached)]

    @property
    def varying_vectors(self) -> set[int]:
        """Attached vectors that vary with the design."""
        return {i for i, attached in enumerate(self.attached) if attached.varies}

    @property
    def varying_primitives(self) -> list[int]:
        """Kinds of primitives with laws that have design variables."""
        return [i for i, p in enumerate(self.primitives) if p.varies]

    def law_jets(self, t: Tensor, data: Mapping[str, Any] | None = None) -> list[tuple | None]:
        """Values of the laws of driven primitives at time t, with time derivatives, for each kind of primitive.

        t      [], or [lanes]: each lane at its own time
        data   data of the designs; None: design variables of laws have the values of their Parameters
        """
        return [p.prescribed_jets(t, data) if p.driven else None for p in self.primitives]

    def prescribed(self, t: Tensor, data: Mapping[str, Any] | None = None) -> Prescribed:
        """Prescribed quantities at time t; arguments as in `law_jets`."""
        if t.numel() == 1:
            return self.schedule(t.reshape(1), data)[0]
        A, r = self.poses(t)
        at_times = [p.prescribed(t, data) if p.driven else None for p in self.primitives]
        laws = [None if law is None else tuple(linear(_of_each_lane, x) for x in law) for law in at_times]
        return Prescribed(laws, A.movedim(0, -1)[..., 0, :], r.movedim(0, -1)[..., 0, :], t)

    def schedule(self, times: Tensor, data: Mapping[str, Any] | None = None) -> Schedule:
        """Prescribed quantities at each of the times [n]; data as in `law_jets`."""
        laws = [p.prescribed(times, data) if p.driven else None for p in self.primitives]
        return Schedule(laws, *self.poses(times), times)

    def poses(self, times: Tensor) -> tuple[Tensor, Tensor]:
        """Rotations [n, 3, 3, known bodies, 1, 1] and origins [n, 3, known bodies, 1, 1] of the known bodies at times [n]."""
        n = len(times)
        poses = [prescribed_body.poses(times) for prescribed_body in self.prescribed_bodies]
        eye = torch.eye(3, dtype=times.dtype, device=times.device)
        poses.append((eye[..., None].expand(3, 3, n), times.new_zeros(3, n)))
        A, r = (torch.stack(x, -2)[..., None, None].movedim(-3, 0).contiguous() for x in zip(*poses, strict=True))
        return A, r

    def modal_identity(self, like: Tensor) -> Tensor:
        """The identity [modes, modes, 1, 1, 1]."""
        return torch.eye(self.modes, dtype=like.dtype, device=like.device)[:, :, None, None, None]

    def row_slices(self) -> list[tuple[Primitive, slice]]:
        """Each kind of primitive with its rows among all."""
        result, start = [], 0
        for primitive in self.primitives:
            stop = start + primitive.rows * len(primitive.members[0])
            result.append((primitive, slice(start, stop)))
            start = stop
        return result

    def members_of(self, rows: Collection[int]) -> list[tuple[Primitive, list[int]]]:
        """Kinds of primitives with the members whose rows are among these; rows hold all or none of the rows of a member."""
        result = []
        for primitive, slice_ in self.row_slices():
            members = [j for j in range(len(primitive.members[0])) if slice_.start + j in rows]
            if members:
                result.append((primitive, members))
        return result

    def selected(self, rows: Collection[int]) -> Topology:
        """The same bodies, attached vectors and data with some of the constraint rows, as in a phase of a motion."""
        rows, primitives = set(rows), []
        for primitive, numbers in self.members_of(rows):
            primitives.append(primitive.select(numbers))
        vectors = [int(i) for primitive in primitives for member in primitive.members for i in member]
        return replace(
            self,
            primitives=tuple(primitives),
            argument_vectors=torch.tensor(vectors, dtype=torch.long),
            row_names=tuple(self.row_names[i] for i in sorted(rows)),
            row_joints=tuple(self.row_joints[i] for i in sorted(rows)),
            vector_sum=SegmentSum(vectors, self.vectors),
        )

    def r_slice(self, body: int) -> list[int]:
        """Rows of q with the base point of a body."""
        return [i * self.bodies + body for i in range(3)]

    def p_slice(self, body: int) -> list[int]:
        """Rows of q with the Euler parameters of a body."""
        return [3 * self.bodies + i * self.bodies + body for i in range(4)]

    def w_slice(self, flexible: int) -> list[int]:
        """Rows of q with the modal coordinates of a flexible body (its own modes, without padding)."""
        return [7 * self.bodies + a * self.flexible + flexible for a in range(self.mode_counts[flexible])]

    def rate_name(self, row: int, straight: str = "displacement", about: str = "rotation") -> str:
        """What row `row` of v stands for, for messages: "rotation x of 'rod'"; other words for forces."""
        if row < 6 * self.bodies:
            kind = straight if row < 3 * self.bodies else about
            return f"{kind} {'xyz'[row // self.bodies % 3]} of {self.names[row % self.bodies]!r}"
        mode, body = divmod(row - 6 * self.bodies, self.flexible)
        return f"mode {mode + 1} of {self.names[body]!r}"


def _of_each_lane(x: Tensor) -> Tensor:
    """What a law prescribes at times [n], [n, laws, pair, lanes or 1], as that of n lanes, each at its own time."""
    return x.diagonal(dim1=0, dim2=-1) if x.shape[-1] > 1 else x[..., 0].movedim(0, -1)


def _arguments(g: Any, kinds: Sequence[Primitive | Action]) -> list[list[Any]]:
    result, start = [], 0
    for kind in kinds:
        n = len(kind.members[0])
        result.append([g[:, start + k * n : start + (k + 1) * n] for k in range(len(kind.members))])
        start += n * len(kind.members)
    return result
