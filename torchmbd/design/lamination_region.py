"""Lamination parameters that stacks have, as limits of a design.

    mbd.LaminationRegion("panel") <= 1

The conditions r <= 1 of fem/materials/lamination_region.py, each the largest over the body's laminates and their controls. With
a power p it is the p-norm over these instead, which is smooth, and too large by at most the factor n^(1/p). Fields interpolate
between controls with weights that add up to one and are never negative: where the controls keep the conditions, cells do.
Checked in tests/design/test_lamination_region.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from torchmbd.design.fibers import norm
from torchmbd.design.response import Measure
from torchmbd.errors import InputError
from torchmbd.fem.elements import LaminationParameters
from torchmbd.fem.materials.lamination_region import CONDITIONS, conditions
from torchmbd.integrate import Trajectory
from torchmbd.math.checked_numbers import scalar
from torchmbd.math.module_call import call_module
from torchmbd.multibody.system import System


@dataclass(frozen=True)
class LaminationRegion(Measure):
    """Conditions on a body's lamination parameters [lanes, conditions] [-], each at most 1 for a stack of plies.

    body   its name
    power  None: the largest over the controls of a field; a number p of at least 2: smooth, the p-norm over them

    >>> laminate = mbd.LaminationParameters(mbd.examples.carbon(), 2e-3, membrane=[0, 0, 0, 0])
    >>> mesh = mbd.mesh.rectangle(0.4, 0.1, cells=(4, 1))
    >>> panel = mbd.FlexibleBody.plate("panel", mesh, laminate, modes=1, reference="left_edge")
    >>> system = mbd.System([panel], [mbd.Fixed(mbd.Ground().at(), panel.at("left_edge"), name="wall")])
    >>> limit = mbd.LaminationRegion("panel") <= 1
    >>> bool((limit.measure(mbd.simulate(system, 1e-3, steps=4)) <= 1.0).all())  # quasi-isotropic
    True
    """

    body: str
    power: float | None = None

    def __post_init__(self) -> None:
        if self.power is not None and scalar("power", self.power, "a number of at least 2, or None") < 2.0:
            raise InputError(f"power is {self.power!r}; allowed: a number of at least 2, or None for the exact largest")

    @property
    def rows(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return CONDITIONS

    def check(self, system: System) -> None:
        _laminates(system, self.body)

    def value(self, motion: Trajectory) -> Tensor:
        _laminates(motion.system, self.body)
        designs = {f"system.{key}": x for key, x in motion.designs.items()}
        r = call_module(_Conditions(motion.system, self.body), designs)
        largest = r.amax(-2)
        # of the positive numbers only: where all are negative or zero, the condition is far from its limit
        found = largest if self.power is None else norm(r.mT.clamp(min=0.0), largest.detach(), self.power)
        return found.expand(motion.lanes, CONDITIONS)


class _Conditions(nn.Module):
    """Conditions of all controls as a module of the whole system, so that designs go by their names."""

    system: Any

    def __init__(self, system: nn.Module, name: str):
        super().__init__()
        self.system, self.name = system, name

    def forward(self) -> Tensor:
        found = []
        for laminate in _laminates(self.system, self.name):
            own = conditions(*laminate.sets())
            found.append(own if laminate.field is not None else own.unsqueeze(-2))
        return torch.cat(found, -2)


def _laminates(system: System, name: str) -> list[LaminationParameters]:
    """The laminates of a body that are given by lamination parameters; InputError where there are none."""
    plates = getattr(system.body(name), "plates", {}).values()
    found = [part.laminate for part in plates if isinstance(part.laminate, LaminationParameters)]
    if not found:
        raise InputError(f"body {name!r} has no lamination parameters; allowed: a plate of LaminationParameters(...)")
    return found
