"""Multipliers of the constraint rows that a condensation removed, from the equations of motion of their bodies.

    B lam_removed = -R        B = Phi_q' of these rows, R = M a + s - g + Phi_q' lam_retained, rows of the rigid bodies

Solutions of least norm, so redundant rows share their loads. The design tangents follow from the same matrix, with fixed
multipliers in R.
Checked in tests/multibody/saddle/test_condensation.py.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchmbd.math.pair import Pair, apply, cat, value, variation
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equations.data import INERTIA, Data
from torchmbd.multibody.equations.equations import Placement
from torchmbd.multibody.equations.times_as_lanes import at_own_times, over_times
from torchmbd.multibody.equations.topology import Prescribed, Topology
from torchmbd.multibody.saddle.condensation import Condensation


def multipliers(
    c: Condensation, data: Data, times: Tensor, q: Tensor, v: Tensor, a: Tensor, retained: Tensor
) -> Tensor:
    """All multipliers [times, rows, pair, lanes] of a motion.

    data            of the whole system
    times, q, v, a  its motion [times, component, pair, lanes]
    retained        multipliers of the rows of the condensed system
    """
    return over_times(lambda *x: _all_rows(c, *x), c.whole, data, times, q, v, a, retained)


def multipliers_at(c: Condensation | None, data: Data, t: Any, q: Any, v: Any, a: Any, retained: Any) -> Any:
    """All multipliers [rows, ...] of lanes at times t [1 + n, lanes] of their own, out of numbers [k, 1 + n, lanes].

    retained   multipliers of the retained rows; those of all rows stay as they are
    """
    if c is None or len(value(retained)) == c.whole.rows:
        return retained
    return _all_rows(c, data, at_own_times(c.whole, t, data), q, v, a, retained)


def _all_rows(c: Condensation, data: Data, excitation: Prescribed, q: Any, v: Any, a: Any, retained: Any) -> Any:
    """All multipliers [rows, ...] of numbers [k, ...] with what is prescribed."""
    T = c.whole
    removed = torch.tensor([i for i in range(T.rows) if i not in set(c.rows.tolist())], dtype=torch.long)
    at = equations.placement(T, data, q, excitation)
    lam = _scatter_rows(retained, c.rows, T.rows)
    with torch.no_grad():
        rigid = torch.tensor([k * T.bodies + b for k in range(6) for b in range(T.flexible, T.bodies)])
        B = c.whole_saddle.values_of_jacobian(data, at)[:, removed][:, :, rigid].mT
        finite = torch.where(torch.isfinite(B), B, 0.0)  # in a lane that failed R is nan, and so the multipliers
        inverse = torch.linalg.pinv(finite, rtol=1e-9)
        lam_removed = -apply(inverse, value(_residual(T, data, at, v, a, lam)).detach())
    lam = lam + _scatter_rows(lam_removed, removed, T.rows)
    if isinstance(q, Pair) or torch.is_grad_enabled():
        slopes = _scatter_rows(-apply(inverse, variation(_residual(T, data, at, v, a, lam))), removed, T.rows)
        lam = lam + (Pair.of(torch.zeros_like(value(lam)), slopes) if isinstance(q, Pair) else slopes)
    return lam


def _residual(T: Topology, data: Data, at: Placement, v: Any, a: Any, lam: Any) -> Any:
    """Rows [6 bodies, ...] of the rigid bodies in the equations of motion."""
    f, n = T.flexible, T.bodies
    rigid = replace(T, names=T.names[f:], flexible=0, modes=0, mode_counts=(), attached_flexible=0)
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
