"""Failure indices of many points under many loads: the criteria of strength.py as forms of few coordinates w.

    stress = basis w,      linear = f' basis w,      quadratic = w' (basis' F basis) w

So the indices of all points are one product of (w_i, w_i w_j) with coefficients of the points, without the stresses. For
max_stress they are the largest of ten linear forms; other criteria of several modes take the stresses. No autograd inside: this
finds the point that is nearest to failure.
Checked in tests/fem/materials/test_failure_forms.py.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.fem.materials.failure_modes import MODES
from torchmbd.fem.materials.strength import CRITERIA, inverse_reserve_factor, tsai_wu_forms


class FailureForms:
    """Failure indices of points.

    criterion   a name of CRITERIA
    basis       stresses of the points for unit coordinates [Pa]
    strength    numbers of the strengths of the points
    """

    def __init__(self, criterion: str, basis: Float[Tensor, "points 5 k"], strength: Float[Tensor, "points 8"]) -> None:
        assert criterion in CRITERIA
        self.criterion, k = criterion, basis.shape[-1]
        if criterion == "max_stress":
            Xt, Xc, Yt, Yc, *shear, _ = strength.unbind(-1)
            limits = torch.stack([Xt, -Xc, Yt, -Yc, *shear, *(-S for S in shear)])
            rows = basis.transpose(0, 1)[[0, 0, 1, 1, 2, 3, 4, 2, 3, 4]]
            self.forms = [rows / limits[..., None]]
            return
        if criterion in MODES:
            self.forms = [basis.flatten(0, 1), strength]
            return
        f, F = tsai_wu_forms(strength)
        quadratic = basis.mT @ F @ basis
        self._pairs = torch.triu_indices(k, k)
        twice = 2.0 - (self._pairs[0] == self._pairs[1]).to(basis)
        self.forms = [(f[:, None] @ basis)[:, 0], quadratic[:, self._pairs[0], self._pairs[1]] * twice]

    def __call__(self, w: Float[Tensor, "n k"]) -> Float[Tensor, "n points"]:
        """Return the indices of all points under each of n loads."""
        if self.criterion == "max_stress":
            return (w @ self.forms[0].mT).amax(0)
        if self.criterion in MODES:
            stress = (w @ self.forms[0].mT).unflatten(1, (-1, 5))
            return CRITERIA[self.criterion](stress, self.forms[1])
        pairs = w[:, self._pairs[0]] * w[:, self._pairs[1]]
        if self.criterion == "tsai_wu":
            return torch.cat([w, pairs], 1) @ torch.cat(self.forms, 1).mT
        return inverse_reserve_factor(w @ self.forms[0].mT, pairs @ self.forms[1].mT)
