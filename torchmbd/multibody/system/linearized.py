"""Small vibrations about a position of rest: the equations of motion linearized in the null space of the constraints.

    M x'' + C x' + K x + Phi_q' dlam = 0,  Phi_q x = 0          x: increment of the coordinates, body axes for rotations
    N' M N y'' + N' C N y' + N' K N y = 0                       N: null space of Phi_q

M from the saddle-point matrix; K and C are tangents of the residual of the equations of motion at rest, its multipliers
held, so that weight, pretension and whatever forces there are count. lam: least squares of the forces at rest.
Of a steady rotation (steady_rotation.py) x is what a turning observer sees: K has the centrifugal forces, C those of Coriolis.
Checked in tests/multibody/system/test_equilibrium.py: pendulums in closed form, a swinging beam.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.math.pair import Pair, cat, matvec_t, value
from torchmbd.multibody.system import equations
from torchmbd.multibody.system.rank import RELATIVE
from torchmbd.multibody.system.steady_rotation import SteadyRotation
from torchmbd.multibody.system.topology import Topology

_CANCELS, _EIGEN = (
    1e-10,
    1e-15,
)  # a freedom without stiffness: of terms that cancel, of the largest eigenvalue for each freedom
_ZERO_MASS = 1e-9  # of the largest
NEGATIVE_MASS = "bodies bend until their modes have a negative mass"
_GROWS = 1e-6  # real part of a pole by its size: vibrations that grow
_AT_REST = 1e-7  # of the largest frequency: zero, of a freedom without stiffness
_UNBALANCED, _ROUNDING = 100.0, 1e-11  # unsymmetric stiffness by forces that remain, by the largest stiffness: none


@dataclass(frozen=True)
class Linearization:
    """One design at rest at q [n_q]: residual forces, constraints, and their derivatives by an increment of q.

    forces [n_v] without constraints   phi [rows]   K, C [n_v, n_v] with the multipliers   Phi_q [rows, n_v]   lam [rows]
    own    rows of v that belong to bodies and to modes that they have
    N      null space of Phi_q among these [own, freedoms]
    turns  whether the state rotates steadily
    """

    forces: Tensor
    phi: Tensor
    K: Tensor
    C: Tensor
    M: Tensor
    Phi_q: Tensor
    lam: Tensor
    active: Tensor
    N: Tensor
    rotates: bool = False

    @classmethod
    def of(
        cls,
        dynamics: Any,
        q: Tensor,
        t: Tensor,
        less: tuple[Tensor, Tensor] | None = None,
        rotation: SteadyRotation | None = None,
        unstrained: Tensor | None = None,
    ) -> Linearization:
        """Linearize `dynamics` of one design at q.

        less         forces and torques, both in ground axes [n_v], and violations [rows] that are taken away
        unstrained   screws of beams' elements without force [6, n, 1, 1] in K and lam, where these are to have other forces
        """
        T = dynamics.topology
        data = {name: value(x).detach() for name, x in dynamics.data.items()}
        given = T.prescribed(t, data).values()
        still, none = q.new_zeros(T.n_v, 1, 1), q.new_zeros(T.rows, 1, 1)
        unit = Pair.of(still, torch.eye(T.n_v, dtype=q.dtype)[..., None])
        wide, near = q[:, None, None], equations.advance(T, q[:, None, None], unit)
        at, moved = (equations.placement(T, data, x, given) for x in (wide, near))
        rates, by_place, by_rate = (still, still), (still, still), (unit, still)
        if rotation is not None:
            rates, by_place = rotation.rates(T, wide), rotation.rates(T, near)
            by_rate = rates[0] + unit, rates[1] + rotation.accelerations(T, wide, unit)
        forces = equations.dynamic_residual(T, data, at, *rates, none)[:, 0, 0]
        away = None if less is None else _in_body_axes(T, moved, less[0])
        forces = forces if away is None else forces - away.value[:, 0, 0]
        phi, Phi_q = q.new_zeros(0), q.new_zeros(0, T.n_v)
        if T.rows:
            violation = equations.constraints(T, moved)
            phi, Phi_q = violation.value[:, 0, 0], violation.tangent[..., 0]
            phi = phi if less is None else phi - less[1]
        active = unpadded_rates(T)
        balanced = forces
        if unstrained is not None:
            data = data | {"beam_rest": unstrained}
            balanced = equations.dynamic_residual(T, data, at, *rates, none)[:, 0, 0]
            balanced = balanced if away is None else balanced - away.value[:, 0, 0]
        lam = -torch.linalg.pinv(Phi_q[:, active].T, rtol=RELATIVE) @ balanced[active]
        K = equations.dynamic_residual(T, data, moved, *by_place, lam[:, None, None]).tangent[..., 0]
        K = K if away is None else K - away.tangent[..., 0]
        C = _tangent(equations.dynamic_residual(T, data, at, *by_rate, lam[:, None, None]), T)
        M = dynamics.saddle.matrix(data, at)[0, : T.n_v, : T.n_v]
        return cls(forces, phi, K, C, M, Phi_q, lam, active, null_space(Phi_q[:, active]), rotation is not None)

    @property
    def unbalanced(self) -> Tensor:
        """Generalized forces that no constraint balances [own]."""
        return self.forces[self.active] + self.Phi_q[:, self.active].T @ self.lam

    def reduced(self, X: Tensor) -> Tensor:
        """N' X N of a matrix [n_v, n_v]."""
        return self.N.T @ X[self.active][:, self.active] @ self.N

    @property
    def inertia(self) -> Tensor:
        """N' M N, symmetric."""
        M = self.reduced(self.M)
        return 0.5 * (M + M.T)

    @property
    def negative_mass(self) -> bool:
        """Whether an eigenvalue of the inertia is negative; those of parts without inertia are zero."""
        found = torch.linalg.eigvalsh(self.inertia)
        return bool(len(found)) and float(found[0]) < -_ZERO_MASS * float(found[-1])

    @property
    def nonconservative(self) -> bool:
        """Whether forces without a potential, such as those that turn with a body, make the stiffness unsymmetric.

        Torques that nothing balances do so too, by half their size: where the state is none of rest that says nothing.
        """
        K = self.reduced(self.K)
        if not len(K):
            return False
        noise = _UNBALANCED * self.unbalanced.abs().max() + _ROUNDING * K.abs().max()
        return bool((K - K.T).abs().max() > noise)


@dataclass(frozen=True)
class Vibrations:
    """Of one design: frequencies [freedoms] [Hz], ascending, zero for a freedom without stiffness, nan for an unstable one;
    poles [2 freedoms] [1/s] with the damping; shapes [n_v, freedoms], increments of the coordinates of unit modal mass.

    Of a steady rotation the frequencies have Coriolis's forces, without dampers as at rest, and the lowest is nan where a pole
    grows; shapes are without these forces. Where forces turn with a body two freedoms may drive each other (flutter): both are
    nan, both shapes the real part of theirs.
    """

    frequencies: Tensor
    poles: Tensor
    shapes: Tensor

    @classmethod
    def of(cls, rest: Linearization) -> Vibrations:
        """The eigenvalue problem in the null space. InputError where displacements are too large for one."""
        if rest.negative_mass:
            raise InputError(
                f"no vibrations: {NEGATIVE_MASS}; allowed: smaller loads, more pieces (mbd.split), exact beams"
            )
        M, C, whole = rest.inertia, rest.reduced(rest.C), rest.reduced(rest.K)
        K = 0.5 * (whole + whole.T)
        inverse = torch.linalg.inv(torch.linalg.cholesky(M))
        follows = rest.nonconservative and not rest.rotates
        squares, Y = _flutter(inverse @ whole @ inverse.T) if follows else torch.linalg.eigh(inverse @ K @ inverse.T)
        n = len(squares)
        shapes = torch.zeros(len(rest.forces), n, dtype=K.dtype)
        shapes[rest.active] = rest.N @ (inverse.T @ Y)
        squares = torch.where(squares.abs() <= _rounding(rest, shapes, squares), 0.0, squares)
        # A damper that does not turn pushes a turning observer's body across its displacement: no symmetric stiffness.
        poles = _poles(M, C, whole if rest.rotates or follows else K)
        w = squares.sqrt()
        if rest.rotates and n:
            w = _poles(M, 0.5 * (C - C.T), K).imag.abs().sort().values[::2]
            w = torch.where(w > _AT_REST * w[-1], w, 0.0)
            w = torch.cat([w.new_full((1,), torch.nan), w[1:]]) if _grow(poles, w[-1]) else w
        return cls(w / (2.0 * math.pi), poles, shapes)


def _poles(M: Tensor, C: Tensor, K: Tensor) -> Tensor:
    """Of M y'' + C y' + K y = 0 [2 n]."""
    n = len(M)
    A = torch.zeros(2 * n, 2 * n, dtype=K.dtype)
    A[:n, n:] = torch.eye(n, dtype=K.dtype)
    A[n:, :n], A[n:, n:] = -torch.linalg.solve(M, K), -torch.linalg.solve(M, C)
    return torch.linalg.eigvals(A)


def _grow(poles: Tensor, largest: Tensor) -> bool:
    """Whether vibrations grow. A negative stiffness alone does not say so: Coriolis's forces may hold what it drives away.

    largest   angular frequency [rad/s], a measure of rounding; poles with dampers may be larger by orders
    """
    size = poles.abs()
    return bool(((poles.real > _GROWS * size) & (size > _AT_REST * largest)).any())


def _rounding(rest: Linearization, shapes: Tensor, squares: Tensor) -> Tensor:
    """Squares of frequencies [freedoms] below which there is no stiffness: energies that cancel, errors of the eigenvalues.

    A share of the largest square alone would take a heavy part on a light stiff shaft for one that is free.
    """
    if not len(squares):
        return squares
    terms = (shapes.abs() * (rest.K.abs() @ shapes.abs())).sum(0)
    return _CANCELS * terms + _EIGEN * len(squares) * squares.abs().nan_to_num().amax()


def _flutter(A: Tensor) -> tuple[Tensor, Tensor]:
    """Eigenvalues of an unsymmetric matrix by rising real parts, nan where they are complex, and the real parts of vectors."""
    values, vectors = torch.linalg.eig(A)
    order = values.real.argsort()
    values, Y = values[order], vectors[:, order].real
    squares = torch.where(values.imag.abs() > _GROWS * values.abs(), torch.nan, values.real)
    return squares, Y / Y.norm(dim=0)


def _in_body_axes(T: Topology, at: Any, forces: Tensor) -> Any:
    """Forces [n_v] whose torques are in ground axes, with these in body axes, at a placement."""
    n = T.bodies
    torques = matvec_t(at.A[:, :, :n], forces[3 * n : 6 * n].reshape(3, n, 1, 1)).flatten(0, 1)
    return cat([forces[: 3 * n, None, None], torques, forces[6 * n :, None, None]])


def unpadded_rates(T: Topology) -> Tensor:
    """Rows of v without the padding of bodies with fewer modes."""
    modal = [row - T.bodies for body in range(T.flexible) for row in T.w_slice(body)]
    return torch.tensor([*range(6 * T.bodies), *sorted(modal)], dtype=torch.long)


def null_space(J: Tensor) -> Tensor:
    """Orthonormal basis [n, k] of the null space of a Jacobian [rows, n]; rows scaled to length one.

    Columns that no row touches stay what they are: mixed with others, soft freedoms would drown in the rounding of stiff ones.
    """
    n = J.shape[1]
    if not len(J):
        return torch.eye(n, dtype=J.dtype)
    held = (J != 0.0).any(0)
    own = J[:, held]
    _, s, Vh = torch.linalg.svd(own / own.norm(dim=1, keepdim=True), full_matrices=True)
    among = Vh[int((s > RELATIVE * s[0]).sum()) :].T
    free = torch.eye(n, dtype=J.dtype)[:, ~held]
    basis = J.new_zeros(n, among.shape[1])
    basis[held] = among
    return torch.cat([free, basis], 1)


def _tangent(x: Any, T: Topology) -> Tensor:
    return x.tangent[..., 0] if isinstance(x, Pair) else torch.zeros(T.n_v, T.n_v, dtype=x.dtype)
