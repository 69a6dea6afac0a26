"""Curvature and divergence of steered fiber paths, which layup machines limit, as measures of a design.

    mbd.fibers.FiberCurvature("rod") <= 1 / 0.4            steering radius of at least 0.4 m
    mbd.fibers.FiberDivergence("rod") <= 0.5               neighboring paths drift apart by at most 5 % in 0.1 m

The measure is the largest absolute value over the n cells and layers (steered_laminate.py), which is not smooth
where another cell becomes the largest. With a power p it is the p-norm, smooth and too large by at most the factor n^(1/p):

    (sum_i |x_i|^p)^(1/p)

Checked in tests/extensions/fibers/test_measures.py and tests/extensions/fibers/test_variables.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchmbd.design.response import Measure
from torchmbd.errors import InputError
from torchmbd.extensions.fibers.steered_laminate import FiberPaths, SteeredLaminate
from torchmbd.integrate import Trajectory
from torchmbd.math.checked_numbers import scalar
from torchmbd.multibody.system import System


@dataclass(frozen=True)
class _PathMeasure(Measure):
    """The largest absolute value, or the p-norm, of a quantity of all cells and layers [lanes]."""

    body: str
    power: float | None = None
    unit: ClassVar[str] = "1/m"

    def __post_init__(self) -> None:
        if self.power is not None and scalar("power", self.power, "a number of at least 2, or None") < 2.0:
            raise InputError("power", self.power, "a number of at least 2, or None for the exact largest")

    def check(self, system: System) -> None:
        steered_parts(system, self.body)

    def value(self, motion: Trajectory) -> Tensor:
        steered_parts(motion.system, self.body)
        parts = motion.of_designs(lambda: _paths(motion.system, self.body))
        x = torch.cat([self.values_of(paths).flatten(-2) for paths in parts], -1)
        largest = x.abs().amax(-1)
        return (largest if self.power is None else p_norm(x, largest.detach(), self.power)).expand(motion.lanes)

    def values_of(self, paths: FiberPaths) -> Tensor:
        """The quantity of all cells and layers [..., cells, layers] [1/m]."""
        raise NotImplementedError(type(self).__name__)


@dataclass(frozen=True)
class FiberCurvature(_PathMeasure):
    """Largest curvature of the fiber paths of a body with steered laminates [lanes] [1/m], one over the steering radius.

    body   its name
    power  None: exact; a number p of at least 2: smooth, the p-norm over cells and layers

    >>> strip = mbd.examples.arm().body("arm").mesh
    >>> laminate = mbd.fibers.SteeredLaminate(
    ...     mbd.examples.carbon(), mbd.deg([45, -45]), 1e-3, mbd.fibers.FiberField(strip, (3, 2), degree=1)
    ... )
    >>> motion = mbd.simulate(mbd.examples.arm(laminate=laminate), 0.01, steps=4)
    >>> value, gradient = mbd.fibers.FiberCurvature("arm").value_and_gradient(motion)
    >>> value.item(), gradient.shape  # straight at the start; 6 controls of 2 layers
    (0.0, torch.Size([1, 12]))
    """

    def values_of(self, paths: FiberPaths) -> Tensor:
        return paths.curvature


@dataclass(frozen=True)
class FiberDivergence(_PathMeasure):
    """Largest relative growth of the distance of neighboring fiber paths, along them [lanes] [1/m]; gaps and overlaps.

    body   its name
    power  None: exact; a number p of at least 2: smooth, the p-norm over cells and layers

    >>> strip = mbd.examples.arm().body("arm").mesh
    >>> laminate = mbd.fibers.SteeredLaminate(
    ...     mbd.examples.carbon(), mbd.deg([45, -45]), 1e-3, mbd.fibers.FiberField(strip, (3, 2), degree=1)
    ... )
    >>> motion = mbd.simulate(mbd.examples.arm(laminate=laminate), 0.01, steps=4)
    >>> round(mbd.fibers.FiberDivergence("arm")(motion).item(), 3)
    0.0
    """

    def values_of(self, paths: FiberPaths) -> Tensor:
        return paths.divergence


def steered_parts(system: System, name: str) -> list[Any]:
    """The parts of a body whose laminates are steered; InputError if there are none."""
    body = system.body(name)
    parts = [part for part in getattr(body, "plates", {}).values() if isinstance(part.laminate, SteeredLaminate)]
    if not parts:
        raise InputError(
            "body",
            name,
            allowed="a plate of mbd.fibers.SteeredLaminate(...)",
            state="has no steered laminate",
            noun=f"body {name!r}",
        )
    return parts


def _paths(system: System, name: str) -> list[FiberPaths]:
    """Fiber paths of all steered parts of a body in the present design."""
    paths = []
    for part in steered_parts(system, name):
        matrices = part.matrices
        axes = torch.empty_like(matrices.axes)
        axes[matrices.zones] = matrices.axes  # from the order of the elements to that of the field
        paths.append(part.laminate.paths(axes))
    return paths


def p_norm(x: Tensor, scale: Tensor, power: float) -> Tensor:
    """The p-norm over the last axis of x; `scale` [...] avoids overflow. The norm of zeros, and its derivatives, are zero."""
    m = scale.clamp(min=torch.finfo(x.dtype).tiny)
    total = ((x / m[..., None]).abs() ** power).sum(-1)
    return m * torch.where(total > 0.0, total, 1.0) ** (1.0 / power) * (total > 0.0)
