"""Small vibrations about a moving state: the equations of motion linearized along the motion, their coefficients frozen.

    M z'' + C z' + K z = 0            z: increments of independent coordinates
    x = N z        x' = N z' + N' z        x'' = N z'' + 2 N' z' + N'' z        Phi_q N = 0,  E N = 1

x are increments of all coordinates, of positions in ground axes, of rotations in the axes of the moving body:

    d omega = x' + omega x x        d omega' = x'' + omega x x' + omega' x x

z = E x are some of them: E selects rows. N turns with the constraints; N' and N'' follow from Phi' and Phi'', which stay zero
along any perturbed motion. M, C and K are N' times the derivative of the residual of the equations of motion along x, x' and
x'', with the multipliers of the state. So d/dt (z, z') = A(t) (z, z') is exact along the motion, to first order in z.
A state that is off the constraints by errors of the steps is projected onto them first.
Ranks, and the choice of coordinates, are those of increments divided by their sizes s (coordinate_scale.py): they do not
depend on units.
Eigenvalues of A at one time are not invariants: coordinates c(t) z have other ones. What grows over a time follows from A(t)
of all of it. About a state at rest all coordinates have the same eigenvalues.
Differentiable with respect to the state and the data.
Checked in tests/extensions/vibrations/test_moving_state.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError, one_of
from torchmbd.math.checked_numbers import list_of, scalar
from torchmbd.math.pair import Pair, cat, cross, value
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equations.topology import Topology
from torchmbd.multibody.equilibrium.coordinate_scale import coordinate_scale
from torchmbd.multibody.equilibrium.linearized import factored_inertia, null_space, unpadded_rates
from torchmbd.multibody.saddle.rank import RELATIVE
from torchmbd.results.trajectory import Trajectory

# Share of the largest part of a freedom, in increments divided by their sizes, that a coordinate has at least.
_PART = 1e-3
_ROUNDING = 1e-12  # of terms that cancel
_PROJECTIONS = 2  # onto the constraints: the second squares what the first leaves
_SAME_TIME = 1e-6  # share of the largest time: rounding of a number in single precision


@dataclass(frozen=True, eq=False)
class MovingState:
    """One design at coordinates q [n_q, 1, 1], rates v and accelerations a [n_v, 1, 1] of a motion.

    It is an observer, as in multibody/equilibrium/steady_rotation.py.
    """

    v: Tensor
    a: Tensor

    def perturbed(self, T: Topology, q: Tensor, x: Any, xd: Any, xdd: Any) -> tuple[Any, Any, Any]:
        omega, alpha = (equations.split_v(T, y)[1] for y in (self.v, self.a))
        turn, rate = (equations.split_v(T, y)[1] for y in (x, xd))
        faster = _of_rotations(T, x, cross(omega, turn))
        gyroscopic = _of_rotations(T, x, cross(omega, rate) + cross(alpha, turn))
        return equations.advance(T, q, x), self.v + xd + faster, self.a + xdd + gyroscopic

    def rows(self, T: Topology, q: Tensor, forces: Any) -> Any:
        return forces


@dataclass(frozen=True, eq=False)
class MovingLinearization:
    """The linearized equations of one design at a moving state.

    rows            of v that are the coordinates z [n]
    N, N1           [n_v, n] and its rate
    M, C, K         [n, n] of the module header
    observer, lam   the state, and its multipliers [rows, 1, 1]
    scale           sizes of the coordinates [n_v]
    violation       of the constraints by the state, which is projected onto them, as a share of the mechanism's size, and of
                    their rates [1/s]
    """

    rows: list[int]
    N: Tensor
    N1: Tensor
    M: Tensor
    C: Tensor
    K: Tensor
    observer: MovingState
    lam: Tensor
    scale: Tensor
    violation: tuple[float, float]

    @property
    def A(self) -> Tensor:
        """State matrix [2 n, 2 n] of (z, z'); DesignFailure if something moves without a mass."""
        factored_inertia(self.M.detach())
        n = len(self.rows)
        unit, none = torch.eye(n, dtype=self.M.dtype), self.M.new_zeros(n, n)
        below = torch.linalg.solve(self.M, torch.cat([self.K, self.C], 1))
        return torch.cat([torch.cat([none, unit], 1), -below])

    @classmethod
    def of(
        cls, dynamics: Any, q: Tensor, v: Tensor, t: Tensor, coordinates: Sequence[str] | None = None
    ) -> MovingLinearization:
        """Linearize `dynamics` of one design at q [n_q, 1, 1] and v [n_v, 1, 1] at time t.

        coordinates   names of rows of v, as in Topology.rate_name; None: those that `independent_rows` takes
        """
        T, data = dynamics.topology, {name: value(x) for name, x in dynamics.data.items()}
        excitation, zero = T.prescribed(t, data), q.new_zeros(T.n_v, 1, 1)
        [active] = unpadded_rates(T, data, 1)
        kept = [i for i in range(T.rows) if i not in dynamics.rank.left_out]
        plain = {name: x.detach() for name, x in data.items()}
        scale = coordinate_scale(T, plain, equations.placement(T, plain, q.detach(), excitation.values()), q.detach())[
            :, 0
        ]
        s = scale[active]
        violation = 0.0, 0.0
        for _ in range(_PROJECTIONS if kept else 0):
            step, speed, sizes = _closing(dynamics, q, v, t, active, kept, s)
            violation = max(violation[0], sizes[0]), max(violation[1], sizes[1])
            q, v = equations.advance(T, q, step), v + speed
        a, lam = _accelerations(dynamics, q, v, t)
        observer = MovingState(v, a)

        def moved(x: Any, xd: Any, xdd: Any) -> tuple[Any, Any, Any]:
            x, xd, xdd = (Pair.of(zero, y[..., None]) for y in (x, xd, xdd))
            near, v, a = observer.perturbed(T, q, x, xd, xdd)
            return equations.placement(T, data, near, excitation), v, a

        def constraint_jets(x: Tensor, xd: Tensor) -> Any:
            at, v, a = moved(x, xd, torch.zeros_like(x))
            return equations.constraint_jets(T, at, data, v, a, t)

        Phi_q = _jacobian(T, data, q, excitation)[kept][:, active] if kept else q.new_zeros(0, len(active))
        basis = null_space(Phi_q.detach(), s) / s[:, None]
        rows = independent_rows(T, active, basis) if coordinates is None else _rows(T, active, basis, coordinates)
        place = {row: i for i, row in enumerate(active.tolist())}
        E = torch.eye(len(active), dtype=q.dtype)[[place[row] for row in rows]]
        size = (Phi_q.detach() * s).norm(dim=1, keepdim=True)
        inverse = s[:, None] * torch.linalg.pinv(torch.cat([Phi_q * s / size, E]), rtol=RELATIVE)

        def full(x: Tensor) -> Tensor:
            return x.new_zeros(T.n_v, x.shape[1]).index_copy(0, active, x)

        N = full(inverse[:, len(kept) :] / scale[rows])
        none = torch.zeros_like(N)

        def closing(jet: Any) -> Tensor:
            """Increments that take back a change of constraints, at coordinates that stay."""
            return full(-inverse[:, : len(kept)] @ (jet.tangent[..., 0][kept] / size)) if kept else none

        N1 = closing(constraint_jets(N, none).velocity) if kept else none
        N2 = closing(constraint_jets(N, N1).acceleration) if kept else none

        def along(x: Tensor, xd: Tensor, xdd: Tensor) -> Tensor:
            at, v, a = moved(x, xd, xdd)
            still = Pair.of(lam, lam.new_zeros(T.rows, x.shape[1], 1))
            return N.T @ equations.dynamic_residual(T, data, at, v, a, still).tangent[..., 0]

        M = along(none, none, N)
        C = _sum([along(none, N, none), along(none, none, 2.0 * N1)])
        K = _sum([along(N, none, none), along(none, N1, none), along(none, none, N2)])
        return cls(rows, N, N1, M, C, K, observer, lam, scale, violation)


def time_index(motion: Trajectory, time: float | None, name: str = "state") -> int:
    """The number of a time [s] among those of a motion, an argument `name`; None: the last. InputError for others, and for
    motions in phases."""
    if not motion.is_single:
        raise InputError(
            name,
            allowed="a motion without phases, which may start at the end of another motion",
            state="is a motion in phases",
        )
    if time is None:
        return len(motion.t) - 1
    t, x = motion.t.detach(), scalar("time", time, "a finite number", " s")
    k = int((t - x).abs().argmin())
    if abs(float(t[k]) - x) > _SAME_TIME * float(t.abs().max()):
        raise InputError("time", time, f"one of the {len(t)} times of the {name}, the nearest is {float(t[k])!r}")
    return k


def _sum(terms: list[Tensor]) -> Tensor:
    """The sum of terms; zero where they cancel but for rounding, as in a free motion. Derivatives need not cancel there."""
    total, size = torch.stack(terms).sum(0), torch.stack(terms).detach().abs().sum(0)
    return torch.where(total.detach().abs() <= _ROUNDING * size, total - total.detach(), total)


def _jacobian(T: Topology, data: Any, q: Tensor, excitation: Any) -> Tensor:
    """Phi_q [rows, n_v] at coordinates q [n_q, 1, 1]."""
    near = equations.advance(T, q, Pair.of(q.new_zeros(T.n_v, 1, 1), T.coupling.directions[..., None]))
    phi = equations.constraints(T, equations.placement(T, data, near, excitation))
    return T.coupling.matrix(phi.tangent[..., 0], True)


def _closing(
    dynamics: Any, q: Tensor, v: Tensor, t: Tensor, active: Tensor, kept: list[int], s: Tensor
) -> tuple[Tensor, Tensor, list[float]]:
    """Increments of q and v [n_v, 1, 1] that close what steps left open of the constraints and their rates, and the largest
    of each as a share of what increments by the sizes s [active] of the coordinates open."""
    T, data = dynamics.topology, {name: value(x) for name, x in dynamics.data.items()}
    excitation = T.prescribed(t, data)
    J = _jacobian(T, data, q, excitation)[kept][:, active] * s
    size = J.detach().norm(dim=1, keepdim=True)
    back = s[:, None] * torch.linalg.pinv(J / size, rtol=RELATIVE)
    jets = equations.constraint_jets(T, equations.placement(T, data, q, excitation), data, v, torch.zeros_like(v), t)
    open_by = [x[kept, :, 0] / size for x in (jets.value, jets.velocity)]
    step, speed = (v.new_zeros(T.n_v, 1, 1).index_copy(0, active, -(back @ x)[..., None]) for x in open_by)
    return step, speed, [float(x.detach().abs().max()) for x in open_by]


def _accelerations(dynamics: Any, q: Tensor, v: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Accelerations and multipliers, without the stabilization, which answers to errors of the steps."""
    T = dynamics.topology

    def residual(data: Any, at: Any, q: Any, v: Any, x: Tensor) -> Any:
        return equations.stabilized_residual(T, data, at, v, x[: T.n_v], x[T.n_v :], T.law_jets(t, data), 0.0)

    x = dynamics.solve_linear(residual, t, q, v)
    return x[: T.n_v], dynamics.zero_left_out(x[T.n_v :])


def independent_rows(T: Topology, active: Tensor, basis: Tensor) -> list[int]:
    """Rows of v that are independent coordinates of a null space [active, n] of increments divided by their sizes: modes,
    then rotations, then displacements, of each kind the row with the largest part of its own first."""
    n = basis.shape[1]
    rest, rows = basis.clone(), []
    for kind in (active >= 6 * T.bodies, active >= 3 * T.bodies, active >= 0):
        while len(rows) < n:
            parts = torch.where(kind, rest.norm(dim=1), -1.0)
            best = int(parts.argmax())
            if float(parts[best]) < _PART * float(basis.abs().max()):
                break
            direction = rest[best] / rest[best].norm()
            rest = rest - (rest @ direction)[:, None] * direction
            rows.append(int(active[best]))
    return sorted(rows)


def _rows(T: Topology, active: Tensor, basis: Tensor, coordinates: Sequence[str]) -> list[int]:
    """Rows of v by their names, which are as many as the degrees of freedom and independent."""
    names = {T.rate_name(row): (row, i) for i, row in enumerate(active.tolist())}
    chosen = list_of("coordinates", coordinates, str, "names of increments, such as \"rotation z of 'bob'\"")
    places = [names[one_of("coordinates", name, names)] for name in chosen]
    n = basis.shape[1]
    part = basis[[i for _, i in places]]
    if len(set(places)) != n or len(places) != n or float(torch.linalg.svdvals(part)[-1] if n else 1.0) < RELATIVE:
        proper = [T.rate_name(row) for row in independent_rows(T, active, basis)]
        raise InputError("coordinates", chosen, f"{n} independent coordinates, such as {proper!r}")
    return [row for row, _ in places]


def _of_rotations(T: Topology, like: Any, turns: Any) -> Any:
    """Rates [n_v, ...] of rotations [3, bodies, ...], zero elsewhere."""
    dr, _, dw = equations.split_v(T, like)
    return cat([x.flatten(0, 1) for x in (0.0 * dr, turns, 0.0 * dw)])
