"""Multipliers of redundant constraint rows: of all with the same forces on the bodies, those of least norm.

    lam = P lam'        P = J J+                                         J = Phi_q [rows, n_v], lam' any solution
    dlam = P dlam' + (1 - P) dJ J+ lam' + J+' dJ' (1 - P) lam'           by the design, at constant rank

The equations of motion leave a part of lam' undetermined, so its value depends on the iterations. Multipliers of rows in [m]
are forces [N], of rows without a unit torques [N m]: the norm is that of rho lam, forces times the size of the mechanism
(equations/sizes.py). So J and lam are here J s / rho and rho lam, by sizes s of rates at each position.
The rank is that of the start (rank.py), or larger where the start is a singular position and dependent rows have become
independent since.
Source: Golub and Pereyra, SIAM J. Numer. Anal. 10 (1973) 413-432 (derivative of P).
Checked in tests/multibody/saddle/test_least_norm.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchmbd.math.elementwise import reciprocal
from torchmbd.math.pair import Pair, apply, cat, value, variation
from torchmbd.multibody.equations import equations
from torchmbd.multibody.equations.data import Data
from torchmbd.multibody.equations.equations import Placement
from torchmbd.multibody.equations.sizes import rate_sizes_at, row_sizes, size_at
from torchmbd.multibody.equations.times_as_lanes import at_own_times, over_times
from torchmbd.multibody.equations.topology import Prescribed, Topology
from torchmbd.multibody.saddle.matrix import Saddle
from torchmbd.multibody.saddle.rank import Rank

_APART = 1e-4  # share of the largest singular value above which rows that depended at the start are independent


@dataclass(frozen=True, eq=False)
class LeastNorm:
    """Projection of multipliers to those of least norm.

    acting  1 for rows with a multiplier, 0 for those that are left out of the motion [rows]
    rank    number of independent rows among the acting ones
    """

    saddle: Saddle
    acting: Tensor
    rank: int

    @property
    def T(self) -> Topology:
        """Of the constraints."""
        return self.saddle.T

    @classmethod
    def of(cls, saddle: Saddle, rank: Rank) -> LeastNorm | None:
        """For the rank of all rows; None if the multipliers are determined."""
        T, rows = saddle.T, range(saddle.T.rows)
        if not rank.redundant:
            return None
        acting = torch.zeros(T.rows, dtype=torch.float64)
        acting[[row for i, row in enumerate(rows) if i not in rank.left_out]] = 1.0
        return cls(saddle, acting, rank.rank)

    def at_times(self, data: Data, times: Tensor, q: Tensor, lam: Tensor) -> Tensor:
        """Multipliers of least norm with the forces of lam [times, rows, pair, lanes], along q [times, n_q, pair, lanes]."""
        return over_times(self, self.T, data, times, q, lam)

    def __call__(self, data: Data, excitation: Prescribed, q: Any, lam: Any) -> Any:
        """Multipliers [rows, ...] of least norm with the forces of `lam` at the coordinates q [n_q, ...].

        Differentiable: pairs, and plain tensors in reverse mode, by the formula above (not through an SVD).
        """
        at, acting = equations.placement(self.T, data, q, excitation), self.acting[:, None, None]
        size = size_at(self.T, q, at)
        s, rho = rate_sizes_at(self.T, size), row_sizes(self.T, size, data)
        with torch.no_grad():
            inverse, P = self._inverses(data, at, value(s), value(rho))
            values = value(rho).detach() * value(lam).detach()  # no_grad alone keeps tangents of forward mode
            least = apply(P, values)
            mu, nu = apply(inverse, values), acting * (values - least)
        if not isinstance(lam, Pair) and not torch.is_grad_enabled():
            return least / value(rho)
        # dJ mu and dJ' nu of the module header
        of_rows = reciprocal(rho)
        dJ_mu = variation(acting * (of_rows * equations.constraint_changes(self.T, at, data, s * mu)))
        dJt_nu = variation(s * _forces(self.T, data, at, of_rows * nu))
        slopes = apply(P, variation(rho * lam) - dJ_mu) + dJ_mu + apply(inverse.mT, dJt_nu)
        return of_rows * (Pair.of(least, slopes) if isinstance(lam, Pair) else least + slopes)

    def at_varying_time(self, data: Data, t: Any, q: Any, lam: Any) -> Any:
        """The same for lanes at times t [1 + n, lanes] that may depend on the design; derivatives are total."""
        return self(data, at_own_times(self.T, t, data), q, lam)

    def _inverses(self, data: Data, at: Placement, s: Tensor, rho: Tensor) -> tuple[Tensor, Tensor]:
        """J+ [lanes, n_v, rows] and P [lanes, rows, rows]."""
        J = self.saddle.values_of_jacobian(data, at) * self.acting[:, None]
        J = J * s.detach().permute(2, 1, 0) / rho.detach().permute(2, 0, 1)
        failed = ~torch.isfinite(J).all(1).all(1)[:, None, None]  # lanes whose multipliers become nan
        U, s, Vh = torch.linalg.svd(torch.where(failed, 0.0, J), full_matrices=False)
        independent = s > _APART * s[:, :1]
        independent[:, : self.rank] |= s[:, : self.rank] > 0.0
        U = U * independent[:, None] * self.acting[:, None]  # rows that do not act have rounding errors
        U = torch.where(failed, torch.nan, U)
        return (Vh.mT * torch.where(independent, 1.0 / s, 0.0)[:, None]) @ U.mT, U @ U.mT


def _forces(T: Topology, data: Data, at: Placement, nu: Tensor) -> Tensor:
    """Phi_q' nu [n_v, ...], nu [rows, 1, lanes] held fixed."""
    return cat([x.flatten(0, 1) for x in equations.constraint_forces(T, data, at, nu)])
