"""Limits that keep lamination parameters in the region of those that stacks of plies have.

    mbd.lamination.LaminationRegion("panel") <= 1

Each condition r <= 1 of conditions.py is evaluated at all n controls of the body's laminates; the measure
is its largest value. With a power p it is the p-norm over the controls, which is smooth, and too large by at most the factor
n^(1/p). Fields interpolate between controls with weights >= 0 of sum one: cells keep the conditions that all controls keep.
Checked in tests/extensions/lamination/test_region.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchmbd.design.response import Measure
from torchmbd.errors import InputError
from torchmbd.extensions.fibers.measures import p_norm
from torchmbd.extensions.lamination.conditions import CONDITIONS, conditions
from torchmbd.extensions.lamination.parameters import LaminationParameters
from torchmbd.integrate import Trajectory
from torchmbd.math.checked_numbers import scalar
from torchmbd.multibody.system import System


@dataclass(frozen=True)
class LaminationRegion(Measure):
    """Conditions on a body's lamination parameters [lanes, conditions] [-], each at most 1 for a stack of plies.

    body   its name
    power  None: the largest over the controls of a field; a number p of at least 2: smooth, the p-norm over them

    >>> laminate = mbd.lamination.LaminationParameters(mbd.examples.carbon(), 2e-3, membrane=[0, 0, 0, 0])
    >>> mesh = mbd.mesh.rectangle(0.4, 0.1, cells=(4, 1))
    >>> panel = mbd.FlexibleBody.plate("panel", mesh, laminate, modes=1, reference="left_edge")
    >>> system = mbd.System([panel], [mbd.Fixed(mbd.Ground().at(), panel.at("left_edge"), name="wall")])
    >>> limit = mbd.lamination.LaminationRegion("panel") <= 1
    >>> bool((limit.measure(mbd.simulate(system, 1e-3, steps=4)) <= 1.0).all())  # quasi-isotropic
    True
    """

    body: str
    power: float | None = None
    unit: ClassVar[str] = ""

    def __post_init__(self) -> None:
        if self.power is not None and scalar("power", self.power, "a number of at least 2, or None") < 2.0:
            raise InputError("power", self.power, "a number of at least 2, or None for the exact largest value")

    @property
    def rows(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return CONDITIONS

    def check(self, system: System) -> None:
        _laminates(system, self.body)

    def value(self, motion: Trajectory) -> Tensor:
        _laminates(motion.system, self.body)
        r = motion.of_designs(lambda: _conditions(motion.system, self.body))
        largest = r.amax(-2)
        if self.power is not None:
            # Of the positive numbers: where none is positive, the condition is far from its limit.
            largest = p_norm(r.mT.clamp(min=0.0), largest.detach(), self.power)
        return largest.expand(motion.lanes, CONDITIONS)


def _conditions(system: System, name: str) -> Tensor:
    """Conditions [..., controls, conditions] of the present design."""
    values = []
    for laminate in _laminates(system, name):
        of_laminate = conditions(*laminate.sets())
        values.append(of_laminate if laminate.field is not None else of_laminate.unsqueeze(-2))
    return torch.cat(values, -2)


def _laminates(system: System, name: str) -> list[LaminationParameters]:
    """The laminates of a body that are given by lamination parameters; InputError if there are none."""
    plates = getattr(system.body(name), "plates", {}).values()
    laminates = [part.laminate for part in plates if isinstance(part.laminate, LaminationParameters)]
    if not laminates:
        raise InputError(
            name,
            allowed="a plate of LaminationParameters(...)",
            noun=f"body {name!r}",
            state="has no lamination parameters",
        )
    return laminates
