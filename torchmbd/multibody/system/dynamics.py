"""Equations of motion of a batch of designs: the reduced model after the structure stage, without the meshes.

    dz/dt = dynamics(t, z)          z = (q, v)

The index-1 form of the constrained equations, with the accelerations from one saddle-point solve:

    M a + Phi_q' lam + s + K q = g,     Phi'' + 2 alpha Phi' + alpha^2 Phi = 0       (Baumgarte, ref. 50)

alpha = 1 / `stabilization` time constant. It is zero along an exact motion, so it does not change the solution.
Redundant constraint rows leave the multipliers undetermined, not the motion: a small -eps in their block of the matrix
picks one solution, and iterative refinement with the exact matrix removes the error of eps. Rows that are consistent with the
others only while flexible bodies are undeformed are left out (rank.py): their row and column are zero but for -1e30 on the
diagonal.
For design tangents the saddle-point matrix is factored once; the right-hand sides of eqs. (31)-(33) are tangents of
the residual with accelerations and multipliers held fixed.
Differentiable: plain tensors in reverse mode (torchdiffeq.odeint and backward), design tangents through `rates`.
Checked in tests/multibody/system/, tests/sensitivity/.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError, warn
from torchmbd.math.gradients import is_differentiated, untransformed, wraps
from torchmbd.math.module_call import outside_transforms
from torchmbd.math.pair import Pair, cat, linear, value, variation
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equations.data import Data
from torchmbd.multibody.equations.sizes import Sizes, row_sizes
from torchmbd.multibody.equations.topology import Topology
from torchmbd.multibody.saddle.condensation import Condensation
from torchmbd.multibody.saddle.factors import Diagonal, regularized
from torchmbd.multibody.saddle.least_norm import LeastNorm
from torchmbd.multibody.saddle.matrix import Saddle
from torchmbd.multibody.saddle.rank import (
    Rank,
    confirm_left_out,
    first_finite_lane,
    full_rank_undeformed,
    jacobians,
    rank_of,
)

LEFT_OUT = 1e30  # on the diagonal of a row without other entries: its multiplier is zero
# Of 1 / largest mass, or 1 / largest moment of inertia where a row is an angle. C M^-1 C' is of this order or more, so only
# undetermined multipliers notice.
REGULARIZATION = 1e-8


@dataclass(eq=False)
class Dynamics:
    """Equations of motion of a batch of designs (lanes), made by `System.dynamics`; see also state_equation.py.

    Called with t [] [s] and z [lanes, n] it is the right-hand side dz/dt for torchdiffeq, from `initial_state()`.

    topology       bodies, joints and forces as arrays of indices
    saddle         assembles the saddle-point matrix of this topology
    data           name -> tensor or pair [component..., 1, lanes]; a lane axis of length one is the same for all lanes
    initial        approximate initial state of the bodies and the solver that closes the joints
    stabilization  time constant of the constraint stabilization [s]
    backend        name of what makes the steps (integrate/backend.py)
    statistics     number of evaluations of the right-hand side

    >>> dynamics = mbd.examples.pendulum().dynamics()
    >>> z = dynamics.initial_state()
    >>> z.shape, dynamics(torch.tensor(0.0), z).shape  # position, Euler parameters and velocities of one body
    (torch.Size([1, 13]), torch.Size([1, 13]))
    """

    topology: Topology
    saddle: Saddle
    data: Data
    initial: Any  # InitialConditions
    stabilization: float = 5e-3
    backend: str = "eager"
    prepared: Any = field(default=None, init=False, repr=False)  # cached initial step data (integrate/prepared.py)
    statistics: dict[str, int] = field(default_factory=lambda: {"evaluations": 0})
    start_errors: dict[int, str] = field(default_factory=dict, init=False, repr=False)  # lane -> why it has no start
    known_rank: Rank | None = field(default=None, init=False, repr=False)  # once it was found

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"prepared": None}  # may hold an autograd graph, which cannot be pickled

    @property
    def lanes(self) -> int:
        """Number of designs."""
        return max((value(x).shape[-1] for x in self.data.values()), default=1)

    @property
    def tangents(self) -> int:
        """Number of design variables whose tangents the data carry."""
        tangents = [x.shape[-2] - 1 for x in self.data.values() if isinstance(x, Pair)]
        return max(tangents, default=0)

    @cached_property
    def shared_start(self) -> Any:
        """Initial state and ranks that all designs share (initial.py); None if the start depends on the design."""
        return self.initial.shared_start(self)

    @cached_property
    def start(self) -> tuple[Any, Any]:
        """Initial q [n_q, pair, lanes] and v [n_v, pair, lanes]: joints closed, velocities compatible."""
        return self.initial.solve(self)

    @property
    def rank(self) -> Rank:
        """Rank of the constraints at the initial position of the first lane whose data are finite; also under torch.func, where
        tensors do not give a rank."""
        if self.known_rank is None:
            ranks = {} if self.shared_start is None else self.shared_start.ranks
            shared = self.topology in ranks
            rank: Rank = ranks[self.topology] if shared else self.outside_transforms(Dynamics._rank)
            self.known_rank = rank
        return self.known_rank

    def share_rank(self, other: Dynamics) -> Dynamics:
        """Itself, with the rank of other dynamics of the same equations, because tensors in torch.func do not give a rank."""
        self.known_rank = other.rank
        return self

    def outside_transforms(self, f: Callable[..., Any], *tensors: Tensor) -> Any:
        """f(dynamics, *tensors) of plain values, also under torch.func; tensors [..., lanes], a batch of vmap is more lanes."""
        values = [value(x) for x in self.data.values()]
        if not wraps(*values, *tensors):
            return f(self, *tensors)
        n = len(values)

        def run(*x: Tensor) -> Any:
            return f(replace(self, data=dict(zip(self.data, x[:n], strict=True))), *x[n:])

        return outside_transforms(run, *values, *tensors)

    def _rank(self) -> Rank:
        """The rank of the constraint rows for data without tangents."""
        lane = first_finite_lane(self.data) if self.topology.rows else None
        if lane is None:
            return Rank(0, ())
        q, sample = value(self.start[0]).detach(), self.select_lanes([lane]) if lane else self
        q = q[:, 0, min(lane, q.shape[-1] - 1)]
        with torch.no_grad():
            J = jacobians(sample, q[None], q.new_zeros(1))[0].numpy()
            rank = confirm_left_out(sample, q, rank_of(self.topology, J))
        if self.shared_start is not None and full_rank_undeformed(self.topology, J):
            self.shared_start.ranks[self.topology] = rank
        if rank.weak:
            warn(
                f"{', '.join(rank.weak)}: the modes of the body make these rows nearly dependent (they differ by "
                f"{100 * rank.share:.1g} %), so the joints make the body too stiff. "
                'Try: reduction="craig-bampton" with the nodes of its joints',
            )
        return rank

    @property
    def redundant(self) -> tuple[str, ...]:
        """Names of constraint rows that follow from the others at the initial position (rank.py)."""
        return self.rank.redundant

    def evaluate_rank(self) -> None:
        """Evaluate the rank and cache it, because tensors inside transforms of torch.func have no values that give a rank."""
        if self.redundant:
            _ = self.least_norm

    @cached_property
    def sizes(self) -> Sizes:
        """By which iterations compare numbers (sizes.py) [n, lanes], or [n, 1] where all lanes have the same."""
        return Sizes.of(self.topology, self.initial.size, value(self.data["mass"])[:, 0].detach())

    @cached_property
    def least_norm(self) -> LeastNorm | None:
        """Projection of undetermined multipliers to those of least norm; None if all are determined."""
        condensed, rank = self.condensed(), self.rank
        if condensed is not self and rank.redundant:  # the steps leave out rows of the condensed system
            rows = self.initial.condensed.rows[list(condensed.rank.left_out)]
            rank = replace(rank, left_out=tuple(rows.tolist()))
        return LeastNorm.of(self.saddle, rank)

    def diagonal(self, everywhere: bool = False) -> Diagonal | None:
        """Regularization of the saddle-point matrix: row_mask [n], factors 1 or 0 of rows and columns, and diagonal_shift [n],
        which is subtracted from the diagonal. None: the matrix is regular.

        everywhere   regularize systems without redundant rows too, as is necessary near singular positions
        """
        if not self.topology.rows or not (self.redundant or everywhere):
            return None
        n, left_out = self.topology.n_v, list(self.rank.left_out)
        row_mask = torch.ones(n + self.topology.rows, dtype=torch.float64)
        diagonal_shift = torch.zeros_like(row_mask)
        if everywhere or len(left_out) < len(self.redundant):
            mass, P = (untransformed(value(self.data[name])) for name in ("mass", "P0"))
            largest = float(mass.max())
            arm = math.sqrt(float(P.diagonal(dim1=0, dim2=1).sum(-1).max()) / largest) or 1.0
            diagonal_shift[n:] = REGULARIZATION / largest * (row_sizes(self.topology, arm)[:, 0, 0] / arm).square()
        for i in left_out:
            row_mask[n + i], diagonal_shift[n + i] = 0.0, LEFT_OUT
        return row_mask, diagonal_shift

    def regularize(self, K: Tensor) -> Tensor:
        """Saddle-point matrices [lanes, n, n] out of K [lanes, n, n], with the regularization of `diagonal`."""
        return regularized(K, self.diagonal())

    def zero_left_out(self, lam: Any) -> Any:
        """Multipliers [rows, ...] with zeros in the rows that are left out of the motion (rank.py)."""
        if not self.rank.left_out:
            return lam
        rows = torch.tensor(self.rank.left_out)
        return linear(lambda x: x.index_fill(0, rows, 0.0), lam)

    def values(self) -> Dynamics:
        """The same dynamics without design tangents."""
        data = {name: value(x) for name, x in self.data.items()}
        dynamics = Dynamics(self.topology, self.saddle, data, self.initial, self.stabilization, self.backend)
        dynamics.known_rank = self.known_rank
        return dynamics

    def with_data(self, data: Data) -> Dynamics:
        """The same equations with other data of the same designs; a rank that is known is kept."""
        dynamics = replace(self, data=data)
        dynamics.known_rank = self.known_rank
        return dynamics

    def condensed(self) -> Dynamics:
        """The same motion with fewer unknowns (condensation.py); itself if there is nothing to condense."""
        c = self.initial.condensed
        if c is None:
            return self
        return Dynamics(
            c.topology, c.saddle, c.data(self.data), CondensedStart(self, c), self.stabilization, self.backend
        )

    def select_lanes(self, lanes: Sequence[int]) -> Dynamics:
        """The dynamics of the designs `lanes` of the batch; itself where these are all of them in their order."""
        if list(lanes) == list(range(self.lanes)):
            return self
        index = torch.tensor(list(lanes))

        def pick(x: Tensor) -> Tensor:
            return x.index_select(-1, index) if x.shape[-1] > 1 else x

        data = {name: Pair(pick(x.full)) if isinstance(x, Pair) else pick(x) for name, x in self.data.items()}
        return Dynamics(self.topology, self.saddle, data, self.initial, self.stabilization, self.backend)

    def initial_state(self) -> Tensor:
        """Consistent initial state z [lanes, n_q + n_v]: joints closed, velocities compatible."""
        q, v = self.initial.solve(self.values())
        return torch.cat([q, v])[:, 0].T.contiguous()

    def __call__(self, t: Tensor | float, z: Tensor) -> Tensor:
        """dz/dt of states z [lanes, n_z] or [n_z] at time t [s]; the same shape."""
        n = self.topology.n_q + self.topology.n_v
        if z.shape[-1] != n or z.dim() > 2:
            raise InputError(
                "z",
                allowed=f"must have shape [{n}] or [lanes, {n}]",
                state=f"has shape {tuple(z.shape)}",
                noun="state z",
            )
        if z.dtype != torch.float64 or z.device.type != "cpu":
            raise InputError("z", allowed="torch.float64 on cpu", state=f"is {z.dtype} on {z.device}", noun="state z")
        batch = z if z.dim() == 2 else z[None]
        dz = self.rates(torch.as_tensor(t, dtype=z.dtype, device=z.device), batch.T[:, None])
        return value(dz)[:, 0].T.reshape(z.shape)

    def rates(self, t: Tensor, z):
        """dz/dt [n_z, pair, lanes] of values, or of pairs with the design tangents of all variables."""
        self.statistics["evaluations"] += 1
        T = self.topology
        q, v = z[: T.n_q], z[T.n_q :]
        a, _ = self.accelerations(t, q, v)
        return cat([equations.coordinate_rates(T, q, v), a])

    def accelerations(self, t: Tensor, q, v, solver: SaddleSolver | None = None, known: Tensor | None = None):
        """Accelerations a [n_v, ...] and multipliers lam [rows, ...]; eq. (9), with tangents eq. (30).

        solver   at q and t, where there is one
        known    values of both by the compiled start, one above the other [n_v + rows, 1, lanes]; None: they are computed here
        """
        T = self.topology

        def residual(data: Data, at: equations.Placement, q: Any, v: Any, x: Tensor) -> Any:
            drives, alpha = T.law_jets(t, data) if T.rows else [], 1.0 / self.stabilization
            return equations.stabilized_residual(T, data, at, v, x[: T.n_v], x[T.n_v :], drives, alpha)

        x = (solver or SaddleSolver(self, t, q))(residual, v, known=known)
        return x[: T.n_v], x[T.n_v :]

    def unstabilized_accelerations(self, t: Tensor, q: Any, v: Any) -> tuple[Any, Any]:
        """Accelerations [n_v, ...] and multipliers [rows, ...] that a state determines, zero in rows that are left out.

        They do not contain the stabilization, because it depends on the errors of the steps.
        """
        exact = replace(self, stabilization=math.inf).share_rank(self)
        a, lam = exact.accelerations(t, q, v)
        return a, exact.zero_left_out(lam)

    def solve_linear(self, residual: Callable[..., Any], t: Tensor, q: Any, *arguments: Any) -> Any:
        """As `SaddleSolver`, of one residual."""
        return SaddleSolver(self, t, q)(residual, *arguments)


class SaddleSolver:
    """Solutions with the saddle-point matrix at coordinates q [n_q, ...] and time t: several of them share its factors."""

    def __init__(self, dynamics: Dynamics, t: Tensor, q: Any):
        self.data, self.q, self.topology = dynamics.data, q, (T := dynamics.topology)
        self.plain = {name: value(y) for name, y in dynamics.data.items()}
        self.inputs = [y for y in (t, value(q), *self.plain.values()) if is_differentiated(y)]
        self.at = equations.placement(T, dynamics.data, q, T.prescribed(t, dynamics.data))
        self.fixed = self.at.map(lambda y: value(y).detach())
        with torch.set_grad_enabled(torch.is_grad_enabled() and not self.inputs):
            self.factors = dynamics.saddle.factors(self.plain, self.fixed, dynamics.diagonal())

    def __call__(self, residual: Callable[..., Any], *arguments: Any, known: Tensor | None = None) -> Any:
        """x [n_v + rows, ...] with residual(data, placement, q, *arguments, x) = 0.

        known    values of x by the compiled start, to which derivatives are added; None: they are computed here. So both modes
                 of gradients begin with the same numbers

        The residual is linear in x, and its matrix is the saddle-point matrix. Differentiable in every mode: derivatives of x
        are solutions with the same matrix and the derivatives of the residual at fixed x.
        """

        def at_zero(data: Data, at: equations.Placement, q: Tensor, *numbers: Any) -> Tensor:
            return residual(data, at, q, *numbers, q.new_zeros(self.topology.n_v + self.topology.rows, *q.shape[1:]))

        x = self._values(at_zero, arguments) if known is None else known
        return self._with_derivatives(x, residual, arguments)

    def along_constraints(
        self,
        change: Callable[..., tuple[Any, Any]],
        scales: Sequence[tuple[float, float]],
        of: Sequence[Any],
        known: Tensor | None = None,
    ) -> list[Any]:
        """y [n_v, ...] along M^-1 Phi_q' with Phi_q (y - a y0) = b r, for each pair (a, b) of scales.

        change   y0 [n_v, ...] and r [rows, ...] as functions of data, placement, q and the numbers `of`
        known    values of y by the compiled start, above those of mu (M y + Phi_q' mu = 0) [n_v + rows, scales, lanes];
                 None: they are computed here
        """
        T = self.topology

        def at_zero(a: Tensor, b: Tensor, data: Data, at: equations.Placement, *numbers: Any) -> Tensor:
            y0, r = change(data, at, *numbers)
            rows = a * equations.constraint_changes(T, at, data, y0) + b * r
            return torch.cat([rows.new_zeros(T.n_v, *rows.shape[1:]), -rows])

        def residual(a: Any, b: Any, data: Data, at: equations.Placement, q: Any, *numbers: Any) -> Any:
            y0, r = change(data, at, q, *numbers[:-1])
            return equations.along_constraints(T, data, at, numbers[-1], a * y0, b * r)

        # All side by side, in place of tangents; these are found for one after the other.
        sides = [torch.tensor(x, dtype=torch.float64)[:, None] for x in zip(*scales, strict=True)]
        x = self._values(partial(at_zero, *sides), of) if known is None else known
        if not isinstance(self.q, Pair):
            return list(self._with_derivatives(x, partial(residual, *sides), of)[: T.n_v].split(1, -2))
        each = zip(scales, x.split(1, -2), strict=True)
        return [self._with_derivatives(x, partial(residual, *pair), of)[: T.n_v] for pair, x in each]

    def _inputs(self, arguments: Sequence[Any]) -> list[Tensor]:
        numbers = [value(y) for y in arguments if y is not None]
        return [*self.inputs, *filter(is_differentiated, numbers)]

    def _values(self, at_zero: Callable[..., Tensor], arguments: Sequence[Any]) -> Tensor:
        """Values of x; at_zero: those of the residual where x is zero, as a function of its other arguments."""
        inputs = self._inputs(arguments)
        plain = [y if y is None else value(y) for y in (self.q, *arguments)]
        with torch.set_grad_enabled(torch.is_grad_enabled() and not inputs):
            return -self.factors.solve(at_zero(self.plain, self.fixed, *plain), inputs)

    def _with_derivatives(self, x: Tensor, residual: Callable[..., Any], arguments: Sequence[Any]) -> Any:
        """The solution whose values are x: pairs, or with a graph of torch."""
        x, inputs = x.detach(), self._inputs(arguments)
        if not inputs and not isinstance(self.q, Pair):
            return x
        slopes = -self.factors.solve(variation(residual(self.data, self.at, self.q, *arguments, x)), inputs)
        return Pair.of(x, slopes) if isinstance(self.q, Pair) else x + slopes


@dataclass(frozen=True, eq=False)
class CondensedStart:
    """Initial conditions of a condensed system: the retained part of the start of the whole system."""

    whole: Dynamics
    condensation: Condensation
    condensed: None = None  # a condensed system is not condensed again

    @property
    def size(self) -> float:
        """Size of the mechanism as it was built [m]."""
        return self.whole.initial.size

    def shared_start(self, dynamics: Dynamics) -> Any:
        """That of the whole system."""
        return self.whole.shared_start

    def solve(self, dynamics: Dynamics):
        """Initial q [n_q, 1, lanes] and v [n_v, 1, lanes]; pairs if the data of `dynamics` are."""
        q, v = self.whole.start
        return self.condensation.retained(*((q, v) if dynamics.tangents else (value(q), value(v))))
