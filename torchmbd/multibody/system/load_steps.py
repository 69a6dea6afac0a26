"""Static equilibrium of a mechanism with beams by continuation: loads grow; what else the start lacks is taken away in steps.

    s g(q) + f(q) + Phi_q' lam = (1 - s) f(start),    Phi(q) = (1 - s) Phi(start)          s: the factor, 0 to 1

g are weight and, in a steady rotation, centrifugal forces; f(start) keeps its direction in ground axes. Where the start is
without stress both are the loads, and s the part of them that acts. The stiffness is that of the mixed equations: between two
iterations it has the forces of beams' elements extrapolated by their derivative, as those of a half-converged shape are far off
in slender beams. A step is halved where Newton's method fails, where it ends elsewhere than the rates at both ends say, and
where the equilibrium there is unstable, as those of a beam alone (fem/exact_beam/continuation.py).
Checked in tests/multibody/system/test_load_steps.py.
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
    MEAN_RATE_TOLERANCE,
    SMALLEST_STEP,
    START_RATE_TOLERANCE,
)
from torchmbd.math.pair import Pair, matvec, matvec_t
from torchmbd.math.rotation import rotation_matrix
from torchmbd.multibody.system import beams, equations
from torchmbd.multibody.system.linearized import Linearization
from torchmbd.multibody.system.steady_rotation import SteadyRotation

_ROUNDING = 1e-12  # of the largest eigenvalue: a freedom without stiffness
_SYMMETRIC = 1e-7  # of the diagonal
_UNSTABLE, _FAILED = "unstable", "failed"


@dataclass(frozen=True)
class LoadPath:
    """Where the steps ended: the state at the last factor, and why there is none beyond, else ""."""

    q: Tensor
    factor: float
    failure: str


@dataclass(frozen=True)
class _Point:
    factor: float
    q: Tensor
    rest: Linearization


class LoadSteps:
    """Of one design `dynamics` near start [n_q] at time t. `stable`: whether the start bears small loads.

    rotation   of the whole, whose centrifugal forces are loads like others
    """

    def __init__(self, dynamics: Any, start: Tensor, t: Tensor, rotation: SteadyRotation | None = None):
        self.dynamics, self.t, self.rotation = dynamics, t, rotation
        whole = self._rest(start, 0.0, given=True)
        self.forces, self.phi = whole.forces.clone(), whole.phi
        n = 3 * dynamics.topology.bodies
        self.rotations = turning = slice(n, 2 * n)
        self.forces[turning] = matvec(_axes(start, turning), whole.forces[turning].reshape(3, -1)).flatten()
        place = start[:n].reshape(3, -1)
        size = float((place.amax(1) - place.amin(1)).norm()) or 1.0
        self.scale = torch.ones_like(whole.forces)
        self.scale[:n] = size
        self.first = _Point(0.0, start, self._rest(start, 0.0))
        self.stable = _stiff(self.first.rest) and not _unstable(self.first.rest)

    def run(self) -> LoadPath:
        """To all loads, or as far as a stable equilibrium follows."""
        point, moved, largest = self.first, torch.zeros_like(self.forces), 1.0
        while point.factor < 1.0:
            rate = self._rate(point.q, point.rest)
            turn = float(rate[self.rotations].abs().max())
            step, why, found, total = (
                min(1.0 - point.factor, largest, LARGEST_TURN / max(turn, 1e-300)),
                _FAILED,
                None,
                moved,
            )
            while step >= SMALLEST_STEP:
                found, why, total = self._step(point, step, rate)
                if found is not None:
                    break
                step = 0.5 * step
            if found is None:
                return LoadPath(point.q, point.factor, self._failure(point, why, rate, moved))
            point, moved, largest = found, moved + total, 2.0 * step
        return LoadPath(point.q, 1.0, "")

    def _failure(self, point: _Point, why: str, rate: Tensor, moved: Tensor) -> str:
        steep = self._size(rate) * point.factor > LIMIT_POINT_RATE * self._size(moved)
        where = f"at {point.factor:.4g} of the loads"
        if why == _UNSTABLE:
            return f"the mechanism buckles {where}"
        return f"a limit point is reached {where}" if steep else f"no equilibrium is found beyond the one {where}"

    def _step(self, old: _Point, step: float, rate: Tensor) -> tuple[_Point | None, str, Tensor]:
        """The equilibrium that follows, or None and why; and the increment."""
        at = 1.0 if old.factor + step > 1.0 - SMALLEST_STEP else old.factor + step
        q, predicted, total = old.q, 0.0, torch.zeros_like(self.forces)
        rest = self._rest(q, at)
        for _ in range(ITERATIONS):
            move = _solved(rest, rest.forces, rest.phi)
            length = self._size(move)
            predicted = predicted or length
            if not length <= 10.0 * predicted:
                break
            forces, total = self._extrapolated(q, move), total + move
            q = equations.advance(self.dynamics.topology, q[:, None, None], move[:, None, None])[:, 0, 0]
            settled = float((move / self.scale).abs().max()) <= INCREMENT_TOLERANCE
            rest = self._rest(q, at, None if settled else forces)
            if not bool(torch.isfinite(rest.K).all()):
                break
            if not settled:
                continue
            new = _Point(at, q, rest)
            before, after = ((at - old.factor) * x for x in (rate, self._rate(q, rest)))
            size, apart = self._size(total), self._size(total - 0.5 * (before + after))
            if self._size(total - before) > START_RATE_TOLERANCE * size or apart > MEAN_RATE_TOLERANCE * size:
                break
            return (None, _UNSTABLE, total) if _unstable(rest) else (new, "", total)
        return None, _FAILED, total

    def _rest(self, q: Tensor, factor: float, stretched: Tensor | None = None, given: bool = False) -> Linearization:
        """At q; given: with all that is out of balance at the start.

        stretched   forces of the elements [6, n, 1, 1] in the stiffness, where they are not those at q
        """
        less = None if given else ((1.0 - factor) * self.forces, (1.0 - factor) * self.phi)
        unstrained = None
        if stretched is not None:
            K = self.dynamics.data["beam_stiffness"].permute(2, 3, 4, 0, 1)
            strain = torch.linalg.solve(K, stretched.permute(1, 2, 3, 0)[..., None])[..., 0]
            unstrained = self._elements(q).screw - strain.permute(3, 0, 1, 2)
        dynamics, rotation = self._loaded(factor)
        return Linearization.of(dynamics, q, self.t, less, rotation, unstrained)

    def _loaded(self, factor: float) -> tuple[Any, SteadyRotation | None]:
        """The design with a part of its weight, and the rotation with that of its centrifugal forces."""
        data, rotation = self.dynamics.data, self.rotation
        if "gravity" in data:
            data = data | {"gravity": factor * data["gravity"]}
        if rotation is not None:
            rotation = replace(rotation, spin=factor**0.5 * rotation.spin)
        return replace(self.dynamics, data=data), rotation

    def _growing(self, q: Tensor) -> Tensor:
        """g of the module header at q [n_v]."""
        T, wide = self.dynamics.topology, q[:, None, None]
        still, none = q.new_zeros(T.n_v, 1, 1), q.new_zeros(T.rows, 1, 1)
        found = []
        for factor in (1.0, 0.0):
            dynamics, rotation = self._loaded(factor)
            at = equations.placement(T, dynamics.data, wide, T.prescribed(self.t, dynamics.data))
            rates = (still, still) if rotation is None else rotation.rates(T, wide)
            found.append(equations.dynamic_residual(T, dynamics.data, at, *rates, none)[:, 0, 0])
        return found[0] - found[1]

    def _extrapolated(self, q: Tensor, move: Tensor) -> Tensor:
        """Forces of the elements after an increment, by their derivative [6, n, 1, 1]."""
        force = self._elements(q, Pair.of(torch.zeros_like(move)[:, None, None], move[:, None, None])).force
        return force.value + force.tangent

    def _elements(self, q: Tensor, move: Any = None) -> beams.Elements:
        T, data, q = self.dynamics.topology, self.dynamics.data, q[:, None, None]
        at = equations.placement(
            T, data, q if move is None else equations.advance(T, q, move), T.prescribed(self.t, data)
        )
        return beams.elements(T, data, at)

    def _rate(self, q: Tensor, rest: Linearization) -> Tensor:
        """Increment by the factor."""
        own, turning = self.forces.clone(), self.rotations
        own[turning] = matvec_t(_axes(q, turning), own[turning].reshape(3, -1)).flatten()
        return _solved(rest, own + self._growing(q), self.phi)

    def _size(self, increment: Tensor) -> float:
        return float((increment / self.scale).norm())


def _axes(q: Tensor, rotations: slice) -> Tensor:
    """Axes of the bodies [3, 3, bodies] at q."""
    first = rotations.start
    return rotation_matrix(q[first : 7 * first // 3].reshape(4, -1))


def _solved(rest: Linearization, forces: Tensor, phi: Tensor) -> Tensor:
    """Increment [n_v] that takes forces away and closes joints."""
    own = rest.active
    close = -torch.linalg.pinv(rest.Phi_q[:, own], rtol=1e-9) @ phi
    slide = torch.linalg.solve(rest.reduced(rest.K), rest.N.T @ (forces[own] + rest.K[own][:, own] @ close))
    result = torch.zeros_like(forces)
    result[own] = close - rest.N @ slide
    return result


def _scaled(rest: Linearization) -> Tensor:
    K = rest.reduced(rest.K)
    d = K.diagonal().abs().clamp_min(1e-300).sqrt()
    return K / d / d[:, None]


def _stiff(rest: Linearization) -> bool:
    """Whether no freedom is without stiffness."""
    if not rest.N.shape[1]:
        return False
    size = torch.linalg.svdvals(_scaled(rest))
    return float(size[-1]) > _ROUNDING * float(size[0])


def _unstable(rest: Linearization) -> bool:
    """Whether an eigenvalue of the stiffness is negative; where loads have no potential, an odd number of them."""
    K = _scaled(rest)
    if float((K - K.T).abs().max()) > _SYMMETRIC:
        return float(torch.linalg.slogdet(K)[0]) < 0.0
    return float(torch.linalg.eigvalsh(0.5 * (K + K.T))[0]) < 0.0
