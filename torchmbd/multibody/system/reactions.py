"""Multipliers of the constraint rows that a condensation removed, from the equations of motion of their bodies.

    B lam_removed = -R        B = Phi_q' of these rows, R = M a + s - g + Phi_q' lam_retained, rows of the rigid bodies

Solutions of least norm, so redundant rows share their loads. The design tangents follow from the same matrix, with fixed
multipliers in R.
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
from torchmbd.multibody.system.saddle import Saddle
from torchmbd.multibody.system.times_as_lanes import as_lanes, at_own_times
from torchmbd.multibody.system.topology import Prescribed, Topology

_CHUNK = 2048  # times x lanes in one evaluation


def multipliers(
    c: Condensation, data: Data, times: Tensor, q: Tensor, v: Tensor, a: Tensor, retained: Tensor
) -> Tensor:
    """All multipliers [times, rows, pair, lanes] of a motion.

    data            of the whole system
    times, q, v, a  its motion [times, component, pair, lanes]
    retained        multipliers of the rows of the condensed system
    """
    return in_chunks(lambda *x: _chunk(c, data, *x), times, q, v, a, retained)


def multipliers_at(c: Condensation | None, data: Data, t: Any, q: Any, v: Any, a: Any, retained: Any) -> Any:
    """All multipliers [rows, ...] of lanes at times t [1 + n, lanes] of their own, out of numbers [k, 1 + n, lanes].

    retained   multipliers of the retained rows; those of all rows stay as they are
    """
    if c is None or len(value(retained)) == c.whole.rows:
        return retained
    return _all_rows(c, data, at_own_times(c.whole, t, data), q, v, a, retained)


def in_chunks(f: Callable[..., Tensor], times: Tensor, *motion: Tensor) -> Tensor:
    """f(times, *motion) [times, ...], evaluated for some of the times at once; motion [times, component, pair, lanes]."""
    count = max(1, _CHUNK // motion[0].shape[-1])
    parts = [slice(i, i + count) for i in range(0, len(times), count)]
    return torch.cat([f(times[s], *(x[s] for x in motion)) for s in parts])


def _chunk(c: Condensation, data: Data, times: Tensor, *motion: Tensor) -> Tensor:
    n, lanes = len(times), motion[0].shape[-1]
    wide = {name: repeat_over_times(x, n, lanes) for name, x in data.items()}
    excitation = as_lanes(c.whole.schedule(times, data), lanes)
    lam = _all_rows(c, wide, excitation, *(flatten_times(x) for x in motion))
    full = lam.full if isinstance(lam, Pair) else lam
    return full.unflatten(2, (n, lanes)).permute(2, 0, 1, 3)


def _all_rows(c: Condensation, data: Data, excitation: Prescribed, q: Any, v: Any, a: Any, retained: Any) -> Any:
    """All multipliers [rows, ...] of numbers [k, ...] with what is prescribed."""
    T = c.whole
    removed = torch.tensor([i for i in range(T.rows) if i not in set(c.rows.tolist())], dtype=torch.long)
    at = equations.placement(T, data, q, excitation)
    lam = _scatter_rows(retained, c.rows, T.rows)
    with torch.no_grad():
        rigid = torch.tensor([k * T.bodies + b for k in range(6) for b in range(T.flexible, T.bodies)])
        B = values_of_jacobian(c.whole_saddle, data, at)[:, removed][:, :, rigid].mT
        finite = torch.where(torch.isfinite(B), B, 0.0)  # in a lane that failed R is nan, and so the multipliers
        inverse = torch.linalg.pinv(finite, rtol=1e-9)
        lam_removed = -_times(inverse, value(_residual(T, data, at, v, a, lam)).detach())
    lam = lam + _scatter_rows(lam_removed, removed, T.rows)
    if isinstance(q, Pair) or torch.is_grad_enabled():
        slopes = _scatter_rows(-_times(inverse, variation(_residual(T, data, at, v, a, lam))), removed, T.rows)
        lam = lam + (Pair.of(torch.zeros_like(value(lam)), slopes) if isinstance(q, Pair) else slopes)
    return lam


def flatten_times(x: Tensor) -> Any:
    """A motion [times, component, pair, lanes] as a tensor or pair [component, pair, times x lanes]."""
    flat = x.permute(1, 2, 0, 3).flatten(2)
    return Pair(flat) if x.shape[2] > 1 else flat


def repeat_over_times(x: Any, times: int, lanes: int) -> Any:
    """Data x [component..., pair, lanes or 1], repeated for all times: [component..., pair, times x lanes], or x itself."""

    def wide(y: Tensor) -> Tensor:
        return y.expand(*y.shape[:-1], lanes).repeat(*([1] * (y.dim() - 1)), times)

    if isinstance(x, Pair):
        return Pair(wide(x.full))
    return x if x.shape[-1] == 1 else wide(x)


def values_of_jacobian(saddle: Saddle, data: Data, at: Placement) -> Tensor:
    """Phi_q [lanes, rows, n_v] without a graph of torch."""
    data = {name: value(x).detach() for name, x in data.items()}
    J = saddle.jacobian(data, at.map(lambda y: value(y).detach()))
    return J.expand(value(at.g).shape[-1], -1, -1)


def _residual(T: Topology, data: Data, at: Placement, v: Any, a: Any, lam: Any) -> Any:
    """Rows [6 bodies, ...] of the rigid bodies in the equations of motion."""
    f, n = T.flexible, T.bodies
    rigid = replace(T, names=T.names[f:], flexible=0, modes=0, own_modes=(), attached_flexible=0)
    inertia = {name: data[name].index_select(rank, torch.arange(f, n)) for name, rank in INERTIA.items()}
    inertia |= {"gravity": data["gravity"]} if "gravity" in data else {}
    rows = torch.tensor([k * n + b for k in range(6) for b in range(f, n)])
    rigid_at = replace(at, A=at.A[:, :, f:], w=at.w[:0])
    v, a = v.index_select(0, rows), a.index_select(0, rows)
    inertia_forces = equations.inertia_forces(rigid, inertia, rigid_at, v, a)[:2]
    joint_forces = equations.constraint_forces(T, data, at, lam)[:2]
    return cat([(x + y[:, f:]).flatten(0, 1) for x, y in zip(inertia_forces, joint_forces, strict=True)])


def _scatter_rows(x: Any, rows: Tensor, size: int) -> Any:
    """A tensor or pair of `size` rows with x [k, ...] in the k `rows`, else zero."""

    def scatter(y: Tensor) -> Tensor:
        return y.new_zeros(size, *y.shape[1:]).index_copy(0, rows, y)

    return Pair(scatter(x.full)) if isinstance(x, Pair) else scatter(x)


def _times(inverse: Tensor, x: Tensor) -> Tensor:
    return (inverse @ x.permute(2, 0, 1)).permute(1, 2, 0)
