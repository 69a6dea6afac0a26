"""The buckling index of a body as a history: the share of its critical load that it carries at every time of a motion.

    Max(BucklingIndex("rod", supports)) <= 0.5         half of what makes it buckle, at most

The index is 1 / buckling factor of the stress at that time: of the retained modes as they move, and of the static
displacements that inertia, gravity, joints, forces and changes of temperature make besides (unit_loads.py). Where it is
one, the body buckles on its supports under loads that stay as they are.
Assumed: as in `linear_buckling`; inertia of the bent body beyond what the retained modes feel is small against that of the
undeformed. Checked in tests/contracts/test_responses.py, tests/extensions/buckling/test_buckling_index.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar
from weakref import WeakKeyDictionary

import torch
from torch import Tensor, nn

from torchmbd.design.histories import flexible_body
from torchmbd.design.response import History
from torchmbd.errors import InputError
from torchmbd.extensions.buckling.body_loads import body_loads, changes, interpolations
from torchmbd.extensions.buckling.buckling_series import BucklingSeries
from torchmbd.extensions.buckling.unit_loads import UnitLoads
from torchmbd.integrate import Trajectory
from torchmbd.math.checked_numbers import is_whole
from torchmbd.math.digest import digest
from torchmbd.math.module_call import call_module, outside_transforms
from torchmbd.multibody.bodies import FlexibleBeam
from torchmbd.multibody.system import System

_SERIES: WeakKeyDictionary[nn.Module, dict[str, BucklingSeries]] = WeakKeyDictionary()  # body -> digest of supports


@dataclass(frozen=True)
class BucklingIndex(History):
    """Share of the critical load that a flexible body carries [lanes, times] [-]: 1 / buckling factor of its stress.

    The index is zero if the stress only stiffens. If several indices are equal, the gradient is their mean gradient.

    body      its name; plates and beams
    supports  nodes -> degrees of freedom that are held while it buckles, as "u1 u3", in mesh axes; None: the reference nodes
    number    1 is the largest index

    >>> motion = mbd.simulate(mbd.examples.arm(), 0.1, steps=40)
    >>> index = mbd.buckling.BucklingIndex("arm")
    >>> index(motion).shape
    torch.Size([1, 41])
    >>> mbd.Max(index) <= 0.5  # as a constraint
    Constraint(...)
    """

    unit: ClassVar[str] = ""
    body: str
    supports: Mapping[Any, str | Sequence[float | None]] | None = None
    number: int = 1

    def check(self, system: System) -> None:
        if not is_whole(self.number) or self.number < 1:
            raise InputError("number", self.number, "1, 2, ...")
        self._series(system)

    def values(self, motion: Trajectory) -> Tensor:
        system, view = motion.system, motion.body(self.body)
        series, body = self._series(system), flexible_body(system, self.body)
        loads, of_body = body_loads(motion, body), changes(motion, body)
        unit = outside_transforms(lambda: UnitLoads(body, interpolations(system, body), of_body))
        parameters = {name: x.detach() for name, x in system.named_parameters()} | motion.designs
        designs = {f"system.{name}": x for name, x in parameters.items()}
        # Amplitudes of modes and static displacements.
        c = torch.cat([view.w, loads.inertia, loads.concentrated.flatten(2), loads.changes], -1)
        index = call_module(_Index(system, series, unit, self.number), designs, view.psi, view.stiffness[0], c)
        return index[..., -1]

    def _series(self, system: System) -> BucklingSeries:
        if isinstance(system.body(self.body), FlexibleBeam):
            raise InputError(
                str(self.body),
                allowed="a FlexibleBody of elements",
                noun=f"body {self.body!r}",
                state="is a FlexibleBeam, whose own motion already shows if it buckles",
            )
        body = flexible_body(system, self.body)
        series, key = _SERIES.setdefault(body, {}), digest(self.supports)
        if key not in series:
            series[key] = outside_transforms(lambda: BucklingSeries(body, self.supports))
        return series[key]


class _Index(nn.Module):
    """Buckling indices of a series of stresses, as a module that holds the system: designs replace its parameters."""

    def __init__(self, system: nn.Module, series: BucklingSeries, unit: UnitLoads, number: int):
        super().__init__()
        self.system, self.series, self.unit, self.number = system, series, unit, number

    def forward(self, psi: Tensor, Kr: Tensor, c: Tensor) -> Tensor:
        displacements = torch.cat([psi, self.unit(psi, Kr)], -1)
        parts = [self.unit.body.expansion.changing(*change) for change in self.unit.changes]
        return self.series(displacements, c, self.number, parts)
