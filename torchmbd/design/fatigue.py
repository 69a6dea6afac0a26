"""Fatigue of a motion: cycles of a history, equivalent loads, and damage of plies.

    EquivalentLoad(history)       (sum count range^m / N)^(1/m)              N cycles of this range do the same damage
    Damage(history, curve=...)    sum count / cycles(amplitude, mean)        linear accumulation: 1 at failure
    FatigueDamage("rod")          the same of the ply point and stress component of a body where it is largest

Cycles are counted by rainflow (rainflow.py) between peaks that are located between the output times (spline.py). Gradients
are exact where a small change of the design leaves the ranking of the ranges, and the worst point, as they are.
Assumed: damage does not depend on the order of the cycles, and components of the stress act independently; the worst point
is chosen by the values at the output times.
Source: Palmgren (1924) and Miner (1945), linear damage; curves: fem/materials/sn_curve.py.
Checked in tests/design/test_fatigue.py, tests/contracts/test_responses.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchmbd.design.measures import OfHistory
from torchmbd.design.rainflow import Cycles, rainflow
from torchmbd.design.response import Measure
from torchmbd.design.spline import Spline
from torchmbd.errors import InputError, unknown
from torchmbd.fem.materials import PLY_COMPONENTS, SNCurve, power_law_damage
from torchmbd.integrate import Trajectory
from torchmbd.math.checked_numbers import scalar
from torchmbd.multibody.system import System
from torchmbd.results.ply_history import PlyHistory
from torchmbd.results.section_history import SectionHistory, laminated, plies_of

# Where the strengths in tension and compression of each component stand among Strength.numbers().
_STRENGTHS = ((0, 1), (2, 3), (4, 4), (5, 5), (6, 6))
_TOGETHER = 64  # histories of each lane that are counted at once
_CHUNK = 500_000  # stresses that are looked through at once


def _positive(name: str, x: Any) -> None:
    if scalar(name, x, "a positive number") <= 0.0:
        raise InputError(f"{name} is {x!r}; allowed: a positive number")


@dataclass(frozen=True)
class EquivalentLoad(OfHistory):
    """Range of a load that does the same damage in `cycles` cycles [lanes], in the unit of the history.

    history   of a load or a stress
    exponent  of the material's S-N curve, positive: 10 for laminates of glass, 14 of carbon, 4 for welded steel [-]
    cycles    how many, positive; None: one for each second of the motion, or of the window [-]

    >>> motion = mbd.simulate(mbd.examples.pendulum(speed=0.1), 10.0, steps=500)
    >>> swing = mbd.Position("bob", "x")  # five cycles of nearly 64 mm; the two at the ends count half
    >>> round(mbd.EquivalentLoad(swing, exponent=4.0, cycles=5.0)(motion).item(), 3)
    0.062
    """

    exponent: float = 10.0
    cycles: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        _positive("exponent", self.exponent)
        if self.cycles is not None:
            _positive("cycles", self.cycles)

    def reduce(self, curve: Spline) -> Tensor:
        found = rainflow(curve.extremes())
        number = float(curve.t[-1] - curve.t[0]) if self.cycles is None else self.cycles
        size = found.range.detach().amax(-1, keepdim=True)
        size = torch.where(size > 0.0, size, 1.0)  # powers of ranges may overflow
        total = (found.count * (found.range / size) ** self.exponent).sum(-1) / number
        rests = total == 0.0
        return torch.where(rests, 0.0, size[..., 0] * torch.where(rests, 1.0, total) ** (1.0 / self.exponent))


@dataclass(frozen=True)
class Damage(OfHistory):
    """Damage of a stress history [lanes] [-]: one at failure.

    history  stress [Pa]
    curve    SNCurve of the material
    repeats  how often the motion is repeated, positive [-]

    >>> curve = mbd.SNCurve([(1e3, 400e6), (1e6, 200e6)])
    >>> stress = 32.0 / (3.1416 * 0.02**3) * mbd.Reaction("hinge", "z", kind="torque")  # of a round shaft
    >>> limit = mbd.Damage(stress, curve=curve, repeats=1e4) <= 1.0
    """

    curve: SNCurve | None = None
    repeats: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.curve, SNCurve):
            raise InputError(f"curve is {self.curve!r}; allowed: SNCurve([(cycles, amplitude), ...])")
        _positive("repeats", self.repeats)

    def reduce(self, curve: Spline) -> Tensor:
        assert self.curve is not None
        return self.repeats * _of_curve(rainflow(curve.extremes()), self.curve)


@dataclass(frozen=True)
class FatigueDamage(Measure):
    """Damage of the ply point and stress component of a body where it is largest [lanes] [-]: one at failure.

    body      its name: laminated plates, and beams with a Section of plies
    exponent  of power laws through the static strengths of the plies, N = (A(mean) / amplitude)^exponent; one, or one for
              each component: {"11": 14, "22": 10, "12": 10} (others do not count); plies then need a Strength
    curves    component -> SNCurve, instead of power laws: "11" along the fibers, "22" across, "12", "13", "23" shear
    repeats   how often the motion is repeated, positive [-]

    >>> motion = mbd.simulate(mbd.examples.arm(), 0.2, steps=100)
    >>> mbd.FatigueDamage("arm", exponent={"11": 14, "22": 10}, repeats=1e6)(motion).shape
    torch.Size([1])
    """

    body: str
    exponent: float | Mapping[str, float] = 10.0
    curves: Mapping[str, SNCurve] | None = None
    repeats: float = 1.0

    def __post_init__(self) -> None:
        _positive("repeats", self.repeats)
        given = self.exponent if self.curves is None else self.curves
        if self.curves is not None and (not isinstance(given, Mapping) or not given):
            raise InputError(f"curves is {given!r}; allowed: components -> SNCurve, such as {{'11': SNCurve(...)}}")
        for component, x in given.items() if isinstance(given, Mapping) else [("", given)]:
            if component and component not in PLY_COMPONENTS:
                raise unknown("stress component", component, PLY_COMPONENTS)
            if self.curves is None:
                _positive(f"exponent {component}".strip(), x)
            elif not isinstance(x, SNCurve):
                raise InputError(
                    f"curve of component {component!r} is {x!r}; allowed: SNCurve([(cycles, amplitude), ...])"
                )

    def check(self, system: System) -> None:
        plies = plies_of(system.body(self.body))
        if self.curves is None and any(ply.strength is None for ply in plies):
            raise InputError(
                f"a ply of body {self.body!r} has no strength; allowed: Ply(..., strength=Strength(...)), or curves"
            )

    def value(self, motion: Trajectory) -> Tensor:
        self.check(motion.system)
        return self.repeats * torch.stack([_worst(found, self, motion) for found in _stresses(motion, self.body)]).amax(
            0
        )

    def components(self) -> list[int]:
        """Those that count."""
        given = self.exponent if self.curves is None else self.curves
        names = list(given) if isinstance(given, Mapping) else list(PLY_COMPONENTS)
        return [PLY_COMPONENTS.index(name) for name in names]

    def of_cycles(self, cycles: Cycles, component: int, strength: Tensor | None) -> Tensor:
        """Damage [...] of cycles [..., n] of a component; strengths [..., 8]."""
        name = PLY_COMPONENTS[component]
        if self.curves is not None:
            return _of_curve(cycles, self.curves[name])
        assert strength is not None
        tension, compression = (strength[..., [k]] for k in _STRENGTHS[component])
        counts = torch.isfinite(tension)
        tension, compression = (torch.where(counts, x, 1.0) for x in (tension, compression))
        exponent = self.exponent[name] if isinstance(self.exponent, Mapping) else self.exponent
        amplitude = torch.where(counts, 0.5 * cycles.range, 0.0)
        return (cycles.count * power_law_damage(amplitude, cycles.mean, tension, compression, exponent)).sum(-1)


def _of_curve(cycles: Cycles, curve: SNCurve) -> Tensor:
    return (cycles.count / curve.cycles(0.5 * cycles.range, cycles.mean)).sum(-1)


def _stresses(motion: Trajectory, name: str) -> list[tuple[Tensor, Tensor | None]]:
    """Ply stresses of the modes [lanes, points, 5, modes] and strengths [lanes, points, 8] of a body's plates and beams."""
    body = motion.system.body(name)
    found: list[tuple[Tensor, Tensor | None]] = []
    if getattr(body, "plates", None):
        plies = PlyHistory(motion, name)
        found.append((plies.basis.stress, plies.strength))
    if sections := laminated(body):
        history = SectionHistory(motion, name)
        found += [history.basis(part) for part in sections]
    return found


def _worst(stresses: tuple[Tensor, Tensor | None], rule: FatigueDamage, motion: Trajectory) -> Tensor:
    """Damage [lanes] at the point and component where it is largest."""
    basis, strengths = stresses
    view, lanes = motion.body(rule.body), torch.arange(motion.lanes)
    with torch.no_grad():
        component, point = _places(basis, view.w, strengths, rule)
    y, slow, fast = (torch.einsum("ltm,lm->lt", x, basis[lanes, point, component]) for x in (view.w, view.wd, view.wdd))
    cycles = rainflow(Spline.of(motion.t, y, rates=(slow, fast)).extremes())
    return _damages(cycles, component, None if strengths is None else strengths[lanes, point], rule)


def _damages(cycles: Cycles, component: Tensor, strengths: Tensor | None, rule: FatigueDamage) -> Tensor:
    """Damage [h] of the cycles [h, n] of histories of different components [h]; strengths [h, 8]."""
    damages, rows = [], []
    for c in component.unique().tolist():
        own = torch.nonzero(component == c)[:, 0]
        rows.append(own)
        damages.append(
            rule.of_cycles(Cycles(*(x[own] for x in cycles)), c, None if strengths is None else strengths[own])
        )
    return torch.cat(damages)[torch.cat(rows).argsort()]


def _places(basis: Tensor, w: Tensor, strengths: Tensor | None, rule: FatigueDamage) -> tuple[Tensor, Tensor]:
    """Component and point [lanes] of the largest damage, by the stresses at the output times.

    Cycles are counted where they may do the largest damage: as many as the history has, all of its whole range. The most
    suspicious histories of all lanes are counted together, then the next ones of the lanes where these may do more.
    """
    components, lanes, points = torch.tensor(rule.components()), len(basis), basis.shape[1]
    size = max(1, _CHUNK // (points * w.shape[1]))
    parts = zip(
        basis.split(size), w.split(size), [None] * lanes if strengths is None else strengths.split(size), strict=False
    )
    most = torch.cat([_most(*part, rule) for part in parts])  # [lanes, components * points]
    bound, order = most.sort(descending=True)
    worst, place = bound.new_full((lanes,), -1.0), order[:, 0].clone()
    for first in range(0, order.shape[1], _TOGETHER):
        lane = torch.nonzero(bound[:, first] > worst)[:, 0]
        if not len(lane):
            break
        some = order[lane, first : first + _TOGETHER]
        component, point = components[torch.div(some, points, rounding_mode="floor")], some % points
        y = basis[lane[:, None], point, component] @ w[lane].mT
        strength = None if strengths is None else strengths[lane[:, None], point].flatten(0, 1)
        damage = _damages(rainflow(y.flatten(0, 1)), component.flatten(), strength, rule).reshape(some.shape)
        value, k = damage.max(1)
        better = value > worst[lane]
        worst[lane[better]], place[lane[better]] = value[better], some[better, k[better]]
    return components[torch.div(place, points, rounding_mode="floor")], place % points


def _most(basis: Tensor, w: Tensor, strengths: Tensor | None, rule: FatigueDamage) -> Tensor:
    """Damage [lanes, components * points] that no history exceeds: a mean counts most at one of its ends."""
    return torch.cat([_bound(basis[:, :, c] @ w.mT, c, strengths, rule) for c in rule.components()], 1)


def _bound(y: Tensor, component: int, strengths: Tensor | None, rule: FatigueDamage) -> Tensor:
    """The same [lanes, points] of histories y [lanes, points, times] of a component."""
    low, high = y.amin(-1, keepdim=True), y.amax(-1, keepdim=True)
    rises = y[..., 1:] > y[..., :-1]
    turns = (rises[..., 1:] != rises[..., :-1]).sum(-1, keepdim=True)
    cycles = (Cycles(high - low, mean, 0.5 * (turns + 1.0)) for mean in (low, high))
    return torch.stack([rule.of_cycles(x, component, strengths) for x in cycles]).amax(0)
