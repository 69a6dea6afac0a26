"""Changes of temperature and moisture as loads of buckling: kind -> amount, or kind -> zone -> amount.

    f = amount F,     stress = that of K^-1 f less amount times that of the free strains of a unit change

F   loads on the nodes that cause the free expansion by a unit change (bodies/expansion.py)

So a plate that expands freely has no stress, and a plate that is held has the stress of its free strains, with the opposite
sign. Checked in tests/extensions/buckling/test_thermal.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.math.checked_numbers import scalar
from torchmbd.multibody.bodies import FlexibleBody
from torchmbd.multibody.bodies.expansion import Load

Changes = Mapping[str, float | Mapping[str, float]]


class ExpansionLoads:
    """The changes of one body, checked.

    amounts   one for each change, in the order of `parts` and of the loads; zeros are left out
    parts     that change, of each: part -> kind
    Raises InputError for a kind or a zone that the body does not have, and for a ply without the coefficient.
    """

    def __init__(self, body: FlexibleBody, changes: Changes) -> None:
        path, self.body = (body.name, "changes"), body
        if not isinstance(changes, Mapping):
            allowed = "a mapping: kind -> amount, or kind -> zone -> amount, such as {'temperature': 80.0}"
            raise InputError(path, changes, allowed)
        self._loads: list[Load] = []
        self.amounts: list[float] = []
        for change, x in changes.items():
            zones: Mapping[Any, Any] = x if isinstance(x, Mapping) else {None: x}
            for zone, amount in zones.items():
                number = scalar((*path, str(change)), amount)
                if number != 0.0:
                    with torch.no_grad():
                        body.expansion.forces(zone, change)  # kind and zone exist, and the plies have the coefficients
                    body.expansion.warn_of_other_parts(zone)
                    self._loads.append((zone, change))
                    self.amounts.append(number)
        self.parts = [body.expansion.changing(*load) for load in self._loads]

    def forces(self) -> Float[Tensor, "*lanes n 6 k"]:
        """Forces [N] and moments [N m] on all nodes by a unit of each change, of the present design."""
        columns = [self.body.expansion.forces(*load) for load in self._loads]
        none = torch.zeros(len(self.body.mesh.nodes), 6, 0, dtype=torch.float64)
        return torch.stack(torch.broadcast_tensors(*columns), -1) if columns else none
