"""The equations of motion of a system of rigid and flexible bodies: the one text from which everything derives.

For each body, with b = x + t w + 1/2 w' f w the position and r w the rotation of a node in the body frame, om the angular
velocity (f: of bodies with stiffening, else zero):

    Z = ~om' + ~om ~om                         acceleration of a body-fixed vector b is A Z b
    force    m r'' + A (Z S + s w'' + 2 ~om s w' + w' F1 w')                                           ground axes
    torque   axial(Z P + G w'' + 2 ~om G w' + w' F2 w') + S x A'r'' + mu om' + R1 w'' + om x R1 w'      body axes
    modes    s' A'r'' + R1' om' + Z : G + w'' + om . H w' + Kr w + 1/2 w' K2 w + D w'

    s = S1 + F1 w                              sum m (t + f w)
    S = S0 + S1 w + 1/2 w' F1 w                sum m b
    G = C0 + C1 w + F2 w                       sum m (t + f w) b'    [3, 3, modes]
    P = P0 + (C0 w)' + G w                     sum m b b', its part with F2 halved and symmetric; these by moments.py
    H                                          sum m t x t + mu r x r (antisymmetric in the modes)
    F1, F2                                     sum m f, sum m f x'   (multibody/bodies/stiffening.py)
    K2                                         of bodies with quadratic stiffness, symmetric: energy 1/6 K2 www

The terms with F1 and F2 in the modes are stiffness by the accelerations of the frame; those in force and torque make the mass
matrix symmetric: all come from one kinetic energy, exact to the second order in w and w', so energy is conserved. Of higher
order is 1/2 |V w'|^2 - 1/2 |V0 w'|^2 in it, V = V0 + V1 w = L^-1 (X0 + X1 w): L L' is the rigid inertia of the undeformed body,
X0 + X1 w = (s; axial of G without C1, and R1) couples it with the modes. It takes f for a rigid motion and keeps the mass
matrix definite where the modes leave little mass to the frame.

set equal to the applied forces minus Phi_q' lam: eqs. (5)-(9) of the paper, with the nodal sums of eq. (2) replaced by
inertia invariants. Gravity g enters as r'' - g. Rotary inertia of a node is isotropic (lumped), modes are normalized to
the mass matrix. `Kr` is full: the modes may be rotated among themselves.

Every function takes tensors or pairs, components first, lanes last (math/pair.py): values, design tangents, the
index-1 right-hand side and the structural integrator all come from here. The number of operators does not grow with
the number of bodies or joints.
Checked in tests/multibody/equations/test_equations.py (direct nodal sums), tests/physics/ (energy, momentum).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchmbd.math.jet import Jet
from torchmbd.math.pair import cat, contract, cross, dot, linear, matmul, matvec, matvec_t, value
from torchmbd.math.rotation import axial, euler_rates, exponential, quaternion_product, rotation_matrix, skew
from torchmbd.multibody.equations import beams, turns
from torchmbd.multibody.equations.data import Data
from torchmbd.multibody.equations.moments import bent_stiffness, frame_terms, moments
from torchmbd.multibody.equations.topology import Prescribed, Topology


@dataclass
class Placement:
    """Where everything is: rotations of the bodies and the attached vectors.

    A     [3, 3, bodies + prescribed bodies]   rotations, the ground last
    w     [modes, flexible]
    A_of  [3, 3, vectors]      rotation of the body of each vector
    rho   [3, vectors]         vectors in body axes
    g     [3, vectors]         vectors in ground axes; points include the origin of their body
    Y    [3, modes, vectors of flexible bodies]  their derivatives with respect to w; None without any
    arguments                  the same, for each argument of each kind of primitive
    drives                     what the laws prescribe at this time, and counted angles, for each kind of primitive
    t                          the time
    """

    A: Any
    w: Any
    A_of: Any
    rho: Any
    g: Any
    arguments: list[list[Any]]
    drives: list[tuple | None]
    t: Any = None
    Y: Any = None

    def map(self, f: Callable[[Any], Any]) -> Placement:
        """The same with f(x) of all numbers."""
        A, w, A_of, rho, g = (f(x) for x in (self.A, self.w, self.A_of, self.rho, self.g))
        Y = None if self.Y is None else f(self.Y)
        arguments = [[f(x) for x in vectors] for vectors in self.arguments]
        drives: list[tuple | None] = [drive and tuple(f(x) for x in drive) for drive in self.drives]
        return Placement(A, w, A_of, rho, g, arguments, drives, self.t, Y)

    def values(self) -> Placement:
        """The same without tangents."""
        return self.map(value)


def split_q(T: Topology, q):
    """r [3, bodies], p [4, bodies], w [modes, flexible] of the coordinates."""
    n = T.bodies
    return (
        q[: 3 * n].unflatten(0, (3, n)),
        q[3 * n : 7 * n].unflatten(0, (4, n)),
        _modal(T, q).unflatten(0, (T.modes, T.flexible)),
    )


def _modal(T: Topology, q):
    """The rows of q with modal coordinates."""
    return q[7 * T.bodies :] if T.turns is None else q[7 * T.bodies : 7 * T.bodies + T.modes * T.flexible]


def counted_angles(T: Topology, q):
    """The rows of q with angles that count full turns (turns.py)."""
    return q[7 * T.bodies + T.modes * T.flexible :]


def split_v(T: Topology, v):
    """r' or r'' [3, bodies], omega or its rate [3, bodies], w' or w'' [modes, flexible]."""
    n = T.bodies
    if T.spread is not None:
        v = T.spread(v)
    return (
        v[: 3 * n].unflatten(0, (3, n)),
        v[3 * n : 6 * n].unflatten(0, (3, n)),
        v[6 * n :].unflatten(0, (T.modes, T.flexible)),
    )


def placement(T: Topology, data: Data, q, excitation: Prescribed) -> Placement:
    """Rotations and attached vectors at the coordinates q [n_q, ...]; `excitation` by Topology.prescribed."""
    r, p, w = split_q(T, q)
    A, r = cat([rotation_matrix(p), excitation.A], 2), cat([r, excitation.r], 1)
    rho, Y = data["x"], None
    if T.attached_flexible:
        Y = data["Y"]
        bent = _modal_vector(T, Y, w)
        if "E" in data:
            turned = _quadratic_rows(T, data, w)
            bent, Y = bent + 0.5 * _modal_vector(T, turned, w), Y + turned
        n = T.attached_flexible
        rho = cat([rho[:, :n] + bent, rho[:, n:]], 1) if n < T.vectors else rho + bent
    A_of = A.index_select(2, T.vector_body)
    g = matvec(A_of, rho) + r.index_select(1, T.vector_origin)
    drives = excitation.laws if T.turns is None else _with_turns(T, excitation.laws, counted_angles(T, q))
    return Placement(A, w, A_of, rho, g, T.arguments(g), drives, excitation.t, Y)


def _with_turns(T: Topology, laws: list[tuple | None], tau) -> list[tuple | None]:
    """What laws prescribe, and behind it the counted angles tau of kinds that have angles."""
    return [
        (*(law or ()), *(tau.index_select(0, index) for index in p.turns)) if p.angles else law
        for p, law in zip(T.primitives, laws, strict=True)
    ]


def _quadratic_rows(T: Topology, data: Data, w):
    """E w: the change of the rows Y of attached vectors by bending, [3, modes, vectors]."""
    return contract(data["E"], w.index_select(1, T.vector_flexible), 2)


def _modal_vector(T: Topology, Y, w):
    """Elastic part of the attached vectors of flexible bodies, Y w: [3, vectors]."""
    return contract(Y, w.index_select(1, T.vector_flexible), 1)


def inertia_forces(T: Topology, data: Data, at: Placement, v, a):
    """Inertia and elastic forces: ground forces [3, bodies], body torques [3, bodies], modal forces [modes, flexible].

    a holds the accelerations [n_v, ...]; zero for the velocity-dependent part alone.
    """
    n, f = T.bodies, T.flexible
    rdd, omd, wdd = split_v(T, a)
    _, om, wd = split_v(T, v)
    if "gravity" in data:
        rdd = rdd - data["gravity"]
    A, w = at.A[:, :, :n], at.w
    spin = skew(om)
    Z = skew(omd) + matmul(spin, spin)
    u = matvec_t(A, rdd)
    if not f:
        S = data["S0"]
        force = data["mass"] * rdd + matvec(A, matvec(Z, S))
        return force, axial(matmul(Z, data["P0"])) + cross(S, u) + data["mu"] * omd, linear(torch.zeros_like, w)
    spin_f, Z_f, u_f, om_f, omd_f = spin[:, :, :f], Z[:, :, :f], u[:, :f], om[:, :f], omd[:, :f]
    S, P, G, SR, V = moments(T, data, w)
    rates = cat([wd.unsqueeze(1), wdd.unsqueeze(1)], 1)  # [modes, 2, flexible]
    sr = contract(SR.unsqueeze(2), rates, 1)  # [6, 2, flexible]
    gg = contract(G.unsqueeze(3), rates, 2)  # [3, 3, 2, flexible]
    h = matvec(Z, S)
    extra = sr[:3, 1] + 2.0 * matvec(spin_f, sr[:3, 0])
    Y = matmul(Z, P)
    extra_Y = gg[:, :, 1] + 2.0 * matmul(spin_f, gg[:, :, 0])
    turn = sr[3:, 1] + cross(om_f, sr[3:, 0])
    if V is not None:
        drift = matvec(contract(data["V1"], wd, 2), wd)
        F1_wd_wd, axial_F2_wd_wd = frame_terms(data, drift.unsqueeze(1))
        extra, turn = extra + F1_wd_wd[:, 0], turn + axial_F2_wd_wd[:, 0]
    torque = cross(S, u) + data["mu"] * omd
    if f < n:
        h = cat([h[:, :f] + extra, h[:, f:]], 1)
        Y = cat([Y[:, :, :f] + extra_Y, Y[:, :, f:]], 2)
        torque = cat([torque[:, :f] + turn, torque[:, f:]], 1)
    else:
        h, Y, torque = h + extra, Y + extra_Y, torque + turn
    coriolis = contract(data["H"], om_f[:, None, None] * wd, (0, 2))
    modal = (
        matvec_t(SR, cat([u_f, omd_f])) + contract(Z_f.unsqueeze(2), G, (0, 1)) + wdd + coriolis + matvec(data["Kr"], w)
    )
    if V is not None:
        V0 = data["V0"]
        modal = modal + matvec_t(V, matvec(V, wdd) + drift) - matvec_t(V0, matvec(V0, wdd))
    if "K2" in data:
        modal = modal + 0.5 * matvec(bent_stiffness(data, w), w)
    if "D" in data:
        modal = modal + matvec(data["D"], wd)
    return data["mass"] * rdd + matvec(A, h), axial(Y) + torque, modal


def constraints(T: Topology, at: Placement):
    """Violations of all constraint equations Phi [rows, ...]."""
    return cat([p.phi(x, d).flatten(0, 1) for p, x, d in zip(T.primitives, at.arguments, at.drives, strict=True)])


def constraint_jets(T: Topology, at: Placement, data: Data, v, a, t: Tensor) -> Jet:
    """Phi, Phi' and Phi'' [rows, ...] at time t with the accelerations a: Phi'' = Phi_q a - gamma."""
    return driven_jets(T, at, data, v, a, T.law_jets(t, data))


def constraint_rates(T: Topology, at: Placement, data: Data, v, t: Tensor) -> Any:
    """Phi' [rows, ...] at time t: Phi_q v + Phi_t."""
    return driven_jets(T, at, data, v, None, T.law_jets(t, data)).velocity


def constraint_changes(T: Topology, at: Placement, data: Data, y) -> Any:
    """Phi_q y [rows, ...]: as `constraint_rates`, of laws that stand still."""
    drives: list[tuple | None] = [
        drive and tuple(Jet(x, 0.0 * x) for x in drive[: p.driven])
        for p, drive in zip(T.primitives, at.drives, strict=True)
    ]
    return driven_jets(T, at, data, y, None, drives).velocity


def driven_jets(T: Topology, at: Placement, data: Data, v, a, drives: list[tuple | None]) -> Jet:
    """The jets of constraints for laws that are known with their slopes; a None: of first order.

    Of systems whose only prescribed body is the ground: a condensed one starts from the state of the whole.
    """
    assert not T.prescribed_bodies
    vectors = Jet(at.g, vector_velocities(T, at, data, v)) if a is None else vector_jets(T, at, data, v, a)
    parts = [T.arguments(part) for part in vectors.parts]
    phi = []
    for i, (primitive, law) in enumerate(zip(T.primitives, drives, strict=True)):
        drive = (*(law or ()), *(at.drives[i] or ())[primitive.driven :]) if primitive.angles else law
        members = [Jet(*x) for x in zip(*(part[i] for part in parts), strict=True)]
        phi.append(primitive.phi(members, drive).map(lambda x: x.flatten(0, 1)))
    return Jet(*(cat(list(part)) for part in zip(*(jet.parts for jet in phi), strict=True)))


def stabilized_residual(T: Topology, data: Data, at: Placement, v, a, lam, drives: list[tuple | None], rate: Any):
    """Equations of motion above the accelerations of the constraints, stabilized: [n_v + rows, ...]; eq. (9).

    Phi'' + 2 alpha Phi' + alpha^2 Phi with alpha = `rate` [1/s].
    """
    forces = dynamic_residual(T, data, at, v, a, lam)
    if not T.rows:
        return forces
    phi = driven_jets(T, at, data, v, a, drives)
    return cat([forces, phi.acceleration + (2.0 * rate) * phi.velocity + (rate * rate) * phi.value])


def vector_jets(T: Topology, at: Placement, data: Data, v, a) -> Jet:
    """Attached vectors in ground axes with their velocities and accelerations [3, vectors, ...]."""
    rd, om, wd = split_v(T, v)
    rdd, omd, wdd = split_v(T, a)
    spin = skew(om)
    Z = skew(omd) + matmul(spin, spin)
    spin, Z = (_with_prescribed(T, x, 2).index_select(2, T.vector_body) for x in (spin, Z))
    rd, rdd = (_with_prescribed(T, x, 1).index_select(1, T.vector_origin) for x in (rd, rdd))
    velocity, acceleration = matvec(spin, at.rho), matvec(Z, at.rho)
    n = T.attached_flexible
    if n:
        slow, fast = _modal_vector(T, at.Y, wd), _modal_vector(T, at.Y, wdd)
        fast = fast + 2.0 * matvec(spin[:, :, :n], slow)
        if "E" in data:
            fast = fast + _modal_vector(T, _quadratic_rows(T, data, wd), wd)
        velocity = cat([velocity[:, :n] + slow, velocity[:, n:]], 1)
        acceleration = cat([acceleration[:, :n] + fast, acceleration[:, n:]], 1)
    return Jet(at.g, rd + matvec(at.A_of, velocity), rdd + matvec(at.A_of, acceleration))


def vector_velocities(T: Topology, at: Placement, data: Data, v):
    """Velocities of the attached vectors [3, vectors, ...], in ground axes; of those on prescribed bodies as if they were
    at rest."""
    rd, om, wd = split_v(T, v)
    om = _with_prescribed(T, om, 1).index_select(1, T.vector_body)
    velocity = cross(om, at.rho)
    n = T.attached_flexible
    if n:
        bending = velocity[:, :n] + _modal_vector(T, at.Y, wd)
        velocity = cat([bending, velocity[:, n:]], 1) if n < T.vectors else bending
    return _with_prescribed(T, rd, 1).index_select(1, T.vector_origin) + matvec(at.A_of, velocity)


def beam_rates(T: Topology, data: Data, at: Placement, v) -> tuple[Any, Any] | None:
    """Velocities of the attached vectors and angular velocities of their bodies; None where no beam has dampers."""
    if "beam_damping" not in data:
        return None
    return vector_velocities(T, at, data, v), turns_of_vectors(T, split_v(T, v)[1])


def turns_of_vectors(T: Topology, x) -> Any:
    """Rotations, or their rates, of the bodies [3, bodies, ...] as those of attached vectors; zero on prescribed bodies."""
    return _with_prescribed(T, x, 1).index_select(1, T.vector_body)


def _with_prescribed(T: Topology, x, dim: int):
    """Append zeros for the prescribed bodies and the ground."""

    def zeros(y: Tensor) -> Tensor:
        return y.new_zeros(*y.shape[:dim], T.known_bodies, *y.shape[dim + 1 :])

    return cat([x, linear(zeros, x)], dim)


def constraint_forces(T: Topology, data: Data, at: Placement, lam):
    """Phi_q' lam: ground forces [3, bodies], body torques [3, bodies], modal forces [modes, flexible]."""
    return generalized_forces(T, data, at, force_on_vectors(T, at, lam))


def applied_on_vectors(T: Topology, data: Data, at: Placement, v, held: bool = False):
    """What the actions do to the attached vectors [3, vectors, ...], in ground axes. If `held`, strengths have no tangents."""
    states, forces = action_states(T, data, at, v), []
    for f, (_, _, direction) in zip(strengths(T, data, states, at.t), states, strict=True):
        f = value(f) if held else f
        forces += [f * d for d in direction]
    return T.action_sum(*forces)  # pyright: ignore[reportOptionalCall]


def strengths(T: Topology, data: Data, states: list[tuple], t: Any) -> list:
    """Generalized forces f [n, ...] of each kind of action, by laws and controllers."""
    law_strengths = [action.strength(s, rate, t, data) for action, (s, rate, _) in zip(T.actions, states, strict=True)]
    return T.links.strengths(states, law_strengths, t, data)


def action_states(T: Topology, data: Data, at: Placement, v) -> list[tuple]:
    """s, s' [n, ...] and the direction of each kind of action."""
    velocities = T.action_arguments(vector_velocities(T, at, data, v))
    vectors = T.action_arguments(at.g)
    return [action.state(x, xd) for action, x, xd in zip(T.actions, vectors, velocities, strict=True)]


def force_on_vectors(T: Topology, at: Placement, lam):
    """Gradient of lam . Phi by the attached vectors [3, vectors, ...], in ground axes."""
    forces = []
    for (primitive, rows), vectors, drive in zip(T.row_slices(), at.arguments, at.drives, strict=True):
        forces += primitive.forces(vectors, lam[rows].unflatten(0, (primitive.rows, -1)), drive)
    return T.vector_sum(*forces)


def generalized_forces(T: Topology, data: Data, at: Placement, force):
    """Carry the forces on attached vectors [3, vectors, ...], in ground axes, to the bodies."""
    local = matvec_t(at.A_of, force)
    both = T.body_sum(force, cross(at.rho, local))
    if T.attached_flexible:
        modal = T.modal_sum(matvec_t(at.Y, local[:, : T.attached_flexible]))
    else:
        none = T.modes, T.flexible
        modal = linear(lambda y: y.new_zeros(*none, *y.shape[2:]), force)
    return both[:, : T.bodies], both[:, T.bodies :], modal


def dynamic_residual(T: Topology, data: Data, at: Placement, v, a, lam):
    """M a + s + K q + Phi_q' lam - g  [n_v, ...]: zero along a motion; eq. (5)."""
    forces, pulls = inertia_forces(T, data, at, v, a), total_on_vectors(T, data, at, v, lam)
    resistance = None if T.beams is None else beams.resistance(T, data, at, beam_rates(T, data, at, v))
    return _gathered(T, data, at, forces, pulls, resistance)


def geometric_residual(T: Topology, data: Data, at: Placement, v, a, lam):
    """`dynamic_residual` of springs, laws and beams that keep their forces, and of bodies without elastic ones [n_v, ...].

    Its derivative by the coordinates is the geometric stiffness: of weight, pretension and constraint forces.
    """
    forces = inertia_forces(T, _without_elasticity(data, "K2"), at, v, a)
    resistance = None
    if T.beams is not None:
        e = beams.elements(T, data, at)
        resistance = beams.on_bodies(T, e._replace(force=value(e.force)))
    return _gathered(T, data, at, forces, total_on_vectors(T, data, at, v, lam, held=True), resistance)


def _gathered(T: Topology, data: Data, at: Placement, forces, pulls, resistance) -> Any:
    """The sum [n_v, ...] of forces on bodies, of those on attached vectors and of the resistance of beams."""
    if pulls is not None:
        forces = [x + y for x, y in zip(forces, generalized_forces(T, data, at, pulls), strict=True)]
    if resistance is not None:
        forces = [forces[0] + resistance[0], forces[1] + resistance[1], forces[2]]
    force = cat([x.flatten(0, 1) for x in forces])
    return force if T.gather is None else T.gather(force)


def _without_elasticity(data: Data, *names: str) -> dict[str, Any]:
    """Data of bodies without elastic forces, and without those of these names."""
    data = {name: x for name, x in data.items() if name not in names}
    return data | {"Kr": 0.0 * data["Kr"]} if "Kr" in data else data


def impulses(T: Topology, data: Data, at: Placement, dv, Lam):
    """M dv + Phi_q' Lambda [n_v, ...] of changes dv of the velocities and impulses Lambda of the constraints."""
    forces = inertia_forces(T, _without_elasticity(data, "gravity", "K2", "D"), at, 0.0 * dv, dv)
    if T.rows:
        forces = [x + y for x, y in zip(forces, constraint_forces(T, data, at, Lam), strict=True)]
    force = cat([x.flatten(0, 1) for x in forces])
    return force if T.gather is None else T.gather(force)


def along_constraints(T: Topology, data: Data, at: Placement, z, y0, r):
    """M y + Phi_q' mu above Phi_q (y - y0) - r [n_v + rows, ...], of z = (y, mu): zero where y is along M^-1 Phi_q'."""
    y, mu = z[: T.n_v], z[T.n_v :]
    return cat([impulses(T, data, at, y, mu), constraint_changes(T, at, data, y - y0) - r])


def total_on_vectors(T: Topology, data: Data, at: Placement, v, lam, held: bool = False):
    """Phi_q' lam - g on the attached vectors [3, vectors, ...]; None without any. Without rates v, of the joints alone; held:
    as in `applied_on_vectors`."""
    pulls = force_on_vectors(T, at, lam) if T.rows else None
    if not T.actions or v is None:
        return pulls
    applied = applied_on_vectors(T, data, at, v, held)
    return -applied if pulls is None else pulls - applied


def coordinate_rates(T: Topology, q, v):
    """dq/dt [n_q, ...] of the rates v."""
    _, p, _ = split_q(T, q)
    rd, om, wd = split_v(T, v)
    # |p| drifts by integration errors only; this pull keeps it at one and is zero on a motion.
    pull = (0.5 * (1.0 - dot(p, p))) * p
    rates = [rd.flatten(0, 1), (euler_rates(p, om) + 50.0 * pull).flatten(0, 1), wd.flatten(0, 1)]
    return cat(rates if T.turns is None else [*rates, turns.rates(T, counted_angles(T, q), p, om)])


def advance(T: Topology, q, step):
    """Move coordinates by an increment [n_v, ...]: rotation vectors in body axes act on the right (Lie group)."""
    r, p, w = split_q(T, q)
    dr, turn, dw = split_v(T, step)
    p = quaternion_product(p, exponential(turn))
    new = [(r + dr).flatten(0, 1), p.flatten(0, 1), (w + dw).flatten(0, 1)]
    return cat(new if T.turns is None else [*new, turns.advanced(T, counted_angles(T, q), p, turn)])
