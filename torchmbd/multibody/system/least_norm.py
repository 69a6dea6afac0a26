"""Multipliers of redundant constraint rows: of all that do the same to the bodies, those of least norm.

    lam = P lam'        P = J J+                                         J = Phi_q [rows, n_v], lam' any that solves
    dlam = P dlam' + (1 - P) dJ J+ lam' + J+' dJ' (1 - P) lam'           by the design, at constant rank

The equations of motion leave a part of lam' undetermined, and iterations leave there what they happen to. Of rows in [m]
the multipliers are forces [N], of rows without a unit torques [N m]: the norm takes both as numbers.
The rank is that of the start (rank.py), unless rows that depended there have come apart since: a singular position.
Source: Golub and Pereyra, SIAM J. Numer. Anal. 10 (1973) 413-432 (derivative of P).
Checked in tests/multibody/system/test_least_norm.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchmbd.math.jet import Jet
from torchmbd.math.pair import Pair, cat, value, variation
from torchmbd.multibody.system import equations
from torchmbd.multibody.system.equations import Data, Placement
from torchmbd.multibody.system.rank import Rank
from torchmbd.multibody.system.reactions import in_chunks, number, repeat_over_times, unit_constraint_forces
from torchmbd.multibody.system.times_as_lanes import as_lanes
from torchmbd.multibody.system.topology import Prescribed, Topology

_APART = 1e-4  # of the largest singular value: rows that depended at the start and do not any more


@dataclass(frozen=True, eq=False)
class LeastNorm:
    """Makes multipliers those of least norm.

    acting  rows that have multipliers at all, 1 or 0 [rows]
    rank    number of independent rows among them
    """

    T: Topology
    acting: Tensor
    rank: int

    @classmethod
    def of(cls, T: Topology, rank: Rank, rows: list[int] | None = None) -> LeastNorm | None:
        """Of a rank of the rows of T, or of some of its rows; None if the multipliers are determined."""
        own = list(range(T.rows)) if rows is None else rows
        if not rank.redundant:
            return None
        acting = torch.zeros(T.rows, dtype=torch.float64)
        acting[[row for i, row in enumerate(own) if i not in rank.left_out]] = 1.0
        return cls(T, acting, rank.rank)

    def at_times(self, data: Data, times: Tensor, q: Tensor, lam: Tensor) -> Tensor:
        """Multipliers [times, rows, pair, lanes] that act as `lam` does along the motion q [times, n_q, pair, lanes]."""
        return in_chunks(lambda *x: self._chunk(data, *x), times, q, lam)

    def _chunk(self, data: Data, times: Tensor, *motion: Tensor) -> Tensor:
        n, lanes = len(times), motion[0].shape[-1]
        wide = {name: repeat_over_times(data[name], n, lanes) for name in equations.ATTACHED if name in data}
        found = self(wide, as_lanes(self.T.schedule(times, data), lanes), *(number(x) for x in motion))
        full = found.full if isinstance(found, Pair) else found
        return full.unflatten(2, (n, lanes)).permute(2, 0, 1, 3)

    def __call__(self, data: Data, given: Prescribed, q: Any, lam: Any) -> Any:
        """Multipliers [rows, ...] that act as `lam` does at the coordinates q [n_q, ...].

        Differentiable: pairs, and plain tensors in reverse mode, by the formula above (not through an SVD).
        """
        at, acting = equations.placement(self.T, data, q, given), self.acting[:, None, None]
        with torch.no_grad():
            inverse, P = self._inverses(data, at)
            own = value(lam).detach()
            least = _times(P, own)
            mu, nu = _times(inverse, own), acting * (own - least)
        if not isinstance(lam, Pair) and not torch.is_grad_enabled():
            return least
        moved, pulls = variation(acting * _rates(self.T, data, at, mu)), variation(_forces(self.T, data, at, nu))
        slopes = _times(P, variation(lam) - moved) + moved + _times(inverse.mT, pulls)
        return Pair.of(least, slopes) if isinstance(lam, Pair) else least + slopes

    def at_own_time(self, data: Data, t: Any, q: Any, lam: Any) -> Any:
        """The same for one lane at a time t [1, 1] that may depend on the design; derivatives are total."""
        return self(data, _prescribed(self.T, data, t), q, lam)

    def _inverses(self, data: Data, at: Placement) -> tuple[Tensor, Tensor]:
        """J+ [lanes, n_v, rows] and P [lanes, rows, rows]."""
        parts = [x.detach() for x in unit_constraint_forces(self.T, data, at, torch.arange(self.T.rows))]
        J = torch.cat([x.flatten(0, 1) for x in parts]).permute(2, 1, 0) * self.acting[:, None]
        failed = ~torch.isfinite(J).all(1).all(1)[:, None, None]  # lanes: what they get is nan
        U, s, Vh = torch.linalg.svd(torch.where(failed, 0.0, J), full_matrices=False)
        kept = s > _APART * s[:, :1]
        kept[:, : self.rank] |= s[:, : self.rank] > 0.0
        U = U * kept[:, None] * self.acting[:, None]  # rounding put something into rows that do not act
        U = torch.where(failed, torch.nan, U)
        return (Vh.mT * torch.where(kept, 1.0 / s, 0.0)[:, None]) @ U.mT, U @ U.mT


def _prescribed(T: Topology, data: Data, t: Any) -> Prescribed:
    """What is known at the time t, whose derivatives by the design move what the laws prescribe."""
    now = value(t)[0, 0]
    given = T.prescribed(now, data)
    if not isinstance(t, Pair):
        return given
    plain = {name: value(x) for name, x in data.items()}

    def laws(s: Tensor) -> list[tuple]:
        return [law or () for law in T.prescribed(s, plain).laws]

    _, rates = torch.func.jvp(laws, (now,), (torch.ones_like(now),))[:2]

    def moved(x: Any, rate: Tensor) -> Pair:
        return Pair.of(value(x), rate * t.tangent + (x.tangent if isinstance(x, Pair) else 0.0))

    moving = [law and tuple(map(moved, law, rate)) for law, rate in zip(given.laws, rates, strict=True)]
    return given._replace(laws=moving)


def _rates(T: Topology, data: Data, at: Placement, mu: Tensor) -> Tensor:
    """Phi_q mu [rows, ...], mu [n_v, 1, lanes] held fixed."""
    drives: list[tuple | None] = [drive and tuple(Jet(x, 0.0 * x, 0.0 * x) for x in drive) for drive in at.drives]
    return equations.driven_jets(T, at, data, mu, torch.zeros_like(mu), drives).velocity


def _forces(T: Topology, data: Data, at: Placement, nu: Tensor) -> Tensor:
    """Phi_q' nu [n_v, ...], nu [rows, 1, lanes] held fixed."""
    return cat([x.flatten(0, 1) for x in equations.constraint_forces(T, data, at, nu)])


def _times(matrices: Tensor, x: Tensor) -> Tensor:
    """Matrices [lanes, n, m] times numbers [m, pair, lanes]."""
    return (matrices @ x.permute(2, 0, 1)).permute(1, 2, 0)
