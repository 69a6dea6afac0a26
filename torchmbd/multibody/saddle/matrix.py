"""The saddle-point matrix of the equations of motion, and constraint Jacobians.

    [ M   Phi_q' ] [ a   ]   [ forces ]
    [ Phi_q   0  ] [ lam ] = [ gamma  ]          eqs. (7), (9)

Values only: sensitivities use the same matrix with the right-hand sides of eqs. (31)-(33), which come from pairs.
Blocks (blocks.py) are gathered into a dense matrix by one index, so the number of operators does not grow with the
number of bodies or joints. Matrices are returned lanes first, ready for LAPACK.

Checked in tests/multibody/equations/test_equations.py: every column is the difference of the residual that it stands for.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from torchmbd.math.pair import value
from torchmbd.multibody.equations import beams
from torchmbd.multibody.equations.data import Data
from torchmbd.multibody.equations.equations import Placement, action_states
from torchmbd.multibody.equations.topology import Topology
from torchmbd.multibody.equations.unit_forces import Block, unit_multipliers, unit_strengths
from torchmbd.multibody.saddle.blocks import MASSES, SaddleBlocks, Slopes
from torchmbd.multibody.saddle.factors import LARGE, ColumnPattern, Diagonal, Factors


class Saddle:
    """Assembles the saddle-point matrices of one topology; index tensors are made once."""

    def __init__(self, T: Topology):
        self.blocks = SaddleBlocks(T, unit_multipliers(T), unit_strengths(T))
        self.T = T
        shapes = self.blocks.shapes()
        self.names = [name for name, _ in shapes]
        row, column, entry = saddle_entries(T, self.blocks)
        zero = entry_count(shapes)
        # With independent rates the matrix is P' K P: each of its entries is a sum over few entries of K.
        index = np.full((T.n_rates + T.rows,) * 2, zero)
        index[row, column] = entry
        self._project = None if T.rates is None else Projection(index, zero, T.rates)
        self._index = torch.from_numpy(index.reshape(-1))
        sparse = T.rates is None and len(index) >= LARGE
        self.columns = ColumnPattern.of(row, column, entry, len(index), zero) if sparse else None
        self._beams = None if T.beams is None else _BeamEntries(T, self.blocks)
        action_shapes = self.blocks.action_shapes()
        self.action_names = [name for name, _ in action_shapes]
        rate, action, entry = self.blocks.actions.matrix_entries(T, entry_numbers(action_shapes), "action")
        direction = np.full((T.n_rates, sum(len(a.laws) for a in T.actions)), entry_count(action_shapes))
        direction[rate, action] = entry
        self._directions, self._direction = torch.from_numpy(direction.reshape(-1)), direction.shape

    def matrix(self, data: Data, at: Placement, slopes: Slopes = MASSES) -> Tensor:
        """Dense saddle-point matrix [lanes, n_v + rows, n_v + rows]."""
        flat = self._entries(data, at, slopes)
        size = self.T.n_v + self.T.rows
        entries = flat.index_select(0, self._index) if self._project is None else self._project(flat)
        K = entries.reshape(size, size, -1).permute(2, 0, 1)
        if slopes.v is not None and self._beams is not None:
            K = K + pad(self._beams(flat), (0, self.T.rows, 0, self.T.rows))
        if slopes.v is not None and self.T.actions:
            K = K + pad(self._action_slopes(data, at, slopes), (0, self.T.rows, 0, self.T.rows))
        return K

    def _entries(self, data: Data, at: Placement, slopes: Slopes = MASSES) -> Tensor:
        """Entries of all blocks [n + 1, lanes]; the last one is zero."""
        lanes = at.g.shape[-1] if at.g.numel() else at.A.shape[-1]
        return _flat(self.blocks(data, at, slopes), self.names, lanes)

    def factors(self, data: Data, at: Placement, diagonal: Diagonal | None) -> Factors:
        """Factors of the matrix of the accelerations; diagonal as in `Dynamics.diagonal`."""
        if self.columns is None:
            return Factors(self.matrix(data, at), diagonal, None)
        return Factors(self._entries(data, at)[self.columns.entry].T, diagonal, self.columns)

    def _action_slopes(self, data: Data, at: Placement, slopes: Slopes) -> Tensor:
        """Derivatives of the applied forces through their laws [lanes, n_v, n_v]."""
        T = self.T
        states = action_states(T, data, at, slopes.v)
        blocks, weights = self.blocks.action_slopes(data, at, states, slopes)
        flat = _flat(blocks, self.action_names, weights.shape[-1]).index_select(0, self._directions)
        D = flat.reshape(*self._direction, -1)
        D = (D if T.gather is None else T.gather(D)).permute(2, 0, 1)
        K = (D * weights[:, 0].T[:, None]) @ D.transpose(1, 2)
        coupled = T.links.slopes(states, at.t, data, slopes.stiffness, slopes.damping)
        return K if coupled is None else K - D @ coupled @ D.transpose(1, 2)

    def jacobian(self, data: Data, at: Placement) -> Tensor:
        """Phi_q [lanes, rows, n_v]."""
        return self.matrix(data, at)[:, self.T.n_v :, : self.T.n_v]

    def values_of_jacobian(self, data: Data, at: Placement) -> Tensor:
        """The same without a graph of torch, of all lanes of a placement."""
        data = {name: value(x).detach() for name, x in data.items()}
        J = self.jacobian(data, at.map(lambda y: value(y).detach()))
        return J.expand(value(at.g).shape[-1], -1, -1)


class _BeamEntries:
    """The part of beam elements in the matrix of the rates [lanes, n_v, n_v], from the entries of all blocks [n, lanes]."""

    def __init__(self, T: Topology, blocks: SaddleBlocks):
        row, column, entry = beams.matrix_entries(T, entry_numbers(blocks.shapes())["beam"])
        self.size, self.rates = T.n_rates, T.rates
        self.position, self.entry = torch.from_numpy(row * T.n_rates + column), torch.from_numpy(entry)

    def __call__(self, flat: Tensor) -> Tensor:
        K = flat.new_zeros(self.size**2, flat.shape[-1]).index_add(0, self.position, flat[self.entry])
        K = K.reshape(self.size, self.size, -1).permute(2, 0, 1)
        return K if self.rates is None else self.rates.T @ K @ self.rates


def _flat(blocks: dict[str, Tensor], names: list[str], lanes: int) -> Tensor:
    """Entries of blocks one after another [n + 1, lanes]; the last one is zero."""
    parts = [blocks[name].expand(*blocks[name].shape[:-2], 1, lanes).reshape(-1, lanes) for name in names]
    return torch.cat([*parts, torch.zeros(1, lanes, dtype=torch.float64, device=parts[0].device)])


def entry_count(shapes: list[Block]) -> int:
    """Number of entries of all blocks."""
    return sum(int(np.prod(shape)) for _, shape in shapes)


def entry_numbers(shapes: list[Block]) -> dict[str, np.ndarray]:
    """For each block an array of its shape: the numbers of its entries among the entries of all blocks."""
    numbers, start = {}, 0
    for name, shape in shapes:
        size = int(np.prod(shape))
        numbers[name] = np.arange(start, start + size).reshape(shape)
        start += size
    return numbers


def saddle_entries(T: Topology, blocks: SaddleBlocks) -> np.ndarray:
    """Row, column (rates of all bodies, then constraint rows) and entry number of each nonzero of the matrix [3, n]."""
    n, f, m, nv = T.bodies, T.flexible, T.modes, T.n_rates
    at = entry_numbers(blocks.shapes())
    r = np.arange(3 * n).reshape(3, n)
    om = r + 3 * n
    w = 6 * n + np.arange(m * f).reshape(m, f)
    entries: list[tuple] = [(r[i], r[i], at["mass"]) for i in range(3)]
    for i in range(3):
        for j in range(3):
            entries.append((r[i], om[j], at["r_om"][i, j]))
            entries.append((om[j], r[i], at["om_r"][i, j]))
            entries.append((om[i], om[j], at["inertia"][i, j]))
        for a in range(m):
            entries.append((r[i, :f], w[a], at["r_w"][i, a]))
            entries.append((w[a], r[i, :f], at["w_r"][i, a]))
            entries.append((om[i, :f], w[a], at["om_w"][i, a]))
            entries.append((w[a], om[i, :f], at["w_om"][i, a]))
    for a in range(m):
        for b in range(m):
            entries.append((w[a], w[b], at["modal"][a, b]))
    if T.rows:
        rate, row, entry = blocks.rows.matrix_entries(T, at, "row")
        entries.append((rate, nv + row, entry))
        rate, row, entry = blocks.rows.matrix_entries(T, at | {"row_torque": at["row_turn"]}, "row")
        entries.append((nv + row, rate, entry))
    return np.concatenate([np.array(x, dtype=int).reshape(3, -1) for x in entries], 1)


class Projection:
    """P' K P with P = diag(rates, 1), from the entries of the blocks of K [n + 1, lanes]."""

    def __init__(self, index: np.ndarray, zero: int, rates: Tensor):
        N = rates.numpy()
        rows = len(index) - len(N)
        P = np.block([[N, np.zeros((len(N), rows))], [np.zeros((rows, N.shape[1])), np.eye(rows)]])
        i, a = np.nonzero(P)
        factor = P[i, a]
        I, J = (x.ravel() for x in np.meshgrid(np.arange(len(i)), np.arange(len(i)), indexing="ij"))
        used = index[i[I], i[J]] < zero  # zero is the number of an entry that is always zero
        I, J = I[used], J[used]
        target = a[I] * P.shape[1] + a[J]
        order = np.argsort(target, kind="stable")
        I, J, target = I[order], J[order], target[order]
        first = np.searchsorted(target, target)
        depth = np.arange(len(target)) - first  # number of earlier terms of the same sum
        self.width, size = int(depth.max()) + 1, P.shape[1] ** 2
        table, weights = np.full((self.width, size), zero), np.zeros((self.width, size))
        table[depth, target], weights[depth, target] = index[i[I], i[J]], factor[I] * factor[J]
        self.table, self.weights = torch.from_numpy(table.ravel()), torch.from_numpy(weights)[..., None]
        self.plain = self.width == 1 and bool((weights[0][table[0] < zero] == 1.0).all())

    def __call__(self, flat: Tensor) -> Tensor:
        entries = flat.index_select(0, self.table)
        return entries if self.plain else (entries.unflatten(0, self.weights.shape[:2]) * self.weights).sum(0)
