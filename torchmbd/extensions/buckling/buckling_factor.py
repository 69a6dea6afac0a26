"""The buckling factor of a body as a measure: under static loads of the design, or under the loads of the motion.

    BucklingFactor("panel", {"right": (-1e3, 0, 0)}, {"left": "all"}) >= 1.5

The factor is infinite, without a gradient, for a design that the loads do not buckle.
Checked in tests/contracts/test_responses.py, tests/extensions/buckling/test_buckling.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar
from weakref import WeakKeyDictionary

from torch import Tensor, nn

from torchmbd.design.histories import flexible_body
from torchmbd.design.measures import Max
from torchmbd.design.response import Measure
from torchmbd.errors import InputError
from torchmbd.extensions.buckling.buckling import BucklingCase, reciprocal
from torchmbd.extensions.buckling.buckling_index import BucklingIndex
from torchmbd.integrate import Trajectory
from torchmbd.math.checked_numbers import is_whole
from torchmbd.math.digest import digest
from torchmbd.math.module_call import outside_transforms
from torchmbd.multibody.system import System

# Body -> digest of loads, supports and changes.
_CASES: WeakKeyDictionary[nn.Module, dict[str, BucklingCase]] = WeakKeyDictionary()


@dataclass(frozen=True)
class BucklingFactor(Measure):
    """Buckling factor [lanes] [-] of a body: for static loads (`linear_buckling`), or the smallest factor along the motion.

    body      its name
    loads     nodes -> force [N], or force and moment [N, N m], in mesh axes, in total; None without changes: the stress of the
              motion, 1 over the peak of BucklingIndex
    supports  nodes -> degrees of freedom that are held, as "u1 u3", or imposed; None: the reference nodes
    number    1 is the lowest
    changes   of temperature or moisture that grow with the loads, as in `linear_buckling`; loads=None then means no loads
    If several factors are equal, the gradient is their mean gradient, as for `Frequency`.

    >>> steel = mbd.Ply.isotropic(E=210e9, nu=0.3, density=7850.0)
    >>> tube = mbd.sections.tube(0.02, steel, [0.0], 1e-3)
    >>> column = mbd.FlexibleBody.beam("column", mbd.BeamLine.straight(2.0, 4), tube, reference="start")
    >>> system = mbd.System([column], [mbd.Fixed(mbd.Ground().at(0, 0, 0), column.at("start"))])
    >>> safe = mbd.buckling.BucklingFactor("column", {"end": (-1000.0, 0.0, 0.0)}) >= 1.5
    >>> motion = mbd.simulate(system, duration=1e-3, steps=2)
    >>> round(safe.measure.value(motion).item(), 1)
    3.0
    """

    unit: ClassVar[str] = ""
    infinite_note: ClassVar[str] = (
        "the loads only stiffen the body. Try: no such constraint, or for the loads of the motion a limit on "
        "mbd.Max(mbd.buckling.BucklingIndex(...)), which is zero there"
    )
    body: str
    loads: Mapping[Any, Sequence[float]] | None = None
    supports: Mapping[Any, str | Sequence[float | None]] | None = None
    number: int = 1
    changes: Mapping[str, float | Mapping[str, float]] | None = None

    def check(self, system: System) -> None:
        if not is_whole(self.number) or self.number < 1:
            raise InputError("number", self.number, "1, 2, ...")
        if self._of_motion:
            self._peak.check(system)
        else:
            self._case(system)

    def value(self, motion: Trajectory) -> Tensor:
        if self._of_motion:
            return reciprocal(self._peak.value(motion))
        case = self._case(motion.system)
        factors = motion.of_designs(lambda: case(self.number).factors)
        return factors[..., -1].expand(len(motion.q))

    @property
    def _of_motion(self) -> bool:
        return self.loads is None and self.changes is None

    @property
    def _peak(self) -> Max:
        return Max(BucklingIndex(self.body, self.supports, self.number))

    def _case(self, system: System) -> BucklingCase:
        body = flexible_body(system, self.body)
        cases, key = _CASES.setdefault(body, {}), digest(self.loads, self.supports, self.changes)
        if key not in cases:
            loads = {} if self.loads is None else self.loads
            cases[key] = outside_transforms(lambda: BucklingCase(body, loads, self.supports, self.changes))
        return cases[key]
