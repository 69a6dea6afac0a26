"""Rank of the constraint Jacobian: rows that follow from others, and how near a position is to losing rank.

    Phi_q with rows of length one = U diag(s) V'          rank: singular values above 1e-9 of the largest

Columns are those of rates that are divided by their sizes (equations/sizes.py), so that rows do not depend on units.
A row is redundant if it depends on others: the motion does not need it, and its multiplier is not determined (the one of
least norm is taken). A drive that depends on the rows without a law would move bodies that these hold: an error.
Rows that are dependent where a flexible body is undeformed may contradict each other where it is deformed: an edge that twists
by u gets longer by u^2 / 2L, as elastic displacements are linear, but two hinge points on it fix its length. Such a row is left
out of the motion, and its multiplier is zero. An exception are rows that are independent at a position displaced along a
degree of freedom of the undeformed mechanism: the start is then a singular position, and the row is regularized as for rigid
bodies. Dependent rows may also differ by a small elastic displacement, as bending of an unsymmetric laminate stretches it a
little. They are a *weak* constraint: the stretching that they allow is not among the modes of vibration, so that it takes far
too much bending. A warning names the rows; with reduction="craig-bampton" the joints' nodes have modes that stretch.
Near a singular position the last nonzero singular value goes to zero; its left vector is the combination of rows that becomes
dependent.
Checked in tests/multibody/saddle/test_rank.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.linalg
import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.math.pair import value
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equations.data import Data
from torchmbd.multibody.equations.sizes import closed_rows, rate_sizes, row_sizes
from torchmbd.multibody.equations.times_as_lanes import as_lanes
from torchmbd.multibody.equations.topology import Topology

RELATIVE = 1e-9  # share of the largest singular value, or of the length of a row, that counts as zero
_PARTS = (0.1, 1e-2, 1e-4, 1e-6, RELATIVE)  # least independent parts of rows in the passes of the elimination
_WEAK = 0.01  # share of the largest elastic part of a row of the same body
_INVOLVED = 1e-6  # share of a row in a dependent one below which its multiplier is determined
_SHARE = 0.3  # share of the largest entry of a left vector above which messages name a row
_TURN = 0.2  # [rad] largest rotation to a displaced position
_STEPS = 30  # of Newton's method to it
_ENTRIES = 2**20  # entries of Jacobians in one evaluation


@dataclass(frozen=True)
class Rank:
    """rank of Phi_q, and the names of the rows ("joint: row") that depend on the others.

    left_out   indices of those of them that depend on rows of flexible bodies, and are left out of the motion
    weak       names of rows that differ from others by a small elastic displacement only
    share      the largest such displacement, as a share of the largest elastic part of a row of the same body
    undetermined   joints with rows whose multipliers equilibrium does not determine
    """

    rank: int
    redundant: tuple[str, ...]
    left_out: tuple[int, ...] = ()
    weak: tuple[str, ...] = ()
    share: float = 1.0
    undetermined: tuple[str, ...] = ()


def rank_of(T: Topology, J: np.ndarray) -> Rank:
    """Rank of a Jacobian [rows, n_v]; rows without a law count first. Raises InputError for a drive that cannot move."""
    driven = _driven(T)
    others = np.setdiff1d(np.arange(T.rows), driven)
    J = _unit(J)
    rank, dependent = _dependent(J[others])
    total, _ = _dependent(np.concatenate([J[others], J[driven]]))
    if total < rank + len(driven):
        alone = [T.row_names[i] for i in driven if _dependent(np.concatenate([J[others], J[i : i + 1]]))[0] == rank]
        which = alone or [T.row_names[i] for i in driven]
        raise InputError(
            which[0],
            allowed="a drive along a motion that the joints leave free" if alone else "one drive for each free motion",
            noun=", ".join(map(repr, which)),
            state="cannot move, because the other joints hold this motion at the initial position"
            if alone
            else "prescribe motions that depend on each other at the initial position",
        )
    dependent = sorted(int(others[i]) for i in dependent)
    if not dependent:
        return Rank(total, (), (), *_weak(T, J, ()))
    independent = np.setdiff1d(np.arange(T.rows), dependent)
    shares = np.abs(np.linalg.lstsq(J[independent].T, J[dependent].T, rcond=RELATIVE)[0])
    elastic = _elastic(T)  # rows that are so, or depend on a row that is, are left out
    of_elastic = [
        elastic[i] or elastic[independent[x > RELATIVE]].any() for i, x in zip(dependent, shares.T, strict=True)
    ]
    left_out = tuple(i for i, is_elastic in zip(dependent, of_elastic, strict=True) if is_elastic)
    involved = sorted([*dependent, *independent[shares.max(1) > _INVOLVED].tolist()])
    joints = tuple(dict.fromkeys(T.row_joints[i] for i in involved))
    return Rank(total, tuple(T.row_names[i] for i in dependent), left_out, *_weak(T, J, left_out), joints)


def _weak(T: Topology, J: np.ndarray, left_out: Sequence[int]) -> tuple[tuple[str, ...], float]:
    """`Rank.weak` and `Rank.share`."""
    n, f = 6 * T.bodies, T.flexible
    if J.shape[1] != T.n_v or T.rates is not None or not f:
        return (), 1.0  # unknown from rigid columns alone, and from condensed rates
    acting = np.setdiff1d(np.arange(len(J)), left_out)
    rigid, elastic = J[acting, :n], J[acting, n:].reshape(len(acting), T.modes, f)
    size = np.linalg.norm(elastic, axis=1).max(0, initial=0.0)
    elastic = (elastic / np.where(size > 0.0, size, 1.0)).reshape(len(acting), -1)
    U, s, _ = np.linalg.svd(rigid)
    alike = U[:, int((s > RELATIVE * s.max(initial=0.0)).sum()) :]  # combinations without a rigid part
    W, share, _ = np.linalg.svd(alike.T @ elastic, full_matrices=False)
    weak = (share > RELATIVE) & (share < _WEAK)
    if not weak.any():
        return (), 1.0
    involved = np.abs(alike @ W[:, weak]).max(1)
    rows = acting[np.argsort(-involved, kind="stable")][: int((involved > _SHARE * involved.max()).sum())]
    return tuple(T.row_names[i] for i in rows), float(share[weak].max())


def _driven(T: Topology) -> np.ndarray:
    """Indices of the rows with a law."""
    return np.array([i for p, rows in T.row_slices() if p.prescribes for i in range(rows.start, rows.stop)], dtype=int)


def confirm_left_out(dynamics: Any, q: Tensor, rank: Rank) -> Rank:
    """The rank at the start q [n_q], where `left_out` keeps those rows only that are dependent at a displaced position too."""
    displaced = displaced_position(dynamics, q) if rank.left_out else None
    if displaced is None:
        return rank
    T = dynamics.topology
    J = jacobians(dynamics, displaced[None], displaced.new_zeros(1))[0].cpu().numpy()
    others = [i for i in range(T.rows) if i not in rank.left_out]
    Q: Any = scipy.linalg.orth(J[others].T, rcond=RELATIVE)
    parts = [np.linalg.norm(J[i] - Q @ (Q.T @ J[i])) for i in rank.left_out]
    return replace(rank, left_out=tuple(i for i, x in zip(rank.left_out, parts, strict=True) if x < RELATIVE))


def displaced_position(dynamics: Any, q: Tensor) -> Tensor | None:
    """An assembled position [n_q], displaced from q by a motion that the rows without a law leave undeformed bodies.

    None if there is no such degree of freedom, or Newton's method does not close the joints.
    """
    T, zero = dynamics.topology, q.new_zeros(1)
    rows = np.setdiff1d(np.arange(T.rows), _driven(T))
    values = {name: value(x).detach()[..., :1] for name, x in dynamics.data.items()}
    excitation = T.schedule(zero, values)[0]
    J = jacobians(dynamics, q[None], zero)[0][rows].cpu().numpy()[:, _rigid(T)]
    N = scipy.linalg.null_space(J, rcond=RELATIVE)
    step = q.new_zeros(T.n_v)
    step[_rigid(T)] = torch.from_numpy(N @ (N.T @ np.random.default_rng(0).standard_normal(len(N)))).to(q.device)
    size, mass = dynamics.initial.size, values["mass"][: T.bodies, 0, 0]
    sizes, rho = rate_sizes(T, size, mass), row_sizes(T, size)[rows, 0, 0]
    step *= sizes
    turn = equations.split_v(T, step[:, None, None])[1].abs().max()
    if not float(turn) > RELATIVE:
        return None
    displaced = equations.advance(T, q[:, None, None], (_TURN / turn) * step[:, None, None])
    for _ in range(_STEPS):
        at = equations.placement(T, values, displaced, excitation)
        phi = equations.constraints(T, at)[rows, 0, 0]
        if bool((phi.abs() <= closed_rows(T, size, displaced)[rows, 0, 0]).all()):
            return displaced[:, 0, 0]
        J = dynamics.saddle.jacobian(values, at)[0][rows][:, _rigid(T)] * sizes[_rigid(T)] / rho[:, None]
        move = sizes[_rigid(T)] * (torch.linalg.pinv(J, rtol=1e-6) @ (phi / rho))
        step = torch.zeros_like(step).index_put((torch.tensor(_rigid(T)),), -move)
        displaced = equations.advance(T, displaced, step[:, None, None])
    return None


def full_rank_undeformed(T: Topology, J: np.ndarray) -> bool:
    """True if all rows of a Jacobian [rows, n_v] are independent even for undeformed bodies, and so for all designs."""
    return rank_of_columns(J[:, _rigid(T)]) == T.rows


def rank_of_columns(J: np.ndarray) -> int:
    """Rank of some columns of a Jacobian [rows, n]: a drive may need the degrees of freedom of the other columns."""
    return _dependent(_unit(J))[0]


def _unit(J: np.ndarray) -> np.ndarray:
    """J with rows scaled to length one."""
    return J / np.maximum(np.linalg.norm(J, axis=1, keepdims=True), np.finfo(float).tiny)


def _rigid(T: Topology) -> list[int]:
    """Indices of the rates that deform no body."""
    modal = 6 * T.bodies
    return list(range(modal)) if T.rates is None else torch.nonzero((T.rates[modal:] == 0).all(0))[:, 0].tolist()


def _elastic(T: Topology) -> np.ndarray:
    """Which rows are attached to a flexible body [rows]."""
    elastic = np.zeros(T.rows, dtype=bool)
    for primitive, rows in T.row_slices():
        vectors = torch.stack(primitive.members)
        elastic[rows] = np.tile((vectors < T.attached_flexible).any(0).numpy(), primitive.rows)
    return elastic


def _dependent(J: np.ndarray) -> tuple[int, list[int]]:
    """Rank of J with rows of length one, and the rows that depend on the others.

    Rows with large independent parts come first, so that of equivalent rows the first one is independent whatever the
    rounding: lanes and phases leave out the same rows.
    """
    Q, rank, rest = np.zeros_like(J), 0, list(range(len(J)))
    for least in _PARTS:
        for i in list(rest):
            x = J[i]
            for _ in range(2):  # a second projection removes the rounding of the first
                x = x - Q[:rank].T @ (Q[:rank] @ x)
            size = np.linalg.norm(x)
            if size > least:
                Q[rank], rank = x / size, rank + 1
                rest.remove(i)
    return rank, rest


def jacobians(dynamics: Any, q: Tensor, times: Tensor) -> Tensor:
    """Phi_q with rows of length one [n, rows, n_v], by rates that are divided by their sizes, of the first design at positions
    q [n, n_q] and times [n]."""
    T, saddle = dynamics.topology, dynamics.saddle
    data = {name: value(x).detach()[..., :1] for name, x in dynamics.data.items()}
    schedule, parts = T.schedule(times, data), []
    count = max(1, _ENTRIES // max(1, T.rows * T.n_v))
    for start in range(0, len(q), count):
        chunk = slice(start, start + count)
        at = equations.placement(T, data, q[chunk].T[:, None], as_lanes(schedule[chunk]).values())
        parts.append(saddle.jacobian(data, at))
    J = torch.cat(parts) * rate_sizes(T, dynamics.initial.size, data["mass"][: T.bodies, 0, 0])
    return J / J.norm(dim=2, keepdim=True).clamp_min(torch.finfo(J.dtype).tiny)


def first_finite_lane(data: Data) -> int | None:
    """The first lane whose data are finite (those of a lock are nan in lanes that do not reach its phase); None: no lane."""
    finite = torch.ones(max(value(x).shape[-1] for x in data.values()), dtype=torch.bool)
    for x in data.values():
        finite = finite & torch.isfinite(value(x)).flatten(0, -2).all(0).cpu()
    lanes = torch.nonzero(finite)
    return int(lanes[0, 0]) if len(lanes) else None


def dominant_rows(T: Topology, singular_vector: Tensor) -> tuple[str, ...]:
    """Names of the rows with the largest entries in a left singular vector [rows], largest first."""
    size = singular_vector.abs()
    order = torch.argsort(size, descending=True).tolist()
    return tuple(T.row_names[i] for i in order if size[i] > _SHARE * size[order[0]])
