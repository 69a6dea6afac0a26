"""Multipliers of the constraint rows that a condensation took out: from the equations of motion of their bodies.

    B lam_gone = -R        B = Phi_q' of these rows, R = M a + s - g + Phi_q' lam_left, rows of the rigid bodies

Solved in the sense of least norm, so redundant rows share what they carry. The design tangents follow from the same
matrix, with the multipliers held fixed in R.
Checked in tests/multibody/system/test_condensation.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchmbd.math.pair import Pair, cat, value, variation
from torchmbd.multibody.system import equations
from torchmbd.multibody.system.condensation import Condensation
from torchmbd.multibody.system.equations import INERTIA, Data, Placement
from torchmbd.multibody.system.times_as_lanes import as_lanes
from torchmbd.multibody.system.topology import Topology

_TOGETHER = 2048  # times x lanes in one evaluation


def multipliers(c: Condensation, data: Data, times: Tensor, q: Tensor, v: Tensor, a: Tensor, left: Tensor) -> Tensor:
    """All multipliers [times, rows, pair, lanes] of a motion.

    data            of the whole system
    times, q, v, a  its motion [times, component, pair, lanes]
    left            multipliers of the rows that were left
    """
    return in_chunks(lambda *x: _chunk(c, data, *x), times, q, v, a, left)


def in_chunks(f: Callable[..., Tensor], times: Tensor, *motion: Tensor) -> Tensor:
    """f(times, *motion) [times, ...] of many times and lanes [times, component, pair, lanes], some at once."""
    some = max(1, _TOGETHER // motion[0].shape[-1])
    parts = [slice(i, i + some) for i in range(0, len(times), some)]
    return torch.cat([f(times[s], *(x[s] for x in motion)) for s in parts])


def _chunk(c: Condensation, data: Data, times: Tensor, *motion: Tensor) -> Tensor:
    n, lanes = len(times), motion[0].shape[-1]
    q, v, a, left = (number(x) for x in motion)
    T = c.whole
    names = (*equations.ATTACHED, "gravity", *INERTIA)
    wide = {name: repeat_over_times(data[name], n, lanes) for name in names if name in data}
    given = as_lanes([T.prescribed(t, data) for t in times], lanes)
    gone = torch.tensor([i for i in range(T.rows) if i not in set(c.rows.tolist())], dtype=torch.long)
    at = equations.placement(T, wide, q, given)
    lam = _placed(left, c.rows, T.rows)
    with torch.no_grad():
        pulls = [x.detach() for x in unit_constraint_forces(T, wide, at, gone)[:2]]
        B = torch.cat([x[:, T.flexible :].flatten(0, 1) for x in pulls]).permute(2, 0, 1)
        finite = torch.where(torch.isfinite(B), B, 0.0)  # of a lane that failed: R is nan
        inverse = torch.linalg.pinv(finite, rtol=1e-9)
        found = _placed(-_times(inverse, value(_residual(T, wide, at, v, a, lam)).detach()), gone, T.rows)
    lam = lam + found
    if isinstance(q, Pair) or torch.is_grad_enabled():
        slopes = _placed(-_times(inverse, variation(_residual(T, wide, at, v, a, lam))), gone, T.rows)
        lam = lam + (Pair.of(torch.zeros_like(found), slopes) if isinstance(q, Pair) else slopes)
    full = lam.full if isinstance(lam, Pair) else lam
    return full.unflatten(2, (n, lanes)).permute(2, 0, 1, 3)


def number(x: Tensor) -> Any:
    """A motion [times, component, pair, lanes] as a number: times and lanes are one axis."""
    flat = x.permute(1, 2, 0, 3).flatten(2)
    return Pair(flat) if x.shape[2] > 1 else flat


def repeat_over_times(x: Any, times: int, lanes: int) -> Any:
    """A number of all lanes, or of one for all, at all times."""

    def wide(y: Tensor) -> Tensor:
        return y.expand(*y.shape[:-1], lanes).repeat(*([1] * (y.dim() - 1)), times)

    if isinstance(x, Pair):
        return Pair(wide(x.full))
    return x if x.shape[-1] == 1 else wide(x)


def unit_constraint_forces(T: Topology, data: Data, at: Placement, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Values of the generalized forces [component, bodies, rows, lanes] of unit multipliers."""
    lanes = value(at.g).shape[-1]
    unit = torch.eye(T.rows, dtype=torch.float64)[:, rows, None].expand(-1, -1, lanes)
    plain = at.values()
    force = equations.force_on_vectors(T, plain, unit)
    return equations.generalized_forces(T, {name: value(x) for name, x in data.items()}, plain, force)


def _residual(T: Topology, data: Data, at: Placement, v: Any, a: Any, lam: Any) -> Any:
    """Rows [6 bodies, ...] of the rigid bodies in the equations of motion."""
    f, n = T.flexible, T.bodies
    rigid = replace(T, names=T.names[f:], flexible=0, modes=0, own_modes=(), attached_flexible=0)
    own = {name: data[name].index_select(rank, torch.arange(f, n)) for name, rank in INERTIA.items()}
    own |= {"gravity": data["gravity"]} if "gravity" in data else {}
    rows = torch.tensor([k * n + b for k in range(6) for b in range(f, n)])
    there = replace(at, A=at.A[:, :, f:], w=at.w[:0])
    inertia = equations.inertia_forces(rigid, own, there, v.index_select(0, rows), a.index_select(0, rows))[:2]
    known = equations.constraint_forces(T, data, at, lam)[:2]
    return cat([(x + y[:, f:]).flatten(0, 1) for x, y in zip(inertia, known, strict=True)])


def _placed(x: Any, rows: Tensor, size: int) -> Any:
    """Rows of x [k, ...] at their places among `size`."""

    def put(y: Tensor) -> Tensor:
        return y.new_zeros(size, *y.shape[1:]).index_copy(0, rows, y)

    return Pair(put(x.full)) if isinstance(x, Pair) else put(x)


def _times(inverse: Tensor, x: Tensor) -> Tensor:
    return (inverse @ x.permute(2, 0, 1)).permute(1, 2, 0)
