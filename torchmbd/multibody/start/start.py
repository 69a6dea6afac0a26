"""The initial state of a motion: that of the bodies, numbers of the caller, or a static equilibrium.

    "assembled"     positions, rates and modal coordinates that the bodies were given, joints closed (initial.py)
    "equilibrium"   the static equilibrium near these positions (equilibrium.py); the same rates, drives as at t = 0
    a mapping       numbers for some bodies in the place of those that they were given
    a state         the last one of another motion

Joints are then closed by the smallest rigid displacement, and rates made compatible; modal coordinates do not change.
Differentiable with respect to the design and the tensors of a mapping or a state; modal coordinates are those of the modes
of each design (modal_start.py).
Checked in tests/integrate/test_equilibrium.py, tests/sensitivity/test_rest.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchmbd.errors import InputError, unknown
from torchmbd.fem.reduction.registry import MORE
from torchmbd.math.gradients import all_true, is_differentiated, refuse_derivatives, untransformed
from torchmbd.math.rotation import euler_parameters
from torchmbd.multibody.bodies.frame import MODAL, VELOCITIES
from torchmbd.multibody.equations.modal_data import pad
from torchmbd.multibody.equations.topology import Topology
from torchmbd.multibody.equilibrium.equilibrium import equilibrium_coordinates, find_equilibria
from torchmbd.multibody.start.initial import START_DATA, InitialConditions, of_modes

STARTS = ("assembled", "equilibrium")
POSE = ("position", "axes")
_TURNED = 1e-9  # |A'A - 1| of a rotation


@dataclass(frozen=True, eq=False)
class EquilibriumConditions(InitialConditions):
    """Initial conditions in static equilibrium; `Dynamics.start_errors` names the lanes that have none."""

    in_equilibrium: ClassVar = True

    @property
    def closing_levels(self) -> list[Tensor]:
        """As those of `InitialConditions`; then modal ones, from which the equilibrium is sought."""
        return [self.rigid_mask, ~self.rigid_mask]

    def shared_start(self, dynamics: Any) -> None:
        """None: an equilibrium depends on the stiffness and mass of the design."""

    def solve(self, dynamics: Any):
        """As `InitialConditions.solve`."""
        q, v = self.assembled(dynamics)
        q = self.equilibrium_near(dynamics, q)
        return q, self.compatible(dynamics, q, v)

    def equilibrium_near(self, dynamics: Any, q: Any):
        """Coordinates of equilibrium [n_q, 1, lanes] near coordinates q [n_q, 1, lanes] with closed joints."""
        t = torch.zeros((), dtype=torch.float64)
        balances = find_equilibria(dynamics, q, t)
        errors = {lane: balance.failure or balance.instability for lane, balance in enumerate(balances)}
        dynamics.start_errors.update({lane: error for lane, error in errors.items() if error})
        return equilibrium_coordinates(dynamics, balances, t)


@dataclass(frozen=True, eq=False)
class Start:
    """The start of the motions of a system, checked.

    in_equilibrium   whether it is the static equilibrium
    numbers          "body.quantity" -> numbers [...] or [lanes, ...]
    state            q [lanes, n_q] and v [lanes, n_v] of the whole system, of origins, or None
    topology         of this state
    stiffness        Kr [modes, modes, bodies, 1, lanes] of the designs of this state, in whose modes its coordinates are
    is_guess         whether a search begins there, whose result does not depend on it
    """

    in_equilibrium: bool = False
    numbers: Mapping[str, Tensor] = field(default_factory=dict)
    state: tuple[Tensor, Tensor] | None = None
    topology: Topology | None = None
    stiffness: Tensor | None = None
    is_guess: bool = False

    @classmethod
    def of(cls, system: Any, start: Any) -> Start:
        """The start of the argument `start` of `simulate`, a word or a mapping; InputError says what is allowed."""
        if isinstance(start, str) and start in STARTS:
            return cls(in_equilibrium=start == "equilibrium")
        if not isinstance(start, Mapping):
            mapping = "'body.quantity' -> numbers, such as {'rod.modal': [0.01, 0.0]}"
            words = ", ".join(map(repr, STARTS))
            raise InputError(
                "start", start, f"{words}, a motion, which the new one continues from its last state, or {mapping}"
            )
        return cls(numbers={name: _checked(system, name, x) for name, x in start.items()})

    @classmethod
    def of_motion(cls, system: Any, q: Tensor, v: Tensor, at: Topology, stiffness: Tensor | None = None) -> Start:
        """The start in a state q [lanes, n_q], v [lanes, n_v] of a system of the same bodies, of their origins, with the
        topology `at`."""
        T = system.topology
        similar = at.bodies == T.bodies and at.flexible == T.flexible
        similar = similar and all(abs(a - b) <= MORE for a, b in zip(at.mode_counts, T.mode_counts, strict=True))
        if not similar or q.shape[1:] != (at.n_q,) or v.shape[1:] != (at.n_v,):
            shown = f"a motion of {q.shape[-1]} coordinates"
            raise InputError(
                "start", q, f"a motion of a system of the same kind, with {T.n_q} coordinates", shown=shown
            )
        if not all_true(torch.isfinite(q)) or not all_true(torch.isfinite(v)):
            raise InputError(
                "start", q, "a motion with the status 'ok'", shown="a motion whose last state is not finite"
            )
        return cls(state=(q, v), topology=at, stiffness=stiffness)

    @property
    def tensors(self) -> list[Tensor]:
        """The tensors of the mapping, or of the state."""
        return [*self.numbers.values(), *(self.state or ())]

    @property
    def is_differentiated(self) -> bool:
        """True if one of these tensors requires a gradient."""
        return any(map(is_differentiated, self.tensors))

    @property
    def lanes(self) -> int:
        """Number of lanes of these tensors."""
        counts = [len(x) for x in self.state or ()]
        counts += [len(x) for name, x in self.numbers.items() if x.dim() > _rank(name)]
        if not {1, max(counts, default=1)}.issuperset(counts):
            raise InputError(
                "start", allowed="must have the same number for all, or one", state=f"has lanes {sorted(set(counts))}"
            )
        return max(counts, default=1)

    def conditions(self, T: Topology, bodies: list[Any]) -> InitialConditions:
        """Initial conditions of a system with these bodies, in the order of its topology."""
        conditions = (EquilibriumConditions if self.in_equilibrium else InitialConditions).of(T, bodies)
        mask = torch.zeros_like(conditions.rate_mask) if self.state is not None else conditions.rate_mask.clone()
        for i, body in enumerate(bodies):
            for k, name in enumerate(VELOCITIES):
                if f"{body.name}.{name}" in self.numbers:
                    mask[[3 * T.bodies * k + T.bodies * j + i for j in range(3)]] = True
        return replace(conditions, rate_mask=mask)

    def data(self, T: Topology, bodies: list[Any], of_bodies: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Initial coordinates and rates as data of a design; of_bodies: those of initial.start_of_bodies."""
        if self.state is not None:
            return {name: self._state_in(T, x).T[:, None] for name, x in zip(START_DATA, self.state, strict=True)}
        if not self.numbers:
            return {}
        q, v = (of_bodies[name] for name in START_DATA)
        for i, body in enumerate(bodies):
            for name in (*POSE, *VELOCITIES, *MODAL):
                x = self.numbers.get(f"{body.name}.{name}")
                if x is None:
                    continue
                if name == "axes":
                    x = euler_parameters(x) if x.dim() == 2 else torch.stack([euler_parameters(A) for A in x])
                if name in MODAL:
                    x = self._of_modes(f"{body.name}.{name}", x, T.mode_counts[i])
                rows, is_rate = _rows(T, i, name), name in (*VELOCITIES, MODAL[1])
                q, v = (q, _replace_rows(v, rows, x)) if is_rate else (_replace_rows(q, rows, x), v)
        return dict(zip(START_DATA, (q, v), strict=True))

    def _state_in(self, T: Topology, x: Tensor) -> Tensor:
        """A part of the state [lanes, n] in the order of another topology, of other numbers of modes."""
        at = self.topology
        if at is None or at.mode_counts == T.mode_counts:
            return x
        first = (7 if x.shape[1] == at.n_q else 6) * at.bodies
        last = first + at.modes * at.flexible
        w = x[:, first:last].unflatten(1, (at.modes, at.flexible))
        parts = enumerate(zip(T.names, T.mode_counts, strict=False))
        moved = [pad(self._of_modes(f"{name}.modal", w[..., i], count), T.modes, (-1,)) for i, (name, count) in parts]
        return torch.cat([x[:, :first], torch.stack(moved, -1).flatten(1), x[:, last:]], 1)

    def _of_modes(self, name: str, x: Tensor, count: int) -> Tensor:
        """As `of_modes`; a search leaves out what a design does not have."""
        return of_modes(name, x[..., :count] if self.is_guess else x, count, count)


def _rank(name: str) -> int:
    return 2 if name.endswith(".axes") else 1


def _rows(T: Topology, body: int, name: str) -> list[int]:
    if name in POSE:
        return T.r_slice(body) if name == "position" else T.p_slice(body)
    if name in VELOCITIES:
        first = 3 * T.bodies * VELOCITIES.index(name)
        return [first + i * T.bodies + body for i in range(3)]
    return [row - (T.bodies if name == MODAL[1] else 0) for row in T.w_slice(body)]


def _replace_rows(x: Tensor, rows: list[int], y: Tensor) -> Tensor:
    """x [n, 1, lanes] with the k `rows` replaced by y [k] or [lanes, k]."""
    new = y.T[:, None] if y.dim() == 2 else y[:, None, None]
    lanes = max(x.shape[-1], new.shape[-1])
    x, new = (z.expand(*z.shape[:-1], lanes) for z in (x, new))
    return x.index_copy(0, torch.tensor(rows), new)


def _checked(system: Any, name: Any, x: Any) -> Tensor:
    """Numbers of one quantity of a body [...] or [lanes, ...]; InputError says what is wrong."""
    quantities = {}
    for body in system.bodies:
        for quantity in (*POSE, *VELOCITIES, *(MODAL if hasattr(body, "mesh") else ())):
            sizes = (3, 3) if quantity == "axes" else (body.mode_counts[0],) if quantity in MODAL else (3,)
            quantities[f"{body.name}.{quantity}"] = sizes
    if name not in quantities:
        raise unknown("start: quantity", str(name), quantities, ("start", str(name)))
    shape = quantities[name]
    try:
        tensor = x if isinstance(x, Tensor) else torch.tensor(x, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError):
        tensor = None
    if tensor is not None and name.endswith(MODAL):  # designs may retain more modes than the first one
        counts = system.body(name.split(".")[0]).mode_counts
        shape = tensor.shape[-1:] if tensor.dim() and tensor.shape[-1] in counts else shape
    good = tensor is not None and tensor.dtype == torch.float64 and tensor.shape[tensor.dim() - len(shape) :] == shape
    if tensor is None or not good or tensor.dim() > len(shape) + 1 or not all_true(torch.isfinite(tensor)):
        size = ", ".join(map(str, shape))
        allowed = f"finite float64 numbers [{size}] or [lanes, {size}]"
        raise InputError(("start", name), x, allowed, noun=f"start: {name!r}")
    if name.endswith(".axes"):
        refuse_derivatives(f"start: {name!r}", tensor, "a joint or another body that is turned by a parameter")
    numbers = untransformed(tensor)
    if len(shape) == 2 and float((numbers.mT @ numbers - torch.eye(3, dtype=torch.float64)).abs().max()) > _TURNED:
        allowed = "orthonormal columns, the axes of the body"
        raise InputError(("start", name), x, allowed, noun=f"start: {name!r}", shown="not a rotation")
    return tensor
