"""Static equilibrium of a mechanism with beams by continuation: loads grow in steps, and so do the forces missing at the start.

    s g(q) + f(q) + Phi_q' lam = (1 - s) f(start),    Phi(q) = (1 - s) Phi(start)          s: the factor, 0 to 1

g are weight and, in a steady rotation, centrifugal forces; f(start) keeps its direction in ground axes. From a start without
stress g and -f(start) are the loads, and the share s of them acts. Between two iterations the stiffness takes the forces of
beam elements extrapolated by their derivative, as mixed finite elements do: those of a half-converged shape are far off in
slender beams. A step is halved where Newton's method fails, where its increment differs from that of the rates at both ends,
and where the equilibrium is unstable, as in fem/exact_beam/continuation.py.
Checked in tests/multibody/equilibrium/test_load_steps.py.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchmbd.fem.exact_beam.continuation import (
    INCREMENT_TOLERANCE,
    ITERATIONS,
    LARGEST_TURN,
    LIMIT_POINT_RATE,
    SMALLEST_STEP,
    agree_with_rates,
)
from torchmbd.math.pair import Pair, matvec, matvec_t
from torchmbd.math.rotation import rotation_matrix
from torchmbd.multibody.equations import beams, equations
from torchmbd.multibody.equilibrium.linearized import Linearization
from torchmbd.multibody.equilibrium.steady_rotation import SteadyRotation

_ROUNDING = 1e-12  # share of the largest singular value below which a freedom has no stiffness
_SYMMETRIC = 1e-7  # unsymmetry that counts as none, of a stiffness with a unit diagonal
_UNSTABLE, _FAILED = "unstable", "failed"


@dataclass(frozen=True)
class LoadPath:
    """The end of the steps: coordinates at the last factor, and why there is no further step, else ""."""

    q: Tensor
    factor: float
    failure: str


@dataclass(frozen=True)
class _Point:
    factor: float
    q: Tensor
    rest: Linearization


class LoadSteps:
    """Continuation of the equilibrium of one design `dynamics` from start [n_q] at time t.

    rotation   steady rotation of the whole system; its centrifugal forces are among the loads
    stable     whether the start is stable under small loads
    """

    def __init__(self, dynamics: Any, start: Tensor, t: Tensor, rotation: SteadyRotation | None = None):
        self.dynamics, self.t, self.rotation = dynamics, t, rotation
        first, rotation = self._loaded(0.0)
        rest = Linearization.of(first, start, t, None, rotation)
        self.forces, self.phi = rest.forces.clone(), rest.phi
        n = 3 * dynamics.topology.bodies
        self.rotations = turning = slice(n, 2 * n)
        self.forces[turning] = matvec(_axes(start, turning), rest.forces[turning].reshape(3, -1)).flatten()
        self.scale = rest.scale
        self.first = _Point(0.0, start, self._linearize(start, 0.0))
        self.stable = _stiff(self.first.rest) and not _unstable(self.first.rest)

    def run(self) -> LoadPath:
        """Increase the loads to their full size, or as far as equilibria are stable."""
        point, moved, largest = self.first, torch.zeros_like(self.forces), 1.0
        while point.factor < 1.0:
            rate = self._rate(point.q, point.rest)
            turn = float(rate[self.rotations].abs().max())
            step, why, new, total = (
                min(1.0 - point.factor, largest, LARGEST_TURN / max(turn, 1e-300)),
                _FAILED,
                None,
                moved,
            )
            while step >= SMALLEST_STEP:
                new, why, total = self._step(point, step, rate)
                if new is not None:
                    break
                step = 0.5 * step
            if new is None:
                return LoadPath(point.q, point.factor, self._failure(point, why, rate, moved))
            point, moved, largest = new, moved + total, 2.0 * step
        return LoadPath(point.q, 1.0, "")

    def _failure(self, point: _Point, why: str, rate: Tensor, moved: Tensor) -> str:
        steep = self._size(rate) * point.factor > LIMIT_POINT_RATE * self._size(moved)
        where = f"at {point.factor:.4g} of the loads"
        if why == _UNSTABLE:
            return f"the mechanism buckles {where}"
        return f"a limit point is reached {where}" if steep else f"no equilibrium is found beyond the one {where}"

    def _step(self, old: _Point, step: float, rate: Tensor) -> tuple[_Point | None, str, Tensor]:
        """The equilibrium after a step of the factor, or None; _UNSTABLE, _FAILED or ""; and the increment of coordinates."""
        at = 1.0 if old.factor + step > 1.0 - SMALLEST_STEP else old.factor + step
        q, predicted, total = old.q, 0.0, torch.zeros_like(self.forces)
        rest = self._linearize(q, at)
        for _ in range(ITERATIONS):
            move = _solved(rest, rest.forces, rest.phi)
            length = self._size(move)
            predicted = predicted or length
            if not length <= 10.0 * predicted:
                break
            forces, total = self._extrapolated(q, move), total + move
            q = equations.advance(self.dynamics.topology, q[:, None, None], move[:, None, None])[:, 0, 0]
            settled = float((move / self.scale).abs().max()) <= INCREMENT_TOLERANCE
            rest = self._linearize(q, at, None if settled else forces)
            if not bool(torch.isfinite(rest.K).all()):
                break
            if not settled:
                continue
            new = _Point(at, q, rest)
            before, after = ((at - old.factor) * x for x in (rate, self._rate(q, rest)))
            if not agree_with_rates(self._size, total, before, after):
                break
            return (None, _UNSTABLE, total) if _unstable(rest) else (new, "", total)
        return None, _FAILED, total

    def _linearize(self, q: Tensor, factor: float, forces: Tensor | None = None) -> Linearization:
        """The linearized equations of a factor at q.

        forces   forces of the elements [6, n, 1, 1] in the stiffness; None: those at q
        """
        offset = (1.0 - factor) * self.forces, (1.0 - factor) * self.phi
        unstrained = None
        if forces is not None:
            K = self.dynamics.data["beam_stiffness"].permute(2, 3, 4, 0, 1)
            strain = torch.linalg.solve(K, forces.permute(1, 2, 3, 0)[..., None])[..., 0]
            unstrained = self._elements(q).screw - strain.permute(3, 0, 1, 2)
        dynamics, rotation = self._loaded(factor)
        return Linearization.of(dynamics, q, self.t, offset, rotation, unstrained)

    def _loaded(self, factor: float) -> tuple[Any, SteadyRotation | None]:
        """The dynamics with `factor` times its weight, and the rotation with `factor` times its centrifugal forces."""
        data, rotation = self.dynamics.data, self.rotation
        if "gravity" in data:
            data = data | {"gravity": factor * data["gravity"]}
        if rotation is not None:
            rotation = replace(rotation, spin=factor**0.5 * rotation.spin)
        return replace(self.dynamics, data=data), rotation

    def _growing_loads(self, q: Tensor) -> Tensor:
        """g of the module header at q [n_v]."""
        T, wide = self.dynamics.topology, q[:, None, None]
        still, none = q.new_zeros(T.n_v, 1, 1), q.new_zeros(T.rows, 1, 1)
        residuals = []
        for factor in (1.0, 0.0):
            dynamics, rotation = self._loaded(factor)
            at = equations.placement(T, dynamics.data, wide, T.prescribed(self.t, dynamics.data))
            rates = (still, still) if rotation is None else rotation.rates(T, wide)
            residuals.append(equations.dynamic_residual(T, dynamics.data, at, *rates, none)[:, 0, 0])
        return residuals[0] - residuals[1]

    def _extrapolated(self, q: Tensor, move: Tensor) -> Tensor:
        """Forces of the elements [6, n, 1, 1] after an increment of q, by their derivative."""
        force = self._elements(q, Pair.of(torch.zeros_like(move)[:, None, None], move[:, None, None])).force
        return force.value + force.tangent

    def _elements(self, q: Tensor, move: Any = None) -> beams.Elements:
        T, data, q = self.dynamics.topology, self.dynamics.data, q[:, None, None]
        at = equations.placement(
            T, data, q if move is None else equations.advance(T, q, move), T.prescribed(self.t, data)
        )
        return beams.elements(T, data, at)

    def _rate(self, q: Tensor, rest: Linearization) -> Tensor:
        """Derivative of the coordinates by the factor [n_v]."""
        forces, turning = self.forces.clone(), self.rotations
        forces[turning] = matvec_t(_axes(q, turning), forces[turning].reshape(3, -1)).flatten()
        return _solved(rest, forces + self._growing_loads(q), self.phi)

    def _size(self, increment: Tensor) -> float:
        """Norm of an increment [n_v] without a unit: displacements by the size of the mechanism."""
        return float((increment / self.scale).norm())


def _axes(q: Tensor, rotations: slice) -> Tensor:
    """Axes of the bodies [3, 3, bodies] at q; rotations: their rows of v."""
    first = rotations.start
    return rotation_matrix(q[first : 7 * first // 3].reshape(4, -1))


def _solved(rest: Linearization, forces: Tensor, phi: Tensor) -> Tensor:
    """Increment [n_v] that balances residual forces [n_v] and removes violations phi [rows]."""
    active = rest.active
    close = -rest.right_inverse @ phi
    slide = torch.linalg.solve(rest.reduced(rest.K), rest.N.T @ (forces[active] + rest.K[active][:, active] @ close))
    result = torch.zeros_like(forces)
    result[active] = close - rest.N @ slide
    return result


def _scaled(rest: Linearization) -> Tensor:
    """Reduced stiffness with a diagonal of 1 or -1."""
    K = rest.reduced(rest.K)
    d = K.diagonal().abs().clamp_min(1e-300).sqrt()
    return K / d / d[:, None]


def _stiff(rest: Linearization) -> bool:
    """True if there are degrees of freedom, and all have stiffness."""
    if not rest.N.shape[1]:
        return False
    s = torch.linalg.svdvals(_scaled(rest))
    return float(s[-1]) > _ROUNDING * float(s[0])


def _unstable(rest: Linearization) -> bool:
    """True if an eigenvalue of the stiffness is negative; where loads have no potential, an odd number of them."""
    K = _scaled(rest)
    if float((K - K.T).abs().max()) > _SYMMETRIC:
        return float(torch.linalg.slogdet(K)[0]) < 0.0
    return float(torch.linalg.eigvalsh(0.5 * (K + K.T))[0]) < 0.0
