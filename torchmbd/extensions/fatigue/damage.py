"""Fatigue of a motion: cycles of a history, equivalent loads, and damage of plies.

    EquivalentLoad(history)       (sum count range^m / N)^(1/m)              N cycles of this range do the same damage
    Damage(history, curve=...)    sum count / cycles(amplitude, mean)        linear accumulation: 1 at failure
    FatigueDamage("rod")          damage at the ply point and in the stress component of a body where it is largest

Cycles are counted by rainflow (rainflow.py) between peaks that are located between the output times (spline.py). Gradients
are exact where a small change of the design changes neither the ranking of the ranges nor the worst point.
Assumed: damage does not depend on the order of the cycles, and components of the stress act independently; the worst point
is the worst one by the stresses at the output times.
Source: Palmgren (1924) and Miner (1945), linear damage; curves: sn_curve.py.
Checked in tests/extensions/fatigue/test_fatigue.py, tests/contracts/test_responses.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchmbd.design.curve import curve_of
from torchmbd.design.measures import OfHistory
from torchmbd.design.response import Measure
from torchmbd.design.spline import Spline
from torchmbd.errors import InputError, unknown
from torchmbd.extensions.fatigue.rainflow import Cycles, rainflow
from torchmbd.extensions.fatigue.sn_curve import SNCurve, power_law_damage
from torchmbd.fem.materials import PLY_COMPONENTS
from torchmbd.integrate import Trajectory
from torchmbd.math.checked_numbers import scalar
from torchmbd.math.forward_mode import jvp
from torchmbd.multibody.system import System
from torchmbd.results.lane_motion import has_lane_times, lane_motion
from torchmbd.results.ply_history import PlyHistory, amounts, changes_of
from torchmbd.results.section_history import SectionHistory, laminated, plies_of

# Indices of the strengths in tension and compression of each component in Strength.numbers().
_STRENGTHS = ((0, 1), (2, 3), (4, 4), (5, 5), (6, 6))
_HISTORIES = 64  # histories of each lane whose cycles are counted at once
_CHUNK = 500_000  # stresses in memory for the upper bounds at once


def _positive(name: str, x: Any) -> None:
    if scalar(name, x, "a positive number") <= 0.0:
        raise InputError(name, x, "a positive number")


COUNT_NOTE = (
    "the error assumes that the counted cycles stay the same; the damage jumps where finer steps add or remove a cycle"
)


@dataclass(frozen=True)
class EquivalentLoad(OfHistory):
    """Range of a load that does the same damage in `cycles` cycles [lanes], in the unit of the history.

    history   of a load or a stress
    exponent  of the material's S-N curve, positive: 10 for laminates of glass, 14 of carbon, 4 for welded steel [-]
    cycles    number of cycles, positive; None: one for each second of the motion, or of the window [-]

    >>> motion = mbd.simulate(mbd.examples.pendulum(speed=0.1), 10.0, steps=500)
    >>> swing = mbd.Position("bob", "x")  # five cycles of nearly 64 mm; the two at the ends count half
    >>> round(mbd.fatigue.EquivalentLoad(swing, exponent=4.0, cycles=5.0)(motion).item(), 3)
    0.062
    """

    exponent: float = 10.0
    cycles: float | None = None
    error_note: ClassVar[str] = COUNT_NOTE

    def __post_init__(self) -> None:
        super().__post_init__()
        _positive("exponent", self.exponent)
        if self.cycles is not None:
            _positive("cycles", self.cycles)

    @property
    def natural_zero(self) -> bool:
        return True  # of ranges alone

    def reduce(self, curve: Spline) -> Tensor:
        counted = rainflow(curve.extremes())
        number = curve.duration if self.cycles is None else self.cycles
        size = counted.range.detach().amax(-1, keepdim=True)
        size = torch.where(size > 0.0, size, 1.0)  # powers of ranges may overflow
        total = (counted.count * (counted.range / size) ** self.exponent).sum(-1) / number
        is_constant = total == 0.0
        root = torch.where(is_constant, 1.0, total) ** (1.0 / self.exponent)
        return torch.where(is_constant, 0.0, size[..., 0] * root)


@dataclass(frozen=True)
class Damage(OfHistory):
    """Damage of a stress history [lanes] [-]: one at failure.

    history  stress [Pa]
    curve    SNCurve of the material
    repeats  number of repetitions of the motion, positive [-]

    >>> curve = mbd.fatigue.SNCurve([(1e3, 400e6), (1e6, 200e6)])
    >>> stress = 32.0 / (3.1416 * 0.02**3) * mbd.Reaction("hinge", "z", kind="torque")  # of a round shaft
    >>> limit = mbd.fatigue.Damage(stress, curve=curve, repeats=1e4) <= 1.0
    """

    curve: SNCurve | None = None
    repeats: float = 1.0
    error_note: ClassVar[str] = COUNT_NOTE
    unit: ClassVar[str] = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.curve, SNCurve):
            raise InputError("curve", self.curve, "an SNCurve([(cycles, amplitude), ...])")
        _positive("repeats", self.repeats)

    @property
    def natural_zero(self) -> bool:
        return True  # of ranges alone

    def reduce(self, curve: Spline) -> Tensor:
        assert self.curve is not None
        return self.repeats * _curve_damage(rainflow(curve.extremes()), self.curve)


@dataclass(frozen=True)
class FatigueDamage(Measure):
    """Damage at the ply point and in the stress component of a body where it is largest [lanes] [-]: one at failure.

    body      its name: laminated plates, and beams with a Section of plies
    exponent  of power laws through the static strengths of the plies, N = (A(mean) / amplitude)^exponent; one, or one for
              each component: {"11": 14, "22": 10, "12": 10} (other components have no damage); it requires a Strength of
              every ply
    curves    component -> SNCurve, instead of power laws: "11" along the fibers, "22" across, "12", "13", "23" shear
    repeats   number of repetitions of the motion, positive [-]

    >>> motion = mbd.simulate(mbd.examples.arm(), 0.2, steps=100)
    >>> mbd.fatigue.FatigueDamage("arm", exponent={"11": 14, "22": 10}, repeats=1e6)(motion).shape
    torch.Size([1])
    """

    body: str
    exponent: float | Mapping[str, float] = 10.0
    curves: Mapping[str, SNCurve] | None = None
    repeats: float = 1.0
    error_note: ClassVar[str] = COUNT_NOTE
    unit: ClassVar[str] = ""

    def __post_init__(self) -> None:
        _positive("repeats", self.repeats)
        if self.curves is not None and (not isinstance(self.curves, Mapping) or not self.curves):
            raise InputError("curves", self.curves, "a mapping component -> SNCurve, such as {'11': SNCurve(...)}")
        if self.curves is None and not isinstance(self.exponent, Mapping):
            _positive("exponent", self.exponent)
            return
        by_component: Any = self.exponent if self.curves is None else self.curves
        if not by_component:
            raise InputError("exponent", self.exponent, "a positive number, or one for each component")
        for component, x in by_component.items():
            if component not in PLY_COMPONENTS:
                raise unknown("stress component", component, PLY_COMPONENTS)
            if self.curves is None:
                _positive(f"exponent {component}", x)
            elif not isinstance(x, SNCurve):
                raise InputError(
                    (str(component), "curve"),
                    x,
                    "an SNCurve([(cycles, amplitude), ...])",
                    noun=f"curve of component {component!r}",
                )

    def check(self, system: System) -> None:
        plies = plies_of(system.body(self.body))
        if self.curves is None and any(ply.strength is None for ply in plies):
            raise InputError(
                "body",
                self.body,
                "must have a strength",
                state="has no strength",
                noun=f"a ply of body {self.body!r}",
                hint="Ply(..., strength=Strength(...)), or curves",
            )

    def value(self, motion: Trajectory) -> Tensor:
        self.check(motion.system)
        worst = [_worst_damage(basis, strengths, self, motion) for basis, strengths in _stresses(motion, self.body)]
        return self.repeats * torch.stack(worst).amax(0)

    def components(self) -> list[int]:
        """Indices of the stress components that have an exponent or a curve."""
        by_component = self.exponent if self.curves is None else self.curves
        names = list(by_component) if isinstance(by_component, Mapping) else list(PLY_COMPONENTS)
        return [PLY_COMPONENTS.index(name) for name in names]

    def of_cycles(self, cycles: Cycles, component: int, strength: Tensor | None) -> Tensor:
        """Damage [...] of cycles [..., n] of a component; strength [..., 8] of its plies, None with curves."""
        name = PLY_COMPONENTS[component]
        if self.curves is not None:
            return _curve_damage(cycles, self.curves[name])
        assert strength is not None
        tension, compression = (strength[..., [k]] for k in _STRENGTHS[component])
        has_strength = torch.isfinite(tension)
        tension, compression = (torch.where(has_strength, x, 1.0) for x in (tension, compression))
        exponent = self.exponent[name] if isinstance(self.exponent, Mapping) else self.exponent
        amplitude = torch.where(has_strength, 0.5 * cycles.range, 0.0)
        return (cycles.count * power_law_damage(amplitude, cycles.mean, tension, compression, exponent)).sum(-1)


def _curve_damage(cycles: Cycles, curve: SNCurve) -> Tensor:
    return (cycles.count / curve.cycles(0.5 * cycles.range, cycles.mean)).sum(-1)


def _stresses(motion: Trajectory, name: str) -> list[tuple[Tensor, Tensor | None]]:
    """Stresses by coordinates [lanes, points, 5, coordinates] and strengths [lanes, points, 8] at ply points of plates and of
    beams. Coordinates are those of the modes, and changes of temperature and moisture behind them."""
    body = motion.system.body(name)
    parts: list[tuple[Tensor, Tensor | None]] = []
    if getattr(body, "plates", None):
        plies = PlyHistory(motion, name)
        parts.append((plies.basis.stress, plies.strength))
    if sections := laminated(body):
        history = SectionHistory(motion, name)
        parts += [history.basis(part) for part in sections]
    return parts


def _worst_damage(basis: Tensor, strengths: Tensor | None, rule: FatigueDamage, motion: Trajectory) -> Tensor:
    """Damage [lanes] at the point and in the component where it is largest; arguments as in `_stresses`."""
    lanes = torch.arange(motion.lanes)
    with torch.no_grad():
        component, point = _worst_points(basis, _coordinates_of_lanes(motion, rule.body), strengths, rule)
    stress = basis[lanes, point, component]

    def samples(part: Trajectory, of_lanes: slice) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        coordinates = _coordinates(part, rule.body)
        y, rate, second_rate = (torch.einsum("ltm,lm->lt", x, stress[of_lanes]) for x in coordinates)
        return y, (rate, second_rate)

    cycles = rainflow(curve_of(motion, samples).extremes())
    return _damages(cycles, component, None if strengths is None else strengths[lanes, point], rule)


def _coordinates(motion: Trajectory, name: str) -> tuple[Tensor, Tensor, Tensor]:
    """Coordinates of the stresses with their first and second derivative by time [lanes, times, coordinates]."""
    view, changes = motion.body(name), changes_of(motion, motion.system.body(name))

    def values(times: Tensor) -> Tensor:
        return amounts(changes, times, motion.lanes)

    def rates(times: Tensor) -> tuple[Tensor, Tensor]:
        return jvp(values, (times,), (torch.ones_like(times),))

    of_changes = motion.of_designs(lambda: jvp(rates, (motion.t,), (torch.ones_like(motion.t),)))
    (x, rate), (_, second_rate) = of_changes
    of_modes = (view.w, view.wd, view.wdd)
    w, wd, wdd = (torch.cat(pair, -1) for pair in zip(of_modes, (x, rate, second_rate), strict=True))
    return w, wd, wdd


def _coordinates_of_lanes(motion: Trajectory, body: str) -> Tensor:
    """At all times of the lanes [lanes, times, coordinates]; the last ones repeated where others have more."""
    if not has_lane_times(motion):
        return _coordinates(motion, body)[0]
    parts = [_coordinates(lane_motion(motion, lane).motion, body)[0][0] for lane in range(motion.lanes)]
    most = max(len(w) for w in parts)
    return torch.stack([torch.cat([w, w[-1:].expand(most - len(w), -1)]) for w in parts])


def _damages(cycles: Cycles, component: Tensor, strengths: Tensor | None, rule: FatigueDamage) -> Tensor:
    """Damage [h] of the cycles [h, n] of histories of different components [h]; strengths [h, 8]."""
    damages, rows = [], []
    for c in component.unique().tolist():
        row = torch.nonzero(component == c)[:, 0]
        strength = None if strengths is None else strengths[row]
        rows.append(row)
        damages.append(rule.of_cycles(Cycles(*(x[row] for x in cycles)), c, strength))
    return torch.cat(damages)[torch.cat(rows).argsort()]


def _worst_points(basis: Tensor, w: Tensor, strengths: Tensor | None, rule: FatigueDamage) -> tuple[Tensor, Tensor]:
    """Component and point [lanes] of the largest damage, by the stresses at the output times.

    Cycles are counted only where the damage may be the largest, by an upper bound. The histories with the largest bounds of
    all lanes are counted together, then the next ones of the lanes where these may have a larger damage.
    """
    components, lanes, points = torch.tensor(rule.components()), len(basis), basis.shape[1]
    size = max(1, _CHUNK // (points * w.shape[1]))
    split_strengths = [None] * lanes if strengths is None else strengths.split(size)
    parts = zip(basis.split(size), w.split(size), split_strengths, strict=False)
    bounds = torch.cat([_upper_bounds(*part, rule) for part in parts])  # [lanes, components * points]
    bound, order = bounds.sort(descending=True)
    worst, worst_index = bound.new_full((lanes,), -1.0), order[:, 0].clone()
    for first in range(0, order.shape[1], _HISTORIES):
        lane = torch.nonzero(bound[:, first] > worst)[:, 0]
        if not len(lane):
            break
        index = order[lane, first : first + _HISTORIES]
        component, point = components[torch.div(index, points, rounding_mode="floor")], index % points
        y = basis[lane[:, None], point, component] @ w[lane].mT
        strength = None if strengths is None else strengths[lane[:, None], point].flatten(0, 1)
        damage = _damages(rainflow(y.flatten(0, 1)), component.flatten(), strength, rule).reshape(index.shape)
        value, k = damage.max(1)
        better = value > worst[lane]
        worst[lane[better]], worst_index[lane[better]] = value[better], index[better, k[better]]
    return components[torch.div(worst_index, points, rounding_mode="floor")], worst_index % points


def _upper_bounds(basis: Tensor, w: Tensor, strengths: Tensor | None, rule: FatigueDamage) -> Tensor:
    """Upper bounds of the damage of all histories [lanes, components * points].

    As many cycles as the history has, each of its whole range. The damage is largest at one end of the interval of means.
    """
    bounds = []
    for component in rule.components():
        y = basis[:, :, component] @ w.mT
        low, high = y.amin(-1, keepdim=True), y.amax(-1, keepdim=True)
        rises = y[..., 1:] > y[..., :-1]
        turns = (rises[..., 1:] != rises[..., :-1]).sum(-1, keepdim=True)
        cycles = (Cycles(high - low, mean, 0.5 * (turns + 1.0)) for mean in (low, high))
        bounds.append(torch.stack([rule.of_cycles(x, component, strengths) for x in cycles]).amax(0))
    return torch.cat(bounds, 1)
