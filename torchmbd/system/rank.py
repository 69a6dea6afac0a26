"""Rank of the constraint Jacobian: rows that follow from others, and how near a position is to losing rank.

    Phi_q with rows of length one = U diag(s) V'          rank: singular values above 1e-9 of the largest

A row is redundant if it depends on others: the motion does not need it, its multiplier is not determined (the one of
least norm is taken). A drive that depends on the rows without a law moves what they hold: an error.
Two rows that are dependent where a flexible body is undeformed contradict each other where it is not: an edge that twists by
u gets longer by u^2 / 2L, for elastic displacements are linear, and two hinge points on it hold its length. Such a row is
left out of the motion, its multiplier is zero.
Near a singular position the last singular value that counts goes to zero; the row combination that is lost then is its
left vector.
Checked in tests/system/test_rank.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.numerics.pair import value
from torchmbd.system import equations
from torchmbd.system.topology import Topology

RELATIVE = 1e-9  # what counts as zero
_APART = (0.1, 1e-2, 1e-4, 1e-6, RELATIVE)  # what a row adds to those that stay: rows that add most come first
_SHARE = 0.3  # of the largest entry of a left vector: rows that are named


@dataclass(frozen=True)
class Rank:
    """rank of Phi_q, and the names of the rows ("joint: row") that depend on the others.

    left_out   indices of those among them that depend on rows of flexible bodies
    """

    rank: int
    redundant: tuple[str, ...]
    left_out: tuple[int, ...] = ()


def rank_of(T: Topology, J: np.ndarray) -> Rank:
    """Rank of a Jacobian [rows, n_v]; rows without a law count first. Raises InputError for a drive that has no freedom."""
    driven = np.array([i for p, rows in T.row_slices() if p.driven for i in range(rows.start, rows.stop)], dtype=int)
    others = np.setdiff1d(np.arange(T.rows), driven)
    J = J / np.maximum(np.linalg.norm(J, axis=1, keepdims=True), np.finfo(float).tiny)
    rank, dependent = _dependent(J[others])
    total, _ = _dependent(np.concatenate([J[others], J[driven]]))
    if total < rank + len(driven):
        held = [T.row_names[i] for i in driven if _dependent(np.concatenate([J[others], J[i : i + 1]]))[0] == rank]
        which = held or [T.row_names[i] for i in driven]
        raise InputError(
            f"{', '.join(repr(name) for name in which)}: the other joints leave no freedom for this at the initial position; "
            "allowed: a drive along a motion that the joints leave free"
        )
    dependent = sorted(int(others[i]) for i in dependent)
    return Rank(total, tuple(T.row_names[i] for i in dependent), _left_out(T, J, dependent))


def _left_out(T: Topology, J: np.ndarray, dependent: list[int]) -> tuple[int, ...]:
    """Dependent rows that are combinations of rows of which any is attached to a flexible body."""
    elastic = _elastic(T)
    if not dependent or not elastic.any():
        return ()
    free = np.setdiff1d(np.arange(T.rows), dependent)
    share = np.abs(np.linalg.lstsq(J[free].T, J[dependent].T, rcond=RELATIVE)[0]) > RELATIVE
    return tuple(i for k, i in enumerate(dependent) if elastic[i] or elastic[free[share[:, k]]].any())


def _elastic(T: Topology) -> np.ndarray:
    """Which rows are attached to a flexible body [rows]."""
    found = np.zeros(T.rows, dtype=bool)
    for primitive, rows in T.row_slices():
        vectors = torch.stack(primitive.members)
        found[rows] = np.tile((vectors < T.attached_flexible).any(0).numpy(), primitive.rows)
    return found


def _dependent(J: np.ndarray) -> tuple[int, list[int]]:
    """Rank, and rows that depend on the others; rows of length one.

    Of rows that could stand for each other the first one stays, whatever the rounding: lanes and phases leave out the same.
    """
    Q, rank, rest = np.zeros_like(J), 0, list(range(len(J)))
    for least in _APART:
        for i in list(rest):
            x = J[i]
            for _ in range(2):  # twice is enough
                x = x - Q[:rank].T @ (Q[:rank] @ x)
            size = np.linalg.norm(x)
            if size > least:
                Q[rank], rank = x / size, rank + 1
                rest.remove(i)
    return rank, rest


def jacobians(dynamics: Any, q: Tensor, times: Tensor) -> Tensor:
    """Phi_q with rows of length one [n, rows, n_v] at positions q [n, n_q] and times [n] of one design."""
    T, saddle = dynamics.topology, dynamics.saddle
    data = {name: value(x).detach() for name, x in dynamics.data.items()}
    parts = []
    for given, state in zip(T.schedule(times), q, strict=True):
        at = equations.placement(T, data, state[:, None, None], given.values())
        parts.append(saddle.jacobian(data, at)[0])
    J = torch.stack(parts)
    return J / J.norm(dim=2, keepdim=True).clamp_min(torch.finfo(J.dtype).tiny)


def lost_rows(T: Topology, left: Tensor) -> tuple[str, ...]:
    """Names of the rows with a large part in a left singular vector [rows], largest first."""
    size = left.abs()
    order = torch.argsort(size, descending=True).tolist()
    return tuple(T.row_names[i] for i in order if size[i] > _SHARE * size[order[0]])
