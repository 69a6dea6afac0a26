"""Equilibrium of one exact beam by Newton's method while its loads grow: steps of variable size, limit points, buckling.

    K(q, f*) dq = p(factor + step) - f(q)       f* = f(q before) + df/dq dq: forces of the elements by their derivative

K is that of the mixed equations in displacements and forces: where rotations stretch slender elements, the forces f(q)
between two iterations are far off, f* are not (D. Magisano, L. Leonetti, G. Garcea, Int. J. Numer. Methods Eng. 109 (2017)
1237-1262). At convergence f* = f(q). The first increment of a step is its predictor.

The predictor of a step turns no node by more than LARGEST_TURN. A step is halved
- where Newton's method fails,
- where its increment differs from what the rates at both ends predict (it reached another branch),
- where the equilibrium at its end is unstable: K has negative eigenvalues, as many as negative pivots; where loads have no
  potential, an odd number of negative pivots, which means that the determinant changed its sign.
The factor at which the search ends is known to SMALLEST_STEP.
Checked in tests/fem/exact_beam/test_continuation.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
import torch
from torch import Tensor

from torchmbd.fem.exact_beam.data import BeamData, Topology
from torchmbd.fem.exact_beam.forces import element_tangents, load_tangents, residual, screw_forces, screws
from torchmbd.math.rigid_motion import LARGEST, exponential
from torchmbd.math.sparse import Pattern

LARGEST_TURN = 1.0  # largest rotation of a node in a step [rad]
ITERATIONS = 15
INCREMENT_TOLERANCE = (
    1e-9  # last increment, relative to the size of the beam, and in rad: the next one is below rounding
)
# Largest relative difference between the increment of a step and that of the rate at its start, or of the mean of the rates at
# both ends. Both together exclude a jump to a branch that hardly moves, where the mean is half of the rate at the start.
START_RATE_TOLERANCE, MEAN_RATE_TOLERANCE = 0.5, 0.2
SMALLEST_STEP = 1e-5  # of the factor of the loads
LIMIT_POINT_RATE = 20.0  # displacement per load over its mean since the start: beyond this a limit point is near
LARGE_ELEMENT_TURN = 0.75 * LARGEST  # rotation of an element at which its limit is the likely reason of a failure [rad]
STATUS = ("ok", "limit point", "unstable", "not converged", "turned too far")


@dataclass
class Path:
    """Result of the search of one design.

    code       index into STATUS
    factor     of the loads at the last equilibrium
    x, R       positions [n, 3] and rotations [n, 3, 3] of the nodes at that equilibrium
    K          stiffness of its free degrees of freedom
    factors    of the loads at all equilibria, first 0
    places     positions of the nodes at these [n, 3]
    """

    code: int
    factor: float
    x: Tensor
    R: Tensor
    K: scipy.sparse.csc_array
    factors: list[float] = field(default_factory=list)
    places: list[Tensor] = field(default_factory=list)


@dataclass
class _Equilibrium:
    """An equilibrium: load factor, positions, rotations, element forces, stiffness of all degrees of freedom."""

    factor: float
    x: Tensor
    R: Tensor
    f: Tensor
    K: Any = None


class Continuation:
    """Finds equilibria of beams of one topology.

    follow  whether the search goes on past unstable equilibria
    paths   results of the last search, one for each lane
    """

    paths: list[Path]

    def __init__(self, topology: Topology, nodes: int, follow: bool = False) -> None:
        self.topology, self.follow = topology, follow
        ends = (6 * topology.elements[:, :, None] + torch.arange(6)).flatten(1)  # [m, 12]
        freedoms = torch.arange(6 * nodes).reshape(nodes, 6)
        rows = [x[:, :, None].expand(-1, -1, x.shape[1]).flatten() for x in (ends, freedoms)]
        cols = [x[:, None, :].expand(-1, x.shape[1], -1).flatten() for x in (ends, freedoms)]
        self._pattern, self._slot = Pattern.gather(torch.cat(rows), torch.cat(cols), 6 * nodes)

    def stiffness(self, data: BeamData, x: Tensor, R: Tensor, f: Tensor, factor: float) -> tuple[Any, Tensor]:
        """Return K of all degrees of freedom of a design with element forces f, and df by motions of the nodes [m, 6, 12]."""
        elements, B = element_tangents(data, self.topology, x, R, f)
        blocks = torch.cat([elements.flatten(), load_tangents(data, x, R, factor).flatten()])
        values = blocks.new_zeros(self._pattern.nnz).index_add(0, self._slot, blocks)
        return self._pattern.to_scipy(values), B

    def run(self, data: BeamData) -> Path:
        """Increase the loads from zero to their given size, as far as equilibria exist."""
        n = len(data.nodes)
        size = float((data.nodes.amax(0) - data.nodes.amin(0)).norm())
        self._scale = np.tile([size] * 3 + [1.0] * 3, n)
        state = _Equilibrium(
            0.0, data.nodes, torch.eye(3, dtype=torch.float64).expand(n, 3, 3), torch.zeros_like(data.screws)
        )
        state.K, _ = self.stiffness(data, state.x, state.R, state.f, 0.0)
        path = Path(0, 0.0, state.x, state.R, state.K, [0.0], [state.x])
        moved, largest = np.zeros(6 * n), 1.0
        while state.factor < 1.0:
            rate = self._rate(data, state)  # of increments by the factor
            fast = float(np.abs(rate.reshape(n, 6)[:, 3:]).max()) if np.isfinite(rate).all() else np.inf
            step, why, equilibrium = min(1.0 - state.factor, largest, LARGEST_TURN / max(fast, 1e-300)), 3, None
            while step >= SMALLEST_STEP:
                equilibrium, why, increment = self._step(data, state, step, rate)
                if equilibrium is not None:
                    break
                step = 0.5 * step
            if equilibrium is None:
                steep = self._size(rate) * state.factor > LIMIT_POINT_RATE * self._size(moved)
                turned = float(screws(data, self.topology, state.x, state.R)[0][..., 3:].norm(dim=-1).max())
                path.code = 2 if why == 2 else 4 if turned > LARGE_ELEMENT_TURN else 1 if steep else 3
                break
            state, moved, largest = equilibrium, moved + increment, 2.0 * step
            path.factors.append(state.factor)
            path.places.append(state.x)
        free = self.topology.free.numpy()
        path.factor, path.x, path.R, path.K = state.factor, state.x, state.R, state.K[free][:, free]
        return path

    def _step(
        self, data: BeamData, old: _Equilibrium, step: float, rate: np.ndarray
    ) -> tuple[_Equilibrium | None, int, np.ndarray]:
        """Return the next equilibrium and code 0, or None and the code of a failure; and the increment."""
        at = 1.0 if old.factor + step > 1.0 - SMALLEST_STEP else old.factor + step
        x, R, f, K, predicted = old.x, old.R, old.f, old.K, 0.0
        B = element_tangents(data, self.topology, x, R, f)[1]
        total = np.zeros(6 * len(x))
        for k in range(ITERATIONS):
            change = (at - old.factor) * data.imposed if k == 0 else torch.zeros_like(data.imposed)
            increment = self._solve(K, change, residual(data, self.topology, x, R, at))
            length = self._size(increment)
            predicted = predicted or length
            if not np.isfinite(length) or length > 10.0 * predicted:
                break
            move, total = torch.from_numpy(increment).reshape(-1, 6), total + increment
            df = (B @ move[self.topology.elements].flatten(1)[..., None])[..., 0]
            f = screw_forces(data, self.topology, x, R, at) + df
            x, R = x + move[:, :3], exponential(move[:, 3:]) @ R
            settled = np.abs(increment / self._scale).max() <= INCREMENT_TOLERANCE
            f = screw_forces(data, self.topology, x, R, at) if settled else f
            K, B = self.stiffness(data, x, R, f, at)
            if not np.isfinite(K.data).all():
                break
            if settled:
                new = _Equilibrium(at, x, R, f, K)
                before, after = ((at - old.factor) * x for x in (rate, self._rate(data, new)))
                if not agree_with_rates(self._size, total, before, after):
                    break
                return (None, 2, total) if self._unstable(K) else (new, 0, total)
        return None, 3, total

    def _rate(self, data: BeamData, state: _Equilibrium) -> np.ndarray:
        """Increment of all degrees of freedom for an increase of the factor by 1."""
        more = [residual(data, self.topology, state.x, state.R, state.factor + step) for step in (1.0, 0.0)]
        return self._solve(state.K, data.imposed, more[0] - more[1])

    def _solve(self, K: Any, change: Tensor, missing: Tensor) -> np.ndarray:
        """Increment of all degrees of freedom that balances the forces `missing`; held ones move by `change`."""
        free = self.topology.free.numpy()
        result = change.flatten().numpy().copy()
        result[free] = 0.0
        right = missing.flatten().numpy() - K @ result
        try:
            result[free] = scipy.sparse.linalg.splu(K[free][:, free].tocsc()).solve(right[free])
        except RuntimeError:  # singular
            result[free] = np.nan
        return result

    def _size(self, increment: np.ndarray) -> float:
        return float(np.linalg.norm(increment / self._scale))

    def _unstable(self, K: Any) -> bool:
        if self.follow:
            return False
        free = self.topology.free.numpy()
        negative = negative_pivots(K[free][:, free])
        return negative > 0 if self.topology.symmetric else negative % 2 == 1


def agree_with_rates(size: Callable[[Any], float], total: Any, before: Any, after: Any) -> bool:
    """True if the increment of a step agrees with those of the rates at its ends.

    size   norm of an increment. Below INCREMENT_TOLERANCE a difference is rounding: a straight shaft that turns does not move.
    """
    largest = size(total)
    apart = size(total - before), size(total - 0.5 * (before + after))
    allowed = START_RATE_TOLERANCE * largest, MEAN_RATE_TOLERANCE * largest
    return all(x <= y + INCREMENT_TOLERANCE for x, y in zip(apart, allowed, strict=True))


def negative_pivots(K: scipy.sparse.csc_array) -> int:
    """Number of negative eigenvalues of a symmetric matrix; of any other its parity is that of the determinant's sign."""
    d = 1.0 / np.sqrt(np.maximum(np.abs(K.diagonal()), 1e-300))
    scaled = scipy.sparse.diags_array(d) @ K @ scipy.sparse.diags_array(d)
    factors = scipy.sparse.linalg.splu(
        scaled.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )
    if (factors.perm_r != factors.perm_c).any():  # a pivot was zero
        return int((np.linalg.eigvals(scaled.toarray()).real < 0.0).sum())
    return int((factors.U.diagonal() < 0.0).sum())
