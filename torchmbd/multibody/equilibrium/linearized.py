"""Small vibrations about a position of rest: the equations of motion linearized in the null space of the constraints.

    M x'' + C x' + K x + Phi_q' dlam = 0,  Phi_q x = 0          x: increment of the coordinates, body axes for rotations
    N' M N y'' + N' C N y' + N' K N y = 0                       N: null space of Phi_q

M is a block of the saddle-point matrix; K and C are tangents of the residual of the equations of motion at rest with fixed
multipliers, so they include weight, pretension and all other forces. lam: least squares of the works of the forces at rest, or
of the accelerations of a motion that starts from rest (`released`).
Who measures x is an observer (steady_rotation.py). To one who turns with a steady rotation K has centrifugal forces, C those of
Coriolis.
Checked in tests/multibody/equilibrium/test_equilibrium.py: pendulums in closed form, a swinging beam; soft springs beside stiff
ones in test_stiff_series.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from torchmbd.errors import DesignFailure
from torchmbd.fem.reduction.padding import is_padding
from torchmbd.math.module_call import outside_transforms
from torchmbd.math.pair import Pair, cat, matvec_t, value
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equations.coupling import Coupling
from torchmbd.multibody.equations.data import Data
from torchmbd.multibody.equations.topology import Prescribed, Topology
from torchmbd.multibody.equilibrium.coordinate_scale import coordinate_scale
from torchmbd.multibody.equilibrium.steady_rotation import Observer, ObserverAtRest, SteadyRotation
from torchmbd.multibody.saddle.rank import RELATIVE

# A freedom has no stiffness below these shares: of the terms that cancel in it; for each freedom, of the largest eigenvalue.
_CANCELS, _EIGEN = 1e-10, 1e-15
_SOFT = 1e-7  # share of the largest square of an angular frequency below which its rounding shows: soft springs
_WORKS = 1e-12  # of the works of the forces of a soft vibration, whose sum is its stiffness: their rounding
_BESIDE = 1e-2  # of the largest stiffness of a body, in terms of each of its freedoms: rounding of what cancels in it
_ZERO_MASS = 1e-9  # share of the largest eigenvalue of the inertia
NEGATIVE_MASS = "bodies bend until their modes have a negative mass"
GROWS = 1e-6  # ratio of real part and size of a pole above which vibrations grow
_AT_REST = 1e-7  # share of the largest frequency below which one is zero
_UNBALANCED, _ROUNDING = 100.0, 1e-11  # unsymmetry of the stiffness that unbalanced forces and rounding may cause


@dataclass(frozen=True)
class Linearization:
    """One design at rest at q [n_q]: residual forces, constraints, and their derivatives with respect to an increment of q.

    forces [n_v], phi [rows]   residual without constraint forces; violations of constraints
    K, C, M [n_v, n_v]         stiffness and damping, both with the forces of the multipliers, and mass; C and M on demand
    Phi_q [rows, n_v], lam [rows]
    active                     rows of v but those that pad the modes of bodies and designs with fewer modes than others
    scale [n_v]                sizes of the coordinates (coordinate_scale.py)
    N [active, freedoms]       basis of the null space of the active columns of Phi_q, orthonormal in x / scale
    along                      C by "rates", M by "accelerations"
    body [active]              number of the body to which a coordinate belongs
    rotates                    whether the state rotates steadily
    coupling                   of the topology, for matrices out of products
    product                    K X by "increments", C X by "rates", and "geometric" stiffness times X [n_v, k], without the
                               matrices, in which a soft spring may be lost beside a stiff one; None: not known
    graded                     squares of angular frequencies [freedoms] and K N [n_v, freedoms] where N is the basis of
                               `in_vibrations`
    """

    forces: Tensor
    phi: Tensor
    K: Tensor
    Phi_q: Tensor
    lam: Tensor
    active: Tensor
    scale: Tensor
    N: Tensor
    along: Callable[[str], Tensor]
    body: Tensor
    rotates: bool = False
    coupling: Coupling | None = None
    product: Callable[[str, Tensor], Tensor] | None = None
    graded: tuple[Tensor, Tensor] | None = None

    @cached_property
    def C(self) -> Tensor:
        return self.along("rates")

    @cached_property
    def M(self) -> Tensor:
        return self.along("accelerations")

    @classmethod
    def of(
        cls,
        dynamics: Any,
        q: Tensor,
        t: Tensor,
        offset: tuple[Tensor, Tensor] | None = None,
        observer: Observer | None = None,
        unstrained: Tensor | None = None,
        excitation: Prescribed | None = None,
        released: bool = False,
    ) -> Linearization:
        """Linearize `dynamics` of one design at q and time t; arguments as in `each`."""
        return cls.each(dynamics, q[:, None, None], t, offset, observer, unstrained, excitation, released)[0]

    @classmethod
    def each(
        cls,
        dynamics: Any,
        q: Tensor,
        t: Tensor,
        offset: tuple[Tensor, Tensor] | None = None,
        observer: Observer | None = None,
        unstrained: Tensor | None = None,
        excitation: Prescribed | None = None,
        released: bool = False,
    ) -> list[Linearization]:
        """Linearize all lanes of `dynamics` at q [n_q, 1, lanes] and time t; equations of all lanes are evaluated at once.

        observer     of the increments, with the rates of the state; None: a state at rest
        offset       forces with torques in ground axes [n_v] and violations [rows], to be subtracted from forces and phi
        unstrained   screws [6, n, 1, 1] at which beam elements have no force in K and lam; None: those of the data
        excitation   what drives prescribe; None: their laws at time t
        released     True for a state that need not be in equilibrium: lam is that of the motion which starts from rest
                     here. It does not depend on frames and units, which least squares of forces and torques do
        """
        T = dynamics.topology
        data = {name: value(x).detach() for name, x in dynamics.data.items()}
        prescribed = T.prescribed(t, data).values() if excitation is None else excitation
        lanes = q.shape[-1]
        none, still = q.new_zeros(T.rows, 1, lanes), q.new_zeros(T.n_v, 1, lanes)
        observer = observer or ObserverAtRest()
        coupling = T.coupling
        unit = Pair.of(still, coupling.directions[..., None].expand(-1, -1, lanes))
        zero = Pair.of(still, torch.zeros_like(unit.tangent))
        near, *rates_moved = observer.perturbed(T, q, unit, zero, zero)
        rates = tuple(value(x) for x in rates_moved)
        at, moved = (equations.placement(T, data, x, prescribed) for x in (q, near))

        def residual(at: Any, rates: Sequence[Any], lam: Tensor) -> Any:
            v, a = rates
            return observer.rows(T, q, equations.dynamic_residual(T, data, at, v, a, lam))

        forces = residual(at, rates, none)[:, 0]
        subtracted = None if offset is None else _in_body_axes(T, moved, offset[0])
        forces = forces if subtracted is None else forces - subtracted.value[:, 0]
        phi, Phi_q = q.new_zeros(0, lanes), [q.new_zeros(0, T.n_v)] * lanes
        if T.rows:
            violation = equations.constraints(T, moved)
            phi, Phi_q = violation.value[:, 0], [coupling.matrix(x, True) for x in _tangents(violation)]
            phi = phi if offset is None else phi - offset[1][:, None]
        active = unpadded_rates(T, data, lanes)
        balanced = forces
        if unstrained is not None:
            data = data | {"beam_rest": unstrained}
            balanced = residual(at, rates, none)[:, 0]
            balanced = balanced if subtracted is None else balanced - subtracted.value[:, 0]
        scale = coordinate_scale(T, data, at, q).unbind(-1)
        constrained = zip(active, Phi_q, scale, balanced.unbind(-1), strict=True)
        masses = [None] * lanes
        if released and T.rows:
            xd_xdd = observer.perturbed(T, q, zero, zero, unit)[1:]
            masses = [coupling.matrix(x) for x in _tangents(residual(at, xd_xdd, none))]
        lam = torch.stack(
            [_multipliers(J, s, f, a, M) for (a, J, s, f), M in zip(constrained, masses, strict=True)], -1
        )
        force = residual(moved, rates_moved, lam[:, None])
        stiffness = _tangents(force if subtracted is None else force - subtracted)

        @cache
        def along(directions: str) -> list[Tensor]:
            xd, xdd = (unit, zero) if directions == "rates" else (zero, unit)
            rates = observer.perturbed(T, q, zero, xd, xdd)[1:]
            return [coupling.matrix(x) for x in _tangents(residual(at, rates, lam[:, None]))]

        def of_lane(lane: int) -> Callable[[str], Tensor]:
            return lambda directions: along(directions)[lane]

        def product_of(lane: int) -> Callable[[str, Tensor], Tensor] | None:
            if offset is not None or unstrained is not None or not isinstance(observer, ObserverAtRest):
                return None
            lane_data = {name: x[..., lane : lane + 1] if x.shape[-1] > 1 else x for name, x in data.items()}
            place, forces = q[..., lane : lane + 1], lam[:, None, lane : lane + 1]

            def product(directions: str, X: Tensor) -> Tensor:
                zero = place.new_zeros(T.n_v, 1, 1)
                along, fixed = Pair.of(zero, X[..., None]), Pair.of(zero, torch.zeros_like(X)[..., None])
                x, xd = (fixed, along) if directions == "rates" else (along, fixed)
                at = equations.placement(
                    T, lane_data, equations.advance(T, place, x), excitation or T.prescribed(t, lane_data).values()
                )
                total = equations.geometric_residual if directions == "geometric" else equations.dynamic_residual
                return total(T, lane_data, at, xd, fixed, forces).tangent[..., 0]

            return product

        spin = observer.spin if isinstance(observer, SteadyRotation) else still[:3]
        rotates = spin.expand(-1, -1, lanes).any(0)[0]
        n = torch.arange(T.bodies)
        body = torch.cat([n.repeat(6), n[: T.flexible].repeat(T.modes)])
        parts = zip(forces.unbind(-1), phi.unbind(-1), stiffness, Phi_q, lam.unbind(-1), active, scale, strict=True)
        return [
            cls(
                *(f, p, coupling.matrix(K), J, x, a, s, null_space(J[:, a], s[a])),
                *(of_lane(i), body[a], bool(rotates[i]), coupling, product_of(i)),
            )
            for i, (f, p, K, J, x, a, s) in enumerate(parts)
        ]

    @classmethod
    def of_matrices(cls, M: Tensor, C: Tensor, K: Tensor) -> Linearization:
        """Of M z'' + C z' + K z = 0 [n, n] in independent coordinates; K is taken as it is, also where it is unsymmetric."""
        n, none = len(M), M.new_zeros(0)
        matrices, unit = {"rates": C, "accelerations": M}, torch.eye(n, dtype=M.dtype)
        return cls(
            forces=M.new_zeros(n),
            phi=none,
            K=K,
            Phi_q=M.new_zeros(0, n),
            lam=none,
            active=torch.arange(n),
            scale=M.new_ones(n),
            N=unit,
            along=matrices.__getitem__,
            body=torch.zeros(n, dtype=torch.long),
            rotates=True,
        )

    @cached_property
    def row_sizes(self) -> Tensor:
        """Size of each constraint where all coordinates move by their sizes [rows]: [m] of a length, [-] of an angle."""
        return (self.Phi_q * self.scale)[:, self.active].norm(dim=1).clamp_min(torch.finfo(self.scale.dtype).tiny)

    @cached_property
    def right_inverse(self) -> Tensor:
        """Smallest increment of the coordinates, as a share of their sizes, of unit violations [active, rows]."""
        s, size = self.scale[self.active], self.row_sizes
        return s[:, None] * torch.linalg.pinv(self.Phi_q[:, self.active] * s / size[:, None], rtol=RELATIVE) / size

    @property
    def works(self) -> Tensor:
        """Forces times the sizes of their coordinates [n_v]: forces, torques and modal forces in one unit."""
        return self.forces * self.scale

    @property
    def unbalanced(self) -> Tensor:
        """Generalized forces that no constraint force balances [active]."""
        return self.forces[self.active] + self.Phi_q[:, self.active].T @ self.lam

    def reduced(self, X: Tensor) -> Tensor:
        """N' X N of a matrix [n_v, n_v]."""
        return self.N.T @ X[self.active][:, self.active] @ self.N

    @cached_property
    def principal_stiffness(self) -> tuple[Tensor, Tensor]:
        """Eigenvalues [freedoms] of the symmetric part of N' K N, ascending, and vectors V [active, freedoms]: V' K V is their
        diagonal.

        Each freedom is first divided by the root of the terms that meet in its stiffness, so an eigenvalue is a share of
        those: rounding where they cancel, and about one for a soft spring, whatever springs stand beside it. The second round
        starts from the directions of the first, in which soft and stiff freedoms are apart.
        """
        K, scale, vectors = self.K[self.active][:, self.active], self.scale[self.active], self.N
        size = scale[:, None] * K.abs() * scale
        of_body = self._largest_of_body(size.amax(1)) / scale.square()
        values = K.new_zeros(0)
        for _ in range(2):
            terms = (vectors.abs() * (K.abs() @ vectors.abs() + _BESIDE * of_body[:, None] * vectors.abs())).sum(0)
            vectors = vectors / torch.where(terms > 0.0, terms, 1.0).sqrt()
            values, turn = torch.linalg.eigh(vectors.T @ (0.5 * (K + K.T)) @ vectors)
            vectors = vectors @ turn
        return values, vectors

    def _largest_of_body(self, works: Tensor) -> Tensor:
        """The largest of numbers [active] of the coordinates of a body, for each coordinate of it [active]."""
        of_body = works.new_zeros(int(self.body.max()) + 1 if len(self.body) else 0)
        return of_body.scatter_reduce(0, self.body, works, "amax")[self.body]

    @property
    def damping(self) -> Tensor:
        """N' C N."""
        return self.reduced(self.C) if self.graded is None else self.N.T @ self._times("rates", self.N)[self.active]

    @property
    def inertia(self) -> Tensor:
        """N' M N, symmetric."""
        M = self.reduced(self.M)
        return 0.5 * (M + M.T)

    @property
    def negative_mass(self) -> bool:
        """True if an eigenvalue of the inertia is negative; those of parts without inertia are zero."""
        return negative_mass(self.inertia)

    def factored_inertia(self) -> Tensor:
        """L with L L' = N' M N; DesignFailure if vibrations do not exist."""
        return factored_inertia(self.inertia)

    @cached_property
    def in_vibrations(self) -> Linearization:
        """The same where N has the vibrations of a conservative system at rest, of unit modal mass, if some are so soft that
        rounding of stiff springs shows in N' K N; else as it is.

        K of two springs in series has the sum of their stiffnesses, in which the soft one may be lost. Forces along a vibration
        have it: there the stiff spring hardly gets longer. Soft vibrations are a system by themselves, with softer ones in it.
        """
        if self.product is None or self.rotates or self.nonconservative or not self.N.shape[1]:
            return self
        inverse, K = torch.linalg.inv(self.factored_inertia()), self.reduced(self.K)
        squares, Y = torch.linalg.eigh(inverse @ (0.5 * (K + K.T)) @ inverse.T)
        X = self.N @ inverse.T @ Y
        forces, parts = self.K[:, self.active] @ X, []
        while True:
            soft = squares.abs() <= _SOFT * squares.abs().amax(0, keepdim=True)
            soft &= ~soft.all()
            parts.append([x[..., ~soft] for x in (squares, X, forces)])
            if not bool(soft.any()):
                break
            stiff_squares, stiff = (torch.cat([part[i] for part in parts], -1) for i in (0, 1))
            X, forces = X[:, soft], forces[:, soft]
            for _ in range(2):  # the second time forces know what the first correction left
                X = X - stiff @ (stiff.T @ forces[self.active] / stiff_squares[:, None])
                forces = self._symmetric_times(X)
            S = X.T @ forces[self.active]
            squares, Y = torch.linalg.eigh(0.5 * (S + S.T))
            X, forces = X @ Y, forces @ Y
        if len(parts) == 1:
            return self
        squares, N, forces = (torch.cat(x, -1) for x in zip(*parts, strict=True))
        order = squares.argsort()
        return replace(self, N=N[:, order], graded=(squares[order], forces[:, order]))

    def _times(self, directions: str, X: Tensor) -> Tensor:
        """`product` of X [active, k]."""
        assert self.product is not None
        return self.product(directions, X.new_zeros(len(self.forces), X.shape[1]).index_copy(0, self.active, X))

    def _symmetric_times(self, X: Tensor) -> Tensor:
        """The symmetric part of K times X [active, k]: unbalanced torques make K unsymmetric, by its geometric part alone."""
        G = self.geometric_stiffness
        return self._times("increments", X) - 0.5 * (G - G.T)[:, self.active] @ X

    @cached_property
    def geometric_stiffness(self) -> Tensor:
        """The stiffness of weight, pretension and constraint forces [n_v, n_v]; `product` must be known."""
        assert self.product is not None
        assert self.coupling is not None
        return self.coupling.matrix(self.product("geometric", self.coupling.directions))

    @property
    def stiffness(self) -> Tensor:
        """N' K N; symmetric but for forces without a potential, and dampers at rest, which push what turns sideways."""
        if self.graded is not None:
            return torch.diag(self.graded[0])
        K = self.reduced(self.K)
        return K if self.rotates or self.nonconservative else 0.5 * (K + K.T)

    @property
    def gyroscopic(self) -> bool:
        """True if stiffness is symmetric and damping antisymmetric, to rounding: the system is conservative."""
        K, C = self.reduced(self.K), self.reduced(self.C)
        unsymmetric, dissipative = (K - K.T).abs().max(), (C + C.T).abs().max()
        return bool(unsymmetric <= _ROUNDING * K.abs().max()) and bool(dissipative <= _ROUNDING * C.abs().max())

    @property
    def nonconservative(self) -> bool:
        """True if forces without a potential, such as those that turn with a body, make the stiffness unsymmetric.

        Unbalanced torques make it unsymmetric too, by half their size; so much unsymmetry does not count.
        """
        K = self.reduced(self.K)
        if not len(K):
            return False
        unbalanced = (self.unbalanced * self.scale[self.active]).abs().max()
        noise = _UNBALANCED * unbalanced + _ROUNDING * K.abs().max()
        return bool((K - K.T).abs().max() > noise)


def negative_mass(inertia: Tensor) -> bool:
    """True if an eigenvalue of N' M N is negative, beyond rounding."""
    masses = torch.linalg.eigvalsh(inertia)
    return bool(len(masses)) and float(masses[0]) < -_ZERO_MASS * float(masses[-1])


def factored_inertia(inertia: Tensor) -> Tensor:
    """L with L L' = N' M N. DesignFailure if it is not positive definite: vibrations do not exist."""
    if negative_mass(inertia):
        raise DesignFailure(
            "system",
            state=f"has no vibrations, because {NEGATIVE_MASS}",
            hint="smaller loads, more pieces (mbd.split), exact beams",
        )
    L, singular = torch.linalg.cholesky_ex(inertia)
    if int(singular):
        raise DesignFailure(
            "system",
            allowed="must have a mass or an inertia above 0 for every free motion",
            noun="the mechanism",
            state="has no vibrations, because a part of it can move without mass, such as a body that turns freely about an "
            "axis without inertia",
        )
    return L


@dataclass(frozen=True)
class Vibrations:
    """Small vibrations of one design.

    frequencies   [freedoms] [Hz], ascending, without damping; zero for a degree of freedom without stiffness, nan for an
                  unstable one
    shapes        [n_v, freedoms], increments of the coordinates of unit modal mass
    poles         [2 freedoms] [1/s], with damping; on demand
    grow          whether a vibration grows: by the stiffness or, in a steady rotation, also by the damping

    In a steady rotation the frequencies include Coriolis's forces, the shapes do not. Damping changes no frequency, also where
    it makes vibrations grow. Where forces turn with a body two degrees of freedom may drive each other (flutter): both
    frequencies are then nan, and both shapes are the real part of the complex one.
    """

    frequencies: Tensor
    shapes: Tensor
    rest: Linearization

    @cached_property
    def poles(self) -> Tensor:
        rest = self.rest.in_vibrations
        return _poles(rest.inertia, rest.damping, rest.stiffness)

    @cached_property
    def grow(self) -> bool:
        if bool(self.frequencies.isnan().any()):
            return True
        if not self.rest.rotates or self.rest.gyroscopic or not len(self.frequencies):
            return False
        size, largest = self.poles.abs(), 2.0 * math.pi * self.frequencies[-1]  # strong dampers have much larger poles
        return bool(((self.poles.real > GROWS * size) & (size > _AT_REST * largest)).any())

    @classmethod
    def of(cls, rest: Linearization) -> Vibrations:
        """Solve the eigenvalue problem in the null space. InputError if the inertia is not positive definite."""
        graded = rest.in_vibrations
        if graded.graded is not None:
            squares, Y = graded.graded[0], torch.eye(graded.N.shape[1], dtype=graded.N.dtype)
        else:
            K = rest.reduced(rest.K)
            inverse = torch.linalg.inv(rest.factored_inertia())
            flutters = rest.nonconservative and not rest.rotates
            K = inverse @ (K if flutters else 0.5 * (K + K.T)) @ inverse.T
            squares, Y = _flutter(K) if flutters else torch.linalg.eigh(K)
            Y = inverse.T @ Y
        n = len(squares)
        squares = torch.where(squares.abs() <= rounding_of_squares(graded, Y, squares), 0.0, squares)
        shapes = Y.new_zeros(len(rest.forces), n).index_copy(0, rest.active, graded.N @ Y)
        if not rest.rotates or not n:
            return cls(squares.sqrt() / (2.0 * math.pi), shapes, rest)
        C, K = rest.reduced(rest.C), rest.reduced(rest.K)
        w, _ = whirl(_poles(rest.inertia, 0.5 * (C - C.T), 0.5 * (K + K.T)))
        return cls(w / (2.0 * math.pi), shapes, rest)


def whirl(poles: Tensor) -> tuple[Tensor, Tensor]:
    """Angular frequencies [n] [rad/s] of the poles [2 n] of a system with Coriolis's forces and no damping, ascending; and the
    numbers of the poles with a positive imaginary part.

    A frequency is zero for a free motion and nan where the vibration grows. A negative stiffness does not imply that it does,
    as Coriolis's forces may stabilize.
    """
    size, w = poles.abs(), poles.imag.abs()
    rounding = _AT_REST * w.amax()
    w = torch.where(w > rounding, w, 0.0)
    rate = poles.real.abs()
    sure = rate * size > torch.finfo(w.dtype).eps * w.amax().square()  # rounding is that of squares of the largest
    grows = (rate > GROWS * size) & (size > rounding) & sure
    order = (~grows).to(torch.int8).argsort(stable=True)  # the unstable before the free, as at rest
    pairs = order[w[order].argsort(stable=True)].reshape(-1, 2)
    upper = torch.where(poles.imag[pairs[:, 0]] >= 0.0, pairs[:, 0], pairs[:, 1])
    return torch.where(grows[upper], torch.nan, w[upper]), upper


def _poles(M: Tensor, C: Tensor, K: Tensor) -> Tensor:
    """Poles [2 n] of M y'' + C y' + K y = 0."""
    n = len(M)
    A = torch.zeros(2 * n, 2 * n, dtype=K.dtype)
    A[:n, n:] = torch.eye(n, dtype=K.dtype)
    A[n:, :n], A[n:, n:] = -torch.linalg.solve(M, K), -torch.linalg.solve(M, C)
    return torch.linalg.eigvals(A)


def rounding_of_squares(rest: Linearization, Y: Tensor, squares: Tensor) -> Tensor:
    """Squares of angular frequencies [k] of vibrations N Y [freedoms, k] of unit modal mass that count as zero: rounding of
    energies that cancel, and of eigenvalues.

    A share of the largest square alone would make a heavy part on a light stiff shaft a free one. Of soft vibrations
    (`in_vibrations`) it is the square of the rounding of vectors that counts.
    """
    if not len(squares):
        return squares
    largest, eigen = squares.abs().nan_to_num().amax(), _EIGEN * len(squares)
    shapes = (rest.N.to(Y.dtype) @ Y).abs()

    def works(K: Tensor) -> Tensor:
        return (shapes * (K[rest.active][:, rest.active].abs() @ shapes)).sum(0)

    if rest.graded is not None:
        forces = (rest.graded[1].to(Y.dtype) @ Y)[rest.active].abs()
        return _CANCELS * works(rest.geometric_stiffness) + _WORKS * (shapes * forces).sum(0) + eigen**2 * largest
    return _CANCELS * works(rest.K) + eigen * largest


def _flutter(A: Tensor) -> tuple[Tensor, Tensor]:
    """Eigenvalues of an unsymmetric matrix by rising real parts, nan where they are complex, and the real parts of vectors."""
    values, vectors = torch.linalg.eig(A)
    order = values.real.argsort()
    values, Y = values[order], vectors[:, order].real
    squares = torch.where(values.imag.abs() > GROWS * values.abs(), torch.nan, values.real)
    return squares, Y / Y.norm(dim=0)


def _in_body_axes(T: Topology, at: Any, forces: Tensor) -> Any:
    """Forces [n_v, ...] with torques in body axes, out of forces [n_v] with torques in ground axes, at a placement."""
    n = T.bodies
    torques = matvec_t(at.A[:, :, :n], forces[3 * n : 6 * n].reshape(3, n, 1, 1)).flatten(0, 1)
    return cat([forces[: 3 * n, None, None], torques, forces[6 * n :, None, None]])


def unpadded_rates(T: Topology, data: Data, lanes: int) -> list[Tensor]:
    """Rows of v of each lane but those that pad the modes of bodies and designs with fewer modes than others."""
    rigid = torch.arange(6 * T.bodies)
    if not T.flexible:
        return [rigid] * lanes
    Kr = value(data["Kr"])[:, :, :, 0].permute(3, 2, 0, 1)  # [lanes, bodies, m, m]
    retained = (~is_padding(Kr)).mT.flatten(1).expand(lanes, -1)
    return [torch.cat([rigid, len(rigid) + row.nonzero()[:, 0]]) for row in retained]


def null_space(J: Tensor, scale: Tensor) -> Tensor:
    """Basis [n, k] of the null space of a Jacobian [rows, n], orthonormal in coordinates divided by scale [n].

    Rows are scaled to length one. Coordinates that no row joins have bases of their own: mixed with others, soft degrees of
    freedom would get the rounding of stiff ones.
    """
    bound = (J != 0.0).any(0)
    basis = [torch.diag(scale)[:, ~bound]]
    for rows, columns in outside_transforms(_blocks, J):
        A = J[rows][:, columns] * scale[columns]
        _, s, Vh = torch.linalg.svd(A / A.norm(dim=1, keepdim=True), full_matrices=True)
        null = Vh[int((s > RELATIVE * s[0]).sum()) :].T
        block = J.new_zeros(len(scale), null.shape[1])
        block[columns] = scale[columns, None] * null
        basis.append(block)
    return torch.cat(basis, 1)


def _blocks(J: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Numbers of the rows and of the columns of each block of J [rows, n] that has no entries in common with others."""
    rows = len(J)
    row, column = (J != 0.0).nonzero(as_tuple=True)
    graph = coo_array((torch.ones(len(row), dtype=torch.float64), (row, rows + column)), shape=(rows + J.shape[1],) * 2)
    label = torch.from_numpy(connected_components(graph, directed=False)[1])
    of_rows = label[:rows]
    return [((of_rows == k).nonzero()[:, 0], (label[rows:] == k).nonzero()[:, 0]) for k in of_rows[row].unique()]


def _multipliers(J: Tensor, scale: Tensor, forces: Tensor, active: Tensor, M: Tensor | None) -> Tensor:
    """Multipliers [rows] that balance forces [n_v] best: least sum of squares of works on the coordinates of sizes scale [n_v].

    M   mass matrix [n_v, n_v]: least sum of squares by its inverse, as of a body released from rest (Gauss); where it is
        singular, and where it is None, as above
    """
    s = scale[active]
    f, A = s * forces[active], (J[:, active] * s).T
    if M is not None:
        L, singular = torch.linalg.cholesky_ex(0.5 * s[:, None] * (M + M.T)[active][:, active] * s)
        if not int(singular):
            f, A = (torch.linalg.solve_triangular(L, x, upper=False) for x in (f[:, None], A))
            f = f[:, 0]
    return -torch.linalg.pinv(A, rtol=RELATIVE) @ f


def _tangents(x: Any) -> tuple[Tensor, ...]:
    """Tangents [n, k] of each lane."""
    return x.tangent.unbind(-1)
