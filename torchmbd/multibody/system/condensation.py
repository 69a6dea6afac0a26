"""Condensation: joints to the ground that hold a rigid body simply are solved once and for all, not in every step.

    driven or held   the joints to the ground leave a rigid body nothing but its drive: its motion is known, it becomes a
                     prescribed body like the ground itself
    guided           the joints to the ground leave it a constant subspace N of rates, v = N u (a slider on a prismatic
                     joint, a wheel that turns about its origin): their rows and the rates across N go

Exact: what is left is the same motion with fewer unknowns; the slider-crank has 22 of 44. Whether a subspace or the
turn of a drive satisfies the joints everywhere and not only at the start is tried at poses far away.
The whole motion, and the multipliers of the rows that went, follow on demand (expansion.py, reactions.py).
Over 300 lines: both kinds are found by the same trial poses.
Checked in tests/multibody/system/test_condensation.py: against the same system with nothing condensed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchmbd.math.rotation import rotation_matrix, skew
from torchmbd.multibody.joints.primitive import Primitive, values_at
from torchmbd.multibody.system import equations
from torchmbd.multibody.system.arrangement import assemble
from torchmbd.multibody.system.prescribed_body import PrescribedBody
from torchmbd.multibody.system.saddle import Saddle
from torchmbd.multibody.system.topology import Topology

_HELD = 1e-9  # [m] or [-]: violation of a row that counts as none, and share of a singular value that counts as zero
_FAR = (0.4, -1.1, 2.3)  # [rad] or [m]: where subspaces and turns are tried
_STEPS = 20  # of Newton's method


@dataclass(frozen=True, eq=False)
class Condensation:
    """What is left of a topology.

    bodies, vectors, rows  what is left of the whole, in its order
    independent            rows of the whole v that are the independent rates
    """

    whole: Topology
    topology: Topology
    saddle: Saddle
    bodies: list[int]
    vectors: list[int]
    rows: Tensor
    independent: Tensor

    def data(self, data: equations.Data) -> equations.Data:
        """Data of what is left."""
        bent = [i for i in self.vectors if i < self.whole.attached_flexible]
        kept = {name: (axis, self.vectors if name == "x" else bent) for name, axis in equations.ATTACHED.items()}
        kept |= {name: (rank, self.bodies) for name, rank in equations.INERTIA.items()}

        def pick(name: str, x: Any) -> Any:
            return x.index_select(kept[name][0], torch.tensor(kept[name][1], dtype=torch.long)) if name in kept else x

        return {name: pick(name, x) for name, x in data.items()}

    def retained(self, q: Any, v: Any) -> tuple[Any, Any]:
        """Coordinates [n_q, ...] and independent rates [n_v, ...] out of those of the whole."""
        return q.index_select(0, component_rows(self.whole, self.bodies, 7)), v.index_select(0, self.independent)

    def retained_state(self, x: Any) -> Any:
        """The state (integrate/step.py) of what is left."""
        q, v = self.retained(x.q, x.v)
        vd, a = (y.index_select(0, self.independent) for y in (x.vd, x.a))
        return type(x)(q, v, vd, a, x.lam.index_select(0, self.rows))


def component_rows(T: Topology, bodies: list[int], each: int) -> Tensor:
    """Rows of some bodies, `each` of every one, and of all modes."""
    modal = range(T.modes * T.flexible)
    return torch.tensor(
        [k * T.bodies + b for k in range(each) for b in bodies] + [each * T.bodies + a for a in modal], dtype=torch.long
    )


@dataclass
class _Hold:
    """Rows that join one rigid body to the ground, and nothing else to anything."""

    body: int
    rows: list[int]  # without a law
    driven: list[int]
    laws: list[Any]


def _holds(T: Topology) -> list[_Hold]:
    # A body with applied forces keeps its equations of motion: the forces may depend on its rates.
    loaded = set() if T.action_vectors is None else set(T.vector_body[T.action_vectors].tolist())
    loaded |= set() if T.beams is None else set(T.beams.bodies)
    holds = {b: _Hold(b, [], [], []) for b in range(T.flexible, T.bodies) if b not in loaded}
    placed = T.placed  # what holds in one design need not in another
    for primitive, rows in T.row_slices():
        n = len(primitive.members[0])
        bodies = torch.stack([T.vector_body[m] for m in primitive.members]).T.tolist()
        for j, on in enumerate(bodies):
            moving = {b for b in on if b < T.bodies}
            if len(moving) != 1 or (hold := holds.get(min(moving))) is None:
                continue
            if placed.intersection(int(m[j]) for m in primitive.members):
                del holds[min(moving)]
                continue
            mine = [rows.start + c * n + j for c in range(primitive.rows)]
            if primitive.driven:
                hold.driven += mine
                hold.laws.append(primitive.data[j])
            else:
                hold.rows += mine
    return [hold for hold in holds.values() if hold.rows]


class _Poses:
    """Constraints of undeformed bodies at any pose."""

    def __init__(self, T: Topology):
        self.T = T
        x = torch.stack([attached.vector for attached in T.attached], 1)[..., None, None]
        self.data = {"x": x, "Y": x.new_zeros(3, T.modes, T.attached_flexible, 1, 1)}

    def phi(self, q: Tensor, angle: float = 0.0) -> Tensor:
        """Violations [rows] at q [n_q], laws ahead of their start by an angle."""
        start = q.new_zeros(1)

        def ahead(p: Primitive) -> tuple | None:
            values = [values_at(law, start)[0] + angle for law in p.data] if p.driven else []
            return p.drive(torch.stack(values)[:, None, None]) if values else None

        laws = [ahead(p) for p in self.T.primitives]
        given = self.T.prescribed(start[0])._replace(laws=laws)
        return equations.constraints(self.T, equations.placement(self.T, self.data, q[:, None, None], given))[:, 0, 0]

    def moved(self, q: Tensor, step: Tensor) -> Tensor:
        """q after an increment [n_v]."""
        return equations.advance(self.T, q[:, None, None], step[:, None, None])[:, 0, 0]

    def jacobian(self, q: Tensor) -> Tensor:
        """[rows, n_v]."""
        jacobian: Any = torch.func.jacfwd(lambda step: self.phi(self.moved(q, step)))
        return jacobian(q.new_zeros(self.T.n_v))

    def columns(self, body: int) -> list[int]:
        """Rates of a body."""
        return [k * self.T.bodies + body for k in range(6)]

    def closed(self, q: Tensor, holds: list[_Hold]) -> Tensor:
        """q with the held bodies where their joints to the ground want them."""
        rows = [i for hold in holds for i in hold.rows + hold.driven]
        columns = [i for hold in holds for i in self.columns(hold.body)]
        for _ in range(_STEPS):
            phi = self.phi(q)[rows]
            if float(phi.abs().max()) < 1e-14:
                break
            step = q.new_zeros(self.T.n_v)
            step[columns] = -torch.linalg.pinv(self.jacobian(q)[rows][:, columns], rtol=1e-10) @ phi
            q = self.moved(q, step)
        return q


@torch.no_grad()  # what is held is a matter of the numbers; no design moves it
def condense(T: Topology, q: Tensor) -> Condensation | None:
    """The condensation of a topology with approximate initial positions q [n_q]; None if nothing can go."""
    holds = _holds(T)
    if not holds:
        return None
    poses = _Poses(T)
    q = poses.closed(q, holds)
    J = poses.jacobian(q)
    prescribed_bodies: dict[int, PrescribedBody] = {}
    guided: dict[int, Tensor] = {}
    gone: set[int] = set()
    for hold in holds:
        if float(poses.phi(q)[hold.rows + hold.driven].abs().max()) > _HELD:
            continue  # cannot close: the initial conditions say so
        free = _null(J[hold.rows][:, poses.columns(hold.body)])
        known = not any(hasattr(law, "numbers") for law in hold.laws)  # the same motion in every design
        if known and free.shape[1] == len(hold.driven) <= 1:
            prescribed_body = _prescribed_body(poses, q, hold, free)
            if prescribed_body is not None:
                prescribed_bodies[hold.body] = prescribed_body
                gone |= {*hold.rows, *hold.driven}
                continue
        if free.shape[1] and _constant(poses, q, hold, free):
            guided[hold.body] = free
            gone |= set(hold.rows)
    # A system whose whole motion is known keeps its bodies: an integrator needs unknowns.
    return _condensation(T, prescribed_bodies, guided, gone) if gone and len(prescribed_bodies) < T.bodies else None


def _null(J: Tensor) -> Tensor:
    """Null space [6, k] in echelon form: the identity in k of its rows."""
    _, s, Vh = torch.linalg.svd(J, full_matrices=True)
    N = Vh[int((s > _HELD * s[0]).sum()) :].T
    if not N.shape[1]:
        return N
    pivots, left = [], N  # rows by QR with pivoting, without NumPy: a transform of torch.func may be under way
    for _ in range(N.shape[1]):
        pivots.append(int(left.norm(dim=1).argmax()))
        row = left[pivots[-1]] / left[pivots[-1]].norm()
        left = left - (left @ row)[:, None] * row
    N = N @ torch.linalg.inv(N[pivots])
    N[pivots] = torch.eye(len(pivots), dtype=N.dtype)
    return torch.where(N.abs() < 1e-12, 0.0, N)


def _constant(poses: _Poses, q: Tensor, hold: _Hold, free: Tensor) -> bool:
    """Whether the joints hold wherever the subspace leads."""
    for k, size in enumerate(_FAR):
        step = q.new_zeros(poses.T.n_v)
        step[poses.columns(hold.body)] = free @ (size * torch.cos(torch.arange(free.shape[1], dtype=q.dtype) + k))
        if float(poses.phi(poses.moved(q, step))[hold.rows].abs().max()) > _HELD:
            return False
    return True


def _prescribed_body(poses: _Poses, q: Tensor, hold: _Hold, free: Tensor) -> PrescribedBody | None:
    """The body with a prescribed motion, if its joints hold at any angle of its drive."""
    T, b = poses.T, hold.body
    A, r = rotation_matrix(q[T.p_slice(b)][:, None, None])[..., 0, 0], q[T.r_slice(b)]
    if not hold.driven:
        return PrescribedBody(T.names[b], A, r, torch.zeros_like(A), r)
    turning = A @ free[3:, 0]
    if float(turning.norm()) < _HELD:
        return None
    axis = turning / turning.norm()
    center = r + torch.linalg.cross(axis, free[:3, 0] / turning.norm())
    for sign in (1.0, -1.0):
        spin = skew((sign * axis)[:, None, None])[..., 0, 0]
        prescribed_body = PrescribedBody(T.names[b], A, r, spin, center, hold.laws[0])
        if all(_holds_at(poses, q, hold, prescribed_body, angle) for angle in _FAR):
            return prescribed_body
    return None


def _holds_at(poses: _Poses, q: Tensor, hold: _Hold, prescribed_body: PrescribedBody, angle: float) -> bool:
    turned = q.clone()
    p, r = prescribed_body.turned(q.new_tensor([angle]))
    turned[poses.T.p_slice(hold.body)], turned[poses.T.r_slice(hold.body)] = p[0], r[0]
    return float(poses.phi(turned, angle)[hold.rows + hold.driven].abs().max()) < _HELD


def _condensation(
    T: Topology, prescribed_bodies: dict[int, PrescribedBody], guided: dict[int, Tensor], gone: set[int]
) -> Condensation:
    bodies = [b for b in range(T.bodies) if b not in prescribed_bodies]
    number = {b: i for i, b in enumerate(bodies)}
    number |= {b: len(bodies) + i for i, b in enumerate([*prescribed_bodies, T.bodies])}
    rows = [i for i in range(T.rows) if i not in gone]
    parts, used = [], set()
    for primitive, own in T.row_slices():
        n = len(primitive.members[0])
        kept = [j for j in range(n) if own.start + j not in gone]
        if kept:
            parts.append((primitive, kept))
            used |= {int(m[j]) for m in primitive.members for j in kept}
    used |= {int(i) for action in T.actions for member in action.members for i in member}
    beams = [] if T.beams is None else T.beams.ends.tolist()
    vectors = sorted(used.union(beams))
    place = {old: new for new, old in enumerate(vectors)}
    primitives = tuple(
        type(p)(
            tuple(torch.tensor([place[int(m[j])] for j in kept]) for m in p.members),
            tuple(p.data[j] for j in kept),
        )
        for p, kept in parts
    )
    rates, independent = _rates(T, bodies, guided)
    topology = assemble(
        [T.names[b] for b in bodies],
        T.own_modes,
        tuple(T.attached[i] for i in vectors),
        [number[b] for b in T.vector_body[vectors].tolist()],
        primitives,
        tuple(T.row_names[i] for i in rows),
        tuple(T.row_joints[i] for i in rows),
        tuple(
            replace(a, members=tuple(torch.tensor([place[int(i)] for i in m]) for m in a.members)) for a in T.actions
        ),
        tuple(prescribed_bodies.values()),
        rates,
        [place[i] for i in beams],
    )
    return Condensation(
        T, topology, Saddle(topology), bodies, vectors, torch.tensor(rows, dtype=torch.long), independent
    )


def _rates(T: Topology, bodies: list[int], guided: dict[int, Tensor]) -> tuple[Tensor | None, Tensor]:
    """Rates of the bodies from independent ones, and which rows of the whole v these are."""
    rows = component_rows(T, bodies, 6)
    if not guided:
        return None, rows
    n = len(bodies)
    N = torch.eye(len(rows), dtype=torch.float64)
    dropped: list[int] = []
    for body, free in guided.items():
        own = torch.tensor([k * n + bodies.index(body) for k in range(6)])
        unit = [int(torch.nonzero((free == torch.eye(free.shape[1])[j]).all(1))[0]) for j in range(free.shape[1])]
        N[own[:, None], own[unit]] = free
        dropped += own[[k for k in range(6) if k not in unit]].tolist()
    kept = [i for i in range(len(rows)) if i not in dropped]
    return N[:, kept], rows[kept]
