"""Condensation: joints between a rigid body and the ground are solved once, before the motion, and not in every step.

    prescribed   the joints to the ground leave the body no degree of freedom but that of its drive: its motion is known, and
                 it becomes a prescribed body like the ground
    guided       the joints to the ground leave it a constant subspace N of rates, v = N u (a slider on a prismatic joint, a
                 wheel that turns about its origin): their rows are removed, and the independent rates u replace v
    held         a lock holds it where it is, by the design: as guided, without any rates

Exact: the condensed system has the same motion with fewer unknowns; the slider-crank has 22 of 44. That a subspace, or the turn
of a drive, satisfies the joints at all poses and not only at the start is tested at poses far from it.
Coordinates of the whole system, and multipliers of removed rows, follow on demand (expansion.py, reactions.py).
Checked in tests/multibody/saddle/test_condensation.py: against the same system with nothing condensed.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchmbd.math.pair import linear, value
from torchmbd.math.rotation import rotation_matrix, skew
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equations.arrangement import assemble
from torchmbd.multibody.equations.data import ATTACHED, INERTIA, Data
from torchmbd.multibody.equations.prescribed_body import PrescribedBody
from torchmbd.multibody.equations.sizes import rate_sizes_at, row_sizes
from torchmbd.multibody.equations.topology import Topology
from torchmbd.multibody.joints.primitive import Primitive, values_at
from torchmbd.multibody.saddle.matrix import Saddle

_ZERO = 1e-9  # violation of a row by its size, or share of the largest singular value, that counts as zero
_FAR = (0.4, -1.1, 2.3)  # [rad], or of the size of the mechanism: distances of the trial poses from the start
_STEPS = 20  # of Newton's method


@dataclass(frozen=True, eq=False)
class Condensation:
    """A condensed topology, and how its parts are numbered in the whole one.

    bodies, vectors, rows  numbers of the retained bodies, attached vectors and constraint rows in the whole topology
    independent            rows of v of the whole system that are the independent rates
    """

    whole: Topology
    topology: Topology
    saddle: Saddle
    bodies: list[int]
    vectors: list[int]
    rows: Tensor
    independent: Tensor

    @staticmethod
    def are_alike(a: Condensation | None, b: Condensation | None) -> bool:
        """True if two of systems with the same rows keep the same bodies, rates and rows; None: all."""
        if a is None or b is None:
            return a is b
        return a.bodies == b.bodies and torch.equal(a.rows, b.rows) and torch.equal(a.independent, b.independent)

    @cached_property
    def whole_saddle(self) -> Saddle:
        """Of the whole topology."""
        return Saddle(self.whole)

    def data(self, data: Data) -> Data:
        """Data of the condensed system, out of those of the whole."""
        flexible = [i for i in self.vectors if i < self.whole.attached_flexible]
        index = {name: (axis, self.vectors if name == "x" else flexible) for name, axis in ATTACHED.items()}
        index |= {name: (rank, self.bodies) for name, rank in INERTIA.items()}

        def select(name: str, x: Any) -> Any:
            return (
                x.index_select(index[name][0], torch.tensor(index[name][1], dtype=torch.long)) if name in index else x
            )

        return {name: select(name, x) for name, x in data.items()}

    def retained(self, q: Any, v: Any) -> tuple[Any, Any]:
        """Coordinates [n_q, ...] and independent rates [n_v, ...] of the condensed system, out of those of the whole."""
        return q.index_select(0, component_rows(self.whole, self.bodies, 7)), v.index_select(0, self.independent)

    def whole_state(self, x: Any, t: Any) -> Any:
        """The state of the whole system at t [s] (a number, or a pair [1 + n, lanes or 1]), out of that of the condensed one.

        Multipliers stay those of the retained rows; `reactions.multipliers_at` gives all.
        """
        known = [(self.whole.names.index(body.name), body.motion_at(t)) for body in self.topology.prescribed_bodies]
        spread = self.topology.spread  # rates of the retained bodies from independent ones

        def whole(y: Any, order: int) -> Any:
            components = 6 if order else 7
            rows, size = component_rows(self.whole, self.bodies, components), component_count(self.whole, components)
            z = linear(lambda u: _scattered(spread(u) if spread and order else u, rows, size), y)
            for number, motion in known:
                of_body = torch.arange(components) * self.whole.bodies + number
                z = z + linear(lambda u, rows=of_body: _scattered(u, rows, size), motion[order])
            return z

        return type(x)(whole(x.q, 0), whole(x.v, 1), whole(x.vd, 2), whole(x.a, 2), x.lam)

    def of_whole(self, order: int, x: Tensor) -> Tensor:
        """Cotangents of q (order 0), v (1) or a (2) [times, k, rows, lanes] of the condensed system, of those of the whole."""
        y = x.index_select(1, component_rows(self.whole, self.bodies, 6 if order else 7))
        gather = self.topology.gather if order else None
        if gather is None:
            return y
        flat = gather(y.transpose(0, 1).flatten(1, 2))
        return flat.unflatten(1, (y.shape[0], y.shape[2])).transpose(0, 1)

    @property
    def coordinates(self) -> Tensor:
        """Rows of q of the whole system that are those of the condensed one."""
        return component_rows(self.whole, self.bodies, 7)

    def of_retained_state(self, x: Sequence[Tensor]) -> list[Tensor]:
        """Cotangents [rows, n, 1, lanes] of the parts of a whole state, from those of the condensed one (`retained_state`)."""
        rows = [
            (self.coordinates, component_count(self.whole, 7)),
            *[(self.independent, component_count(self.whole, 6))] * 3,
            (self.rows, self.whole.rows),
        ]
        return [_scattered(y.movedim(0, 1), *at).movedim(1, 0) for y, at in zip(x, rows, strict=True)]

    def retained_state(self, x: Any) -> Any:
        """The state (results/state.py) of the condensed system, out of that of the whole; multipliers of retained rows stay."""
        q, v = self.retained(x.q, x.v)
        vd, a = (y.index_select(0, self.independent) for y in (x.vd, x.a))
        return type(x)(q, v, vd, a, x.lam if len(value(x.lam)) == len(self.rows) else x.lam.index_select(0, self.rows))


def _scattered(x: Tensor, rows: Tensor, size: int) -> Tensor:
    """[size, ...] with x [k, ...] in k rows, else zero."""
    return x.new_zeros(size, *x.shape[1:]).index_copy(0, rows, x)


def component_count(T: Topology, components: int) -> int:
    """Number of coordinates (7 components of a body) or rates of all bodies (6)."""
    return T.n_q if components == 7 else T.n_rates


def component_rows(T: Topology, bodies: list[int], components: int) -> Tensor:
    """Rows of q (7 components for each body) or v (6) of some bodies, of all modes, and of q those of counted angles."""
    others = list(range(components * T.bodies, component_count(T, components)))
    return torch.tensor([k * T.bodies + b for k in range(components) for b in bodies] + others, dtype=torch.long)


@dataclass
class _GroundJoints:
    """The joints between one rigid body and the ground: rows without a law, driven rows and their laws, rows of locks."""

    body: int
    rows: list[int]
    driven: list[int]
    laws: list[Any]
    locks: list[int]


def _ground_joints(T: Topology, locks: Collection[str]) -> list[_GroundJoints]:
    """The ground joints of all bodies that may be condensed; locks: names of these."""
    # A body with applied forces keeps its equations of motion: the forces may depend on its rates.
    loaded = set() if T.action_vectors is None else set(T.vector_body[T.action_vectors].tolist())
    loaded |= set() if T.beams is None else set(T.beams.bodies)
    candidates = {b: _GroundJoints(b, [], [], [], []) for b in range(T.flexible, T.bodies) if b not in loaded}
    varying = T.varying_vectors  # with these the pose of the body depends on the design
    for primitive, rows in T.row_slices():
        if primitive.driven and not primitive.prescribes:
            continue  # a relation between joints
        n = len(primitive.members[0])
        bodies = torch.stack([T.vector_body[m] for m in primitive.members]).T.tolist()
        for j, on in enumerate(bodies):
            moving = {b for b in on if b < T.bodies}
            if len(moving) != 1 or (joints := candidates.get(min(moving))) is None:
                continue
            if varying.intersection(int(m[j]) for m in primitive.members):
                del candidates[min(moving)]
                continue
            equations_of = [rows.start + c * n + j for c in range(primitive.rows)]
            if T.row_joints[equations_of[0]] in locks:
                joints.locks += equations_of
            elif primitive.prescribes:
                joints.driven += equations_of
                joints.laws.append(primitive.data[j])
            else:
                joints.rows += equations_of
    return [joints for joints in candidates.values() if joints.rows]


class _Poses:
    """Constraints of undeformed bodies at any pose, of a mechanism of a size [m]: rows and rates are divided by their sizes."""

    def __init__(self, T: Topology, size: float):
        self.T, self.size = T, size
        self.rho = row_sizes(T, size)[:, 0, 0]
        self.s = rate_sizes_at(T, torch.full((1, 1), size, dtype=torch.float64))[:, 0, 0]
        x = [T.from_base_point(i, attached.vector) for i, attached in enumerate(T.attached)]
        x = torch.stack(x, 1)[..., None, None]
        self.data = {"x": x, "Y": x.new_zeros(3, T.modes, T.attached_flexible, 1, 1)}

    def phi(self, q: Tensor, angle: float = 0.0) -> Tensor:
        """Violations [rows] by their sizes at q [n_q], with `angle` added to the values of all laws at t = 0."""
        return equations.constraints(self.T, self._placement(q, angle))[:, 0, 0] / self.rho

    def _placement(self, q: Tensor, angle: float) -> equations.Placement:
        start = q.new_zeros(1)

        def drive(p: Primitive) -> tuple | None:
            if not p.prescribes:
                return tuple(value(x)[0, ..., :1] for x in p.prescribed(start)) if p.driven else None
            return p.drive(torch.stack([values_at(law, start)[0] + angle for law in p.data])[:, None, None])

        laws = [drive(p) for p in self.T.primitives]
        excitation = self.T.prescribed(start[0])._replace(laws=laws)
        return equations.placement(self.T, self.data, q[:, None, None], excitation)

    def moved(self, q: Tensor, step: Tensor) -> Tensor:
        """q after an increment [n_v], which is divided by sizes."""
        return equations.advance(self.T, q[:, None, None], (self.s * step)[:, None, None])[:, 0, 0]

    def jacobian(self, q: Tensor) -> Tensor:
        """Phi_q s / rho [rows, n_v] at q [n_q], the derivative of `phi` by increments."""
        unit = torch.eye(self.T.rows, dtype=q.dtype)[:, :, None]
        forces = equations.constraint_forces(self.T, self.data, self._placement(q, 0.0), unit)  # of unit multipliers
        return torch.cat([x.flatten(0, 1) for x in forces])[..., 0].T * self.s / self.rho[:, None]

    def columns(self, body: int) -> list[int]:
        """Columns of Phi_q of the rates of a body."""
        return [k * self.T.bodies + body for k in range(6)]

    def closed(self, q: Tensor, ground_joints: list[_GroundJoints]) -> Tensor:
        """q with the bodies of ground joints moved so that these are closed."""
        rows = [i for joints in ground_joints for i in joints.rows + joints.driven]
        columns = [i for joints in ground_joints for i in self.columns(joints.body)]
        for _ in range(_STEPS):
            phi = self.phi(q)[rows]
            if float(phi.abs().max()) < 1e-14:
                break
            step = q.new_zeros(self.T.n_v)
            step[columns] = -torch.linalg.pinv(self.jacobian(q)[rows][:, columns], rtol=1e-10) @ phi
            q = self.moved(q, step)
        return q


@torch.no_grad()  # poses of condensed bodies do not depend on the design
def condense(
    T: Topology, q: Tensor, size: float, constant: Collection[int] | None = None, locks: Collection[str] = ()
) -> Condensation | None:
    """The condensation of a topology with approximate initial positions q [n_q]; None if no joint can be removed.

    size      of the mechanism [m] (equations/sizes.py)
    constant  rows that have acted since the start, whose poses follow from q; None: all
    locks     names of the locks, which hold poses that follow from the motion
    """
    ground_joints = _ground_joints(T, locks)
    guided: dict[int, Tensor] = {joints.body: q.new_zeros(6, 0) for joints in ground_joints if joints.locks}
    removed = {row for joints in ground_joints if joints.locks for row in joints.rows + joints.locks}
    ground_joints = [
        joints
        for joints in ground_joints
        if not joints.locks and (constant is None or set(joints.rows + joints.driven).issubset(constant))
    ]
    prescribed_bodies: dict[int, PrescribedBody] = {}
    turning = (
        set() if T.turns is None else {*T.turns.first.tolist(), *T.turns.second.tolist()}
    )  # turns are those of unknowns
    poses = _Poses(T, size)
    q = poses.closed(q, ground_joints) if ground_joints else q
    J = poses.jacobian(q) if ground_joints else q
    for joints in ground_joints:
        if float(poses.phi(q)[joints.rows + joints.driven].abs().max()) > _ZERO:
            continue  # cannot close; InitialConditions raises the error
        free = _null(J[joints.rows][:, poses.columns(joints.body)])
        same_for_all_designs = not any(hasattr(law, "numbers") for law in joints.laws)
        if same_for_all_designs and free.shape[1] == len(joints.driven) <= 1 and joints.body not in turning:
            prescribed_body = _prescribed_body(poses, q, joints, free)
            if prescribed_body is not None:
                prescribed_bodies[joints.body] = prescribed_body
                removed |= {*joints.rows, *joints.driven}
                continue
        if free.shape[1] and _constant(poses, q, joints, free):
            guided[joints.body] = _rates_of_body(poses, joints.body, free)
            removed |= set(joints.rows)
    # A system whose whole motion is known keeps its bodies: an integrator needs unknowns.
    at_rest = sum(not free.shape[1] for free in guided.values())
    some_left = len(prescribed_bodies) + at_rest < T.bodies
    return _condensation(T, prescribed_bodies, guided, removed) if removed and some_left else None


def _null(J: Tensor) -> Tensor:
    """Null space [6, k] of J [rows, 6] in echelon form: k of its rows are the identity."""
    _, s, Vh = torch.linalg.svd(J, full_matrices=True)
    N = Vh[int((s > _ZERO * s[0]).sum()) :].T
    if not N.shape[1]:
        return N
    pivots, rest = [], N  # rows by QR with pivoting; in torch, as this may run inside a transform of torch.func
    for _ in range(N.shape[1]):
        pivots.append(int(rest.norm(dim=1).argmax()))
        row = rest[pivots[-1]] / rest[pivots[-1]].norm()
        rest = rest - (rest @ row)[:, None] * row
    N = N @ torch.linalg.inv(N[pivots])
    N[pivots] = torch.eye(len(pivots), dtype=N.dtype)
    return torch.where(N.abs() < 1e-12, 0.0, N)


def _constant(poses: _Poses, q: Tensor, joints: _GroundJoints, free: Tensor) -> bool:
    """True if the joints stay closed at poses far along the subspace free [6, k]."""
    for k, size in enumerate(_FAR):
        step = q.new_zeros(poses.T.n_v)
        step[poses.columns(joints.body)] = free @ (size * torch.cos(torch.arange(free.shape[1], dtype=q.dtype) + k))
        if float(poses.phi(poses.moved(q, step))[joints.rows].abs().max()) > _ZERO:
            return False
    return True


def _rates_of_body(poses: _Poses, body: int, free: Tensor) -> Tensor:
    """The null space free [6, k] for rates that are not divided by their sizes; k of its rows are the identity as well."""
    s, eye = poses.s[poses.columns(body)], torch.eye(free.shape[1], dtype=free.dtype)
    pivots = [int(torch.nonzero((free == unit).all(1))[0]) for unit in eye]
    return s[:, None] * free / s[pivots]


def _prescribed_body(poses: _Poses, q: Tensor, joints: _GroundJoints, free: Tensor) -> PrescribedBody | None:
    """The body with its prescribed motion; None where its joints do not stay closed at all angles of its drive."""
    T, b = poses.T, joints.body
    A, r = rotation_matrix(q[T.p_slice(b)][:, None, None])[..., 0, 0], q[T.r_slice(b)]
    if not joints.driven:
        return PrescribedBody(T.names[b], A, r, torch.zeros_like(A), r)
    rates = poses.s[poses.columns(b)] * free[:, 0]
    turning = A @ rates[3:]
    if float(turning.norm()) < _ZERO:
        return None
    axis = turning / turning.norm()
    center = r + torch.linalg.cross(axis, rates[:3] / turning.norm())
    for sign in (1.0, -1.0):
        spin = skew((sign * axis)[:, None, None])[..., 0, 0]
        prescribed_body = PrescribedBody(T.names[b], A, r, spin, center, joints.laws[0])
        if all(_closed_at(poses, q, joints, prescribed_body, angle) for angle in _FAR):
            return prescribed_body
    return None


def _closed_at(poses: _Poses, q: Tensor, joints: _GroundJoints, prescribed_body: PrescribedBody, angle: float) -> bool:
    """True if the joints are closed where the body has turned by an angle from q."""
    turned = q.clone()
    p, r = prescribed_body.turned(q.new_tensor([angle]))
    turned[poses.T.p_slice(joints.body)], turned[poses.T.r_slice(joints.body)] = p[0], r[0]
    return float(poses.phi(turned, angle)[joints.rows + joints.driven].abs().max()) < _ZERO


def _condensation(
    T: Topology, prescribed_bodies: dict[int, PrescribedBody], guided: dict[int, Tensor], removed: set[int]
) -> Condensation:
    bodies = [b for b in range(T.bodies) if b not in prescribed_bodies]
    number = {b: i for i, b in enumerate(bodies)}
    number |= {b: len(bodies) + i for i, b in enumerate([*prescribed_bodies, T.bodies])}
    rows = [i for i in range(T.rows) if i not in removed]
    parts = T.members_of(set(rows))
    used = {int(m[j]) for primitive, numbers in parts for m in primitive.members for j in numbers}
    used |= {int(i) for action in T.actions for member in action.members for i in member}
    beams = [] if T.beams is None else T.beams.ends.tolist()
    vectors = sorted(used.union(beams))
    position = {old: new for new, old in enumerate(vectors)}
    primitives = tuple(p.select(numbers, position) for p, numbers in parts)
    rates, independent = _rates(T, bodies, guided)
    topology = assemble(
        names=[T.names[b] for b in bodies],
        mode_counts=T.mode_counts,
        attached=tuple(T.attached[i] for i in vectors),
        body_of=[number[b] for b in T.vector_body[vectors].tolist()],
        primitives=primitives,
        row_names=tuple(T.row_names[i] for i in rows),
        row_joints=tuple(T.row_joints[i] for i in rows),
        actions=tuple(
            replace(a, members=tuple(torch.tensor([position[int(i)] for i in m]) for m in a.members)) for a in T.actions
        ),
        prescribed_bodies=tuple(prescribed_bodies.values()),
        rates=rates,
        beams=[position[i] for i in beams],
        turns=None if T.turns is None else T.turns.renumbered(number | {T.bodies: len(bodies)}),
    )
    return Condensation(
        T, topology, Saddle(topology), bodies, vectors, torch.tensor(rows, dtype=torch.long), independent
    )


def _rates(T: Topology, bodies: list[int], guided: dict[int, Tensor]) -> tuple[Tensor | None, Tensor]:
    """`Topology.rates` (None where no body is guided), and the rows of v of the whole system that are independent."""
    rows = component_rows(T, bodies, 6)
    if not guided:
        return None, rows
    n = len(bodies)
    N = torch.eye(len(rows), dtype=torch.float64)
    dependent: list[int] = []
    for body, free in guided.items():
        columns = torch.tensor([k * n + bodies.index(body) for k in range(6)])
        unit = [
            int(torch.nonzero((free == torch.eye(free.shape[1], dtype=free.dtype)[j]).all(1))[0])
            for j in range(free.shape[1])
        ]
        if unit:  # a body that is held has none
            N[columns[:, None], columns[unit]] = free
        dependent += columns[[k for k in range(6) if k not in unit]].tolist()
    independent = [i for i in range(len(rows)) if i not in dependent]
    return N[:, independent], rows[independent]
