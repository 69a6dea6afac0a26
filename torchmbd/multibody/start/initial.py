"""Consistent initial conditions: joints closed by Newton's method, then compatible velocities.

Modal coordinates start as they were given (modal_start.py), by default undeformed and at rest in their body frames; the
rigid coordinates move as little as possible (minimum norm) from the given approximate positions and velocities, where a turn
by 1 rad counts as much as a way of the size of the mechanism (equations/sizes.py). Rates that satisfy the constraints have
three levels, and a level changes only where no rates of the levels before it would do:

    1  rigid velocities that were not given       least sum of squares
    2  rigid velocities that were given           least change
    3  modal rates                                least kinetic energy 1/2 w' w of the change: modes have unit modal mass

A platform that is guided by leaves has elastic travel alone: a drive that starts with a speed bends the leaves (level 3).

    q <- q o s,  s = -K Phi(q, t0)           repeated until closed; rigid coordinates alone
    v = v0 + s,  s = -K (J v0 + Phi_t)       v0 = 0 where no velocity was given

J is the Jacobian Phi_q at the current step, and K its inverse by levels, with the derivatives of rate_levels.py: K dPhi, and
for a velocity K d(J v0 + Phi_t). A given velocity that changes gives a warning.

Pairs, and tensors that require gradients, are carried through every step, and through a last step at the closed joints.
InputError names the joints that do not close, with their residuals; a warning those that are closed from afar (closing.py).
The start of undeformed bodies depends on the attached points and the laws of drives only. Where these do not depend on the
design, and no velocity needs modal rates, the start of the first design is that of all (`SharedStart`). Positions and
velocities that are Parameters of bodies are data of a design, "q0" and "v0".
Checked in tests/multibody/start/test_initial.py, tests/multibody/start/test_compliant_start.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchmbd.errors import InputError, warn
from torchmbd.math.gradients import all_true, untransformed, wraps
from torchmbd.math.module_call import outside_transforms
from torchmbd.math.pair import Pair, apply, cat, linear, value
from torchmbd.math.rotation import euler_parameters, rotation_matrix
from torchmbd.multibody.bodies.frame import given_velocities
from torchmbd.multibody.equations import base_points, equations
from torchmbd.multibody.equations.beams import stored_energy
from torchmbd.multibody.equations.sizes import closed_rows, extent, rate_sizes_at, row_sizes, size_at
from torchmbd.multibody.equations.topology import Topology
from torchmbd.multibody.saddle.condensation import Condensation, condense
from torchmbd.multibody.saddle.rank import Rank
from torchmbd.multibody.start.closing import Closing, warn_far
from torchmbd.multibody.start.rate_levels import RateLevel, rate_levels
from torchmbd.multibody.start.rigid_groups import RigidGroups

_MOVED = 1e-11  # share of the size of the mechanism, or angle [rad]: smaller ways are rounding
_STRAINING = 1e-8  # share of the size of a row: violation after rigid motions that strains beams without a warning
_WITHOUT_EXTENT = 1e-9  # share of the radius of gyration: rounding of points that all lie at one place
_STEPS = 50
_KEPT = 1e-6  # share of the largest given velocity by which one may change without a warning
_OPEN = 1e-9  # share of the largest rate by which rounding leaves constraint rates open
_SHOWN = 4  # changed velocities in a warning, the worst first


START_DATA = ("q0", "v0")  # keys of initial coordinates and rates in the data of a design, where these vary


def start_of_bodies(T: Topology, bodies: list[Any]) -> dict[str, Tensor]:
    """Coordinates [n_q, 1, lanes] and rates [n_v, 1, lanes] that origins of bodies were given, in the order of the topology."""

    def rows(*kinds: list[Tensor]) -> Tensor:
        lanes = max((x.shape[0] for kind in kinds for x in kind if x.dim() > 1), default=1)
        wide = [torch.stack([x.expand(lanes, -1) for x in kind], -1).flatten(1) for kind in kinds if kind]
        return torch.cat(wide, 1).T[:, None]

    def modal(name: str) -> list[Tensor]:
        pairs = zip(bodies, T.mode_counts, strict=False)  # flexible bodies are the first
        return [of_modes(f"{b.name}.{name}", getattr(b, name), count, T.modes) for b, count in pairs]

    turns = [torch.zeros(T.turn_count, dtype=torch.float64)]  # angles are measured from the given positions
    q = rows([b.position for b in bodies], [euler_parameters(b.axes) for b in bodies], modal("modal"), turns)
    v = rows([b.velocity for b in bodies], [b.angular_velocity for b in bodies], modal("modal_velocity"))
    return {"q0": q, "v0": v}


def of_modes(name: str, x: Tensor, count: int, modes: int) -> Tensor:
    """Modal coordinates or rates x [..., k] of `count` modes, padded to [..., modes].

    Raises InputError if they move modes beyond these: the first design has more than others.
    """
    if not all_true(x[..., count:] == 0.0):
        raise InputError(
            ("start", name),
            untransformed(x).tolist(),
            f"zero from mode {count + 1} on, because a design has {count} modes",
            shown=f"{untransformed(x).tolist()}",
            noun=f"start: {name!r}",
        )
    return torch.nn.functional.pad(x[..., :count], (0, modes - min(count, x.shape[-1])))


def _size(T: Topology, bodies: list[Any], q: Tensor, built: Tensor) -> float:
    """The size [m] of bodies at coordinates q [n_q] with attached vectors [3, vectors, 1]: without extent the largest radius of
    gyration of a rigid body, or of the nodes of a flexible one, or 1 m."""
    r, p, _ = equations.split_q(T, q[:, None, None])
    points = [r[:, :, 0]]
    for i, (attached, body) in enumerate(zip(T.attached, T.vector_body.tolist(), strict=True)):
        if attached.is_point:
            x = built[:, i]
            points.append(
                (r[:, body, 0] + rotation_matrix(p[:, body])[..., 0, 0] @ x if body < T.bodies else x)[:, None]
            )
    rigid = [
        (untransformed(x).detach() for x in (b.second_moment, b.mass)) for b in bodies if hasattr(b, "second_moment")
    ]
    squares = [(P.diagonal(dim1=-2, dim2=-1).sum(-1) / mass).max() for P, mass in rigid]
    nodes = [untransformed(b.mesh.nodes).detach() for b in bodies if hasattr(b, "mesh")]
    squares += [(x - x.mean(-2, keepdim=True)).square().sum(-1).mean() for x in nodes]
    size, gyration = float(extent(torch.cat(points, 1))), max(map(float, squares), default=0.0) ** 0.5
    return size if size > _WITHOUT_EXTENT * gyration else gyration or 1.0


class DoesNotClose(InputError):
    """No rigid displacement closes the joints."""


@dataclass(frozen=True, eq=False)
class SharedStart:
    """Initial state of all designs whose start depends on the same inputs.

    q, v    the initial state [n, 1, 1]
    ranks   topology -> rank of its constraints, where that does not depend on the modes of bodies
    """

    q: Tensor
    v: Tensor
    ranks: dict[Topology, Rank]


@dataclass(frozen=True, eq=False)
class InitialConditions:
    """Approximate initial positions q [n_q] and velocities v [n_v] of all bodies, v of their origins (base_points.py).

    rate_mask   which velocities users gave [n_v];  built: attached vectors [3, vectors, 1] of the model as it was built
    size        of that model [m] (equations/sizes.py)
    """

    topology: Topology
    in_equilibrium: ClassVar = False  # whether the start is a static equilibrium
    q: Tensor
    v: Tensor
    rate_mask: Tensor
    built: Tensor
    size: float
    # inputs (attached points, and laws with their slopes at the start), and the start that designs share with these
    _last: list[tuple[list[Tensor], SharedStart | None]] = field(default_factory=list, init=False, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_last": []}  # a cache of results, no part of the model

    @classmethod
    def of(cls, topology: Topology, bodies: list[Any]) -> InitialConditions:
        """Those of `bodies`, which are in the order of the topology."""
        start = {name: x[:, 0, 0].detach().clone() for name, x in start_of_bodies(topology, bodies).items()}
        mask = torch.tensor([given_velocities(b) for b in bodies]).T[:, None].expand(2, 3, -1).flatten()
        modal = torch.zeros(topology.n_v - len(mask), dtype=torch.bool)
        built = torch.zeros(3, topology.vectors, 1, dtype=torch.float64)
        for i, x in enumerate(topology.attached):
            built[:, i, 0] = topology.from_base_point(i, untransformed(x.now()).reshape(-1, 3)[0])
        q = base_points.of_origins(topology.base_points, start["q0"][:, None, None])[:, 0, 0]
        return cls(topology, q, start["v0"], torch.cat([mask, modal]), built, _size(topology, bodies, q, built))

    @cached_property
    def condensed(self) -> Condensation | None:
        """The condensation of the joints to the ground; None if there is nothing to condense."""
        return condense(self.topology, self.q, self.size) if self.topology.rows else None

    def shared_start(self, dynamics: Any) -> SharedStart | None:
        """The start of all designs of `dynamics`; None if it depends on the design. Raises InputError as `solve` does."""
        T, x = self.topology, dynamics.data["x"]
        if (
            not T.rows
            or T.varying_primitives
            or T.varying_vectors
            or START_DATA[0] in dynamics.data
            or isinstance(x, Pair)
            or x.requires_grad
            or x.shape[-1] > 1
            or wraps(*map(value, dynamics.data.values()))  # what is kept has to outlast the transform
        ):
            return None
        laws = [drive for drive in T.law_jets(x.new_zeros(()), dynamics.data) if drive]
        inputs = [x, *(part for drive in laws for jet in drive for part in jet.parts)]
        if not self._last or not all(map(torch.equal, inputs, self._last[0][0])):
            data = {name: value(y).detach()[..., :1] for name, y in dynamics.data.items()}
            data |= {name: torch.zeros_like(data[name]) for name in ("Y", "E") if name in data}
            undeformed = replace(dynamics, data=data)
            q, v = self.assembled(undeformed)
            shared = None
            if not self._needs_modes(undeformed, q, v):
                shared = SharedStart(q, self.compatible(undeformed, q, v), {})
            self._last[:] = [(inputs, shared)]
        return self._last[0][1]

    def _needs_modes(self, undeformed: Any, q: Tensor, v: Tensor) -> bool:
        """True if rigid rates leave constraint rates open at q [n_q, 1, 1] and given v [n_v, 1, 1]."""
        if not self.topology.flexible:
            return False
        joints = _Joints.of(undeformed, q, q.new_zeros(()), [self.rigid_mask], self.topology.base_points)
        x = joints.rates(v)
        open_rates, *largest = (y.abs().max() for y in (joints.open_rates(x), v / value(joints.s), x / joints.rho))
        return float(open_rates) > _OPEN * float(max(largest))

    def open(self, dynamics: Any) -> tuple[Tensor, Closing]:
        """Where the bodies of one design were put [n_q, 1, 1], and what is open there."""
        q = value(self._given_positions(dynamics.data)).detach()
        return q, Closing.of(dynamics, q, q)

    @property
    def rigid_mask(self) -> Tensor:
        """Rates that deform no body [n_v]."""
        return torch.arange(self.topology.n_v) < 6 * self.topology.bodies

    @property
    def closing_levels(self) -> list[Tensor]:
        """Levels of the coordinates that close the joints [n_v]."""
        return [self.rigid_mask]

    def solve(self, dynamics: Any):
        """Initial q [n_q, 1, lanes] and v [n_v, 1, lanes] with closed joints; pairs where they depend on pairs.

        Raises InputError that names the joints that do not close.
        """
        if dynamics.shared_start is None:
            return self._solve(dynamics)
        return tuple(
            x.expand(-1, 1, dynamics.lanes).contiguous() for x in (dynamics.shared_start.q, dynamics.shared_start.v)
        )

    def _solve(self, dynamics: Any):
        q, v = self.assembled(dynamics)
        return q, self.compatible(dynamics, q, v)

    def assembled(self, dynamics: Any):
        """Positions q that close the joints, and the rates v that origins of bodies were given [n, 1, lanes]; pairs as in
        `solve`."""
        T, data = self.topology, dynamics.data
        device = value(data["x"]).device
        lanes = dynamics.lanes
        t = torch.zeros((), dtype=torch.float64, device=device)
        q, v = (
            linear(lambda y: y.expand(*y.shape[:-1], lanes).contiguous(), x)
            for x in (self._given_positions(data), data.get(START_DATA[1], self.v.to(device)[:, None, None]))
        )
        if not T.rows:
            return q, v
        start = value(q).detach()
        if T.beams is not None:
            q = RigidGroups.by_beams(T).closed(dynamics, q, t, self._closed(q))
        unstrained = value(q).detach()
        for step in range(_STEPS):
            joints = _Joints.of(dynamics, q, t, self.closing_levels)
            phi = joints.violation()
            if bool((untransformed(value(phi)).abs() <= self._closed(q)).all()):
                if step or T.beams is not None:
                    dynamics.outside_transforms(self._warn_moved, start, value(q).detach())
                if step and T.beams is not None:
                    dynamics.outside_transforms(self._warn_strained, unstrained, value(q).detach())
                break
            q = equations.advance(T, q, joints.step(phi))
        else:
            outside_transforms(self._refuse, value(phi), self._closed(q).expand_as(value(phi)))
        return equations.advance(T, q, linear(torch.neg, joints.correction(phi))), v

    def _closed(self, q: Any) -> Tensor:
        """Largest violations [rows, 1, 1] of closed joints at coordinates q [n_q, ...]."""
        return closed_rows(self.topology, self.size, untransformed(value(q)))

    @property
    def _row_sizes(self) -> Tensor:
        """The sizes of the rows of constraints [rows, 1, 1] (equations/sizes.py)."""
        return row_sizes(self.topology, self.size)

    def _given_positions(self, data: Any) -> Any:
        """Coordinates that the bodies were given [n_q, ...]."""
        if START_DATA[0] not in data:
            return self.q.to(value(data["x"]).device)[:, None, None]
        return base_points.of_origins(self.topology.base_points, data[START_DATA[0]])

    def closing(self, dynamics: Any) -> Closing:
        """What closing the joints of one design moves."""
        if not self.topology.rows:
            return Closing()
        start = value(self._given_positions(dynamics.data)).detach()
        return Closing.of(dynamics, start, value(self.assembled(dynamics)[0]).detach())

    def _warn_moved(self, dynamics: Any, start: Tensor, q: Tensor) -> None:
        """Warn of joints that are open in the model as it was built. That other designs move bodies is what they are for."""
        places = slice(3 * self.topology.bodies)
        ways = float((q - start)[places].abs().max()) / self.size, float((q - start).abs()[places.stop :].max())
        if not max(ways) > _MOVED:
            return
        same = (value(dynamics.data["x"])[:, :, 0].detach() == self.built).all(0).all(0)
        if bool(same.any()):
            lane = int(same.nonzero()[0, 0])
            start, q = (x[..., min(lane, x.shape[-1] - 1)][..., None] for x in (start, q))
            of_lane = dynamics.select_lanes([lane]) if dynamics.lanes > 1 else dynamics
            warn_far(Closing.of(of_lane, start, q), self.in_equilibrium)

    def _warn_strained(self, dynamics: Any, unstrained: Tensor, q: Tensor) -> None:
        """Warn of joints that no rigid motion of exact beams closes."""
        T, data, t = self.topology, dynamics.values().data, torch.zeros((), dtype=torch.float64)
        before, after = (equations.placement(T, data, x, T.prescribed(t, data)) for x in (unstrained, q))
        gaps = equations.constraints(T, before).abs()
        if bool((gaps > _STRAINING * self._row_sizes).any()):
            gap = float(gaps.max())
            energy = float((stored_energy(T, data, after) - stored_energy(T, data, before)).max())
            warn(  # few different texts: Python shows each once in an optimization
                f"closing the joints strains exact beams, because rigid motions leave gaps of {gap:.1g} m or rad. The "
                f"strain energy increases by {energy:.1g} J. Try: beams that fit between their joints"
            )

    def compatible(self, dynamics: Any, q: Any, v: Any):
        """Rates [n_v, 1, lanes] that the joints allow at closed positions q [n_q, 1, lanes], nearest to those of origins v
        [n_v, 1, lanes]."""
        T = self.topology
        if not T.rows:
            return base_points.rates_of_origins(T.base_points, rotation_matrix(equations.split_q(T, q)[1]), v)
        t = torch.zeros((), dtype=torch.float64, device=value(q).device)
        levels = [self.rigid_mask & ~self.rate_mask, self.rate_mask, ~self.rigid_mask]
        joints = _Joints.of(dynamics, q, t, levels, T.base_points)
        s = joints.step(joints.rates(v))
        outside_transforms(self._warn_changed, value(v), value(s).detach())
        return joints.of_base_points(v + s)

    def _warn_changed(self, v: Tensor, s: Tensor) -> None:
        """Warn of given velocities v that corrections s change [n_v, 1, lanes]."""
        v, s = v[:, 0], s[:, 0]
        n, changed = self.topology.bodies, []
        sizes = torch.ones_like(s[:, :1])
        sizes[: 3 * n] = self.size
        shares = s / sizes, v / sizes
        for k, (kind, unit) in enumerate((("velocity", "m/s"), ("angular velocity", "rad/s"))):
            for i, name in enumerate(self.topology.names):
                rows = [3 * n * k + n * j + i for j in range(3)]
                change, lane = shares[0][rows].norm(dim=0).max(0)
                if self.rate_mask[rows[0]] and float(change) > _KEPT * float(shares[1][:, lane].abs().max()):
                    before, new = (", ".join(f"{x:.4g}" for x in y[rows, lane].tolist()) for y in (v, v + s))
                    changed.append((-float(change), f"{kind} of {name!r} given ({before}), starts with ({new}) {unit}"))
        if changed:
            shown, more = [text for _, text in sorted(changed)[:_SHOWN]], len(changed) - _SHOWN
            warn(
                f"the joints do not allow the initial velocities that the bodies were given: {'; '.join(shown)}"
                + (f"; and {more} more" if more > 0 else ""),
            )

    def _refuse(self, phi: Tensor, closed: Tensor) -> None:
        T, phi, closed = self.topology, phi.abs().amax((1, 2)), closed[:, 0, 0]
        worst = torch.argsort(phi / closed, descending=True)[:4]
        rows = "; ".join(
            f"{T.row_names[i]} misses by {float(phi[i]):.3g}" for i in worst.tolist() if phi[i] > closed[i]
        )
        raise DoesNotClose(
            "joints",
            allowed="must have positions from which Newton's method can close all joints"
            + (", or start='equilibrium', which bends flexible bodies to close them" if T.flexible else ""),
            noun="the mechanism",
            state=f"does not close at the given positions, lengths and axes: {rows}",
        )


@dataclass(frozen=True, eq=False)
class _Joints:
    """The joints of all lanes at coordinates q and time t; level: the last of the rates that satisfy them.

    rho, s  sizes of rows [rows, 1, lanes] and rates [n_v, ...], by which those of the level are divided; s has derivatives
    arms   base points of the bodies where rates v, s are those of origins; None: they are those of base points
    """

    dynamics: Any
    at: equations.Placement
    t: Tensor
    level: RateLevel
    rho: Tensor
    s: Any
    arms: Tensor | None

    @classmethod
    def of(cls, dynamics: Any, q: Any, t: Tensor, masks: Sequence[Tensor], arms: Tensor | None = None) -> _Joints:
        """masks: the rates of each level [n_v], the preferred ones first."""
        T, data = dynamics.topology, dynamics.data
        values = {name: value(x).detach() for name, x in data.items()}
        plain = equations.placement(T, values, value(q).detach(), T.prescribed(t, values))
        J = dynamics.saddle.jacobian(values, plain)
        J = base_points.forces_on_origins(arms, plain.A[:, :, : T.bodies], J.permute(2, 1, 0)).permute(2, 1, 0)
        at = equations.placement(T, data, q, T.prescribed(t, data))
        size = size_at(T, q, at)
        rho, s = row_sizes(T, value(size).detach(), values), rate_sizes_at(T, size)
        J = J * value(s).detach().permute(2, 1, 0) / rho.permute(2, 0, 1)
        levels = rate_levels(T, J, [mask.to(J.device) for mask in masks if bool(mask.any())])
        return cls(dynamics, at, t, levels, rho, s, arms)

    def violation(self) -> Any:
        """Phi [rows, ...]."""
        return equations.constraints(self.dynamics.topology, self.at)

    def rates(self, v: Any) -> Any:
        """Phi' = J v + Phi_t [rows, ...]."""
        T, data = self.dynamics.topology, self.dynamics.data
        v = self.of_base_points(v)
        return equations.constraint_rates(T, self.at, data, v, self.t)

    def changes(self, v: Any) -> Any:
        """J v [rows, ...]."""
        dynamics = self.dynamics
        return equations.constraint_changes(dynamics.topology, self.at, dynamics.data, self.of_base_points(v))

    def of_base_points(self, v: Any) -> Any:
        """Rates v [n_v, ...] with velocities of base points."""
        return base_points.rates_of_origins(self.arms, self._rotations, v)

    @property
    def _rotations(self) -> Any:
        return self.at.A[:, :, : self.dynamics.topology.bodies]

    def correction(self, x: Any) -> Any:
        """K x [n_v, ...] of x [rows, ...]."""
        return self.s * linear(lambda y: apply(self.level.K, y / self.rho), x)

    def step(self, x: Any) -> Any:
        """Rates s [n_v, ...] of least size with J s = -x, x [rows, ...]; derivatives also of J and of the sizes of rates."""
        least = -apply(self.level.K, value(x).detach() / self.rho)
        s = self.s * least
        return s + self.s * self.jacobian_part(least) - self.correction(x + self.changes(s))

    def open_rates(self, x: Tensor) -> Tensor:
        """The part of constraint rates x [rows, ...] that no rates of the levels make, divided by sizes of rows."""
        return x / self.rho - apply(self.level.made, x / self.rho)

    def jacobian_part(self, s: Tensor) -> Any:
        """D [n_v, ...]: derivatives of J in rates s, divided by their sizes, at fixed Phi + J s, of value zero."""
        D = self.level.changes(s, lambda y: self.s * self._constraint_forces(y / self.rho))
        return D - value(D).detach()  # rounding, of small bodies with large modes

    def _constraint_forces(self, y: Tensor) -> Any:
        """J' y [n_v, ...] with the derivatives of J."""
        T, data = self.dynamics.topology, self.dynamics.data
        forces = cat([x.flatten(0, 1) for x in equations.constraint_forces(T, data, self.at, y)])
        return base_points.forces_on_origins(self.arms, self._rotations, forces)
