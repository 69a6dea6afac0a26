"""Measured frequencies, damping ratios and mode shapes of small vibrations about an equilibrium.

    r = (f_model - f) / (share f),    (zeta_model - zeta) / (share zeta)
    MAC = |phi' psi|^2 / (phi' phi . psi' psi)         phi measured, psi of the model, at the sensors

Shapes pair modes: measured ones with those of the model, each with another, so that the sum of their MAC is largest. A measured
mode whose MAC is too small at the start has no partner and is left out, by name. Shapes themselves are not residuals: those
of the model have no derivatives. Without shapes modes are paired by their order.
Frequencies are natural ones, those without damping. Sources: Allemang, Sound and Vibration 37 (2003) 14-23 (MAC); the pairs are
those of scipy.optimize.linear_sum_assignment.
Checked in tests/extensions/identification/test_modal_data.py.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from torchmbd.design.differentiate import differentiate
from torchmbd.design.histories import Displacement, Position, Velocity
from torchmbd.errors import DesignFailure, InputError
from torchmbd.extensions.identification.measurement import Block, Limits, Measurement, Prediction
from torchmbd.extensions.identification.run import Run
from torchmbd.extensions.vibrations.eigenvalues import NATURAL, POLES
from torchmbd.extensions.vibrations.spectrum import SWINGS
from torchmbd.math.checked_numbers import is_whole, positive
from torchmbd.multibody.system import System
from torchmbd.optimization.optimizer import require_range
from torchmbd.results.motion_data import OK
from torchmbd.results.time_rows import TensorSignals
from torchmbd.simulation.equilibrium import Equilibrium

LEAST_MAC = 0.5  # below, two shapes are not taken for the same mode
OPTIONS = ("times", "spin", "center", "observer", "follow", "unstable")  # of `equilibrium`
_ZERO = 1e-6  # of the largest frequency: rigid motions


@dataclass(frozen=True, eq=False)
class Pairing:
    """Which modes of a model are which measured ones, for one design.

    modes   numbers of the model's modes among its vibrations, from 0, one for each measured mode
    mac     of each pair; nan without shapes
    """

    modes: list[int]
    mac: list[float]


def check_options(measurement: Measurement, options: Mapping[str, Any]) -> None:
    """InputError for options of `equilibrium` that a measurement about one does not have."""
    if wrong := [name for name in options if name not in OPTIONS]:
        raise InputError(("options", wrong[0]), wrong[0], OPTIONS, noun=f"option of {type(measurement).__name__}")


class ModalData(Measurement):
    """Frequencies of small vibrations about an equilibrium; damping ratios and shapes at sensors where they were measured.

    frequencies  [modes] [Hz], ascending
    damping      damping ratios [modes] [-], nan for modes without a measurement; None: not measured
    shapes       [sensors, modes], of any scale; None: modes are paired by their order
    sensors      of the rows of the shapes: positions such as mbd.Position("arm", "z", node="right"), of points and directions
    modes        without shapes: numbers of the modes of the model, 1 for the lowest that is not a rigid motion; default: 1,
                 2, ...
    frequency_share, damping_share   standard deviations, as shares of what was measured
    least_mac    smallest MAC (modal assurance criterion) of a measured mode and its partner in the model
    options      of `equilibrium`: spin, center, observer for vibrations in a steady rotation, times

    >>> modes = mbd.identification.ModalData([0.35, 1.2], damping=[0.01, np.nan])
    >>> [(block.channel, len(block.measured)) for block in modes.blocks]
    [('frequency', 2), ('damping ratio', 1)]
    """

    def __init__(
        self,
        frequencies: Sequence[float],
        damping: Sequence[float] | None = None,
        shapes: Any = None,
        sensors: Sequence[Position] = (),
        modes: Sequence[int] | None = None,
        frequency_share: float = 0.01,
        damping_share: float = 0.1,
        least_mac: float = LEAST_MAC,
        **options: Any,
    ):
        self.frequencies = _positive("frequencies", frequencies, " [Hz]")
        if (np.diff(self.frequencies) < 0.0).any():
            raise InputError("frequencies", frequencies, "numbers in ascending order [Hz]")
        count = len(self.frequencies)
        self.damping = np.full(count, np.nan) if damping is None else _numbers(damping)
        if self.damping.shape != (count,) or (self.damping <= 0.0).any() or np.isinf(self.damping).any():
            raise InputError(
                "damping", damping, f"{count} positive numbers, nan for a mode whose damping was not measured"
            )
        self.shares = positive("frequency_share", frequency_share, "-"), positive("damping_share", damping_share, "-")
        require_range("least_mac", least_mac, 0.0, 1.0)
        self.least_mac, self.options = least_mac, options
        check_options(self, options)
        self.sensors = [_velocity(sensor) for sensor in sensors]
        self.shapes = None if shapes is None else _numbers(shapes)
        if shapes is None and self.sensors:
            raise InputError(
                "sensors", sensors, "given together with shapes, or left out", state="are given without shapes"
            )
        if shapes is not None and modes is not None:
            raise InputError("modes", modes, "None", state=f"is {modes!r}, but the shapes already pair the modes")
        if self.shapes is not None and self.shapes.shape != (len(self.sensors), count):
            raise InputError(
                "shapes",
                self.shapes,
                f"must have shape [{len(self.sensors)} sensors, {count} modes]",
                state=f"have shape {self.shapes.shape}",
            )
        if self.shapes is not None and not (
            np.isfinite(self.shapes).all() and (np.abs(self.shapes).max(0) > 0.0).all()
        ):
            raise InputError(
                "shapes",
                shapes,
                "finite numbers that are not all zero",
                state="have a mode that is zero or is not finite",
            )
        numbers: Any = list(range(1, count + 1)) if modes is None else modes
        self.numbers: list[int] = list(numbers) if isinstance(numbers, (list, tuple, range)) else []
        if (
            len(self.numbers) != count
            or not all(is_whole(k) and k >= 1 for k in self.numbers)
            or len(set(self.numbers)) < count
        ):
            raise InputError("modes", modes, f"{count} different numbers, 1 for the lowest mode")
        self.labels, self.without_partner = list(range(1, count + 1)), ""

    def check(self, system: System) -> None:
        for sensor in self.sensors:
            sensor.check(system)

    @property
    def blocks(self) -> list[Block]:
        labels, known = np.array(self.labels, dtype=float), np.isfinite(self.damping)
        result = [
            Block("frequency", labels, self.frequencies, self.shares[0] * self.frequencies, "frequency [Hz]", "mode",
                  self.without_partner)
        ]  # fmt: skip
        if known.any():
            zeta = self.damping[known]
            result.append(
                Block("damping ratio", labels[known], zeta, self.shares[1] * zeta, "damping ratio [-]", "mode")
            )
        return result

    def within(self, limits: Limits, run: Run) -> Self:
        """Without measured modes that have no partner in the model where the search begins."""
        rest = run.equilibrium(run.system, **self.options)
        if self.shapes is None:
            self._pairing(rest, 0)  # InputError for more modes than the model has
            return self
        mac = self._mac(rest, 0)
        pairs = _assigned(mac)
        kept = [m for m in range(len(mac)) if m in pairs and mac[m, pairs[m]] >= self.least_mac]
        if len(kept) == len(mac):
            return self
        if not kept:
            raise InputError(
                "frequencies",
                allowed=f"must have at least one shape that is like a mode of the model, with a MAC of {self.least_mac:g}",
                noun="measured modes",
                state=f"are unlike all modes of the model: their largest MAC is {mac.max():.2g}",
                hint="a start nearer to the test, the places and directions of the sensors, or a smaller least_mac",
            )
        result = object.__new__(type(self))
        vars(result).update(vars(self))
        names = [
            f"{self.labels[m]} ({self.frequencies[m]:g} Hz, MAC {mac[m].max():.2f})"
            for m in range(len(mac))
            if m not in kept
        ]
        assert self.shapes is not None
        result.frequencies, result.damping, result.shapes = (
            self.frequencies[kept],
            self.damping[kept],
            self.shapes[:, kept],
        )
        result.labels = [self.labels[m] for m in kept]
        result.without_partner = f"measured modes without a partner in the model are left out: {', '.join(names)}"
        return result

    def predict(self, run: Run, unknowns: Mapping[str, Tensor]) -> Prediction:
        rest = run.equilibrium(run.system, **self.options)
        pairings = [self._pairing(rest, lane) for lane in range(rest.lanes)]
        modes = torch.tensor([x.modes for x in pairings]).T  # [measured, lanes]
        known = torch.from_numpy(np.flatnonzero(np.isfinite(self.damping)))

        def rows(rest: Any) -> Tensor:
            w = rest.eigenvalues(NATURAL)
            f = w.gather(0, modes) / (2.0 * math.pi)
            if not len(known):
                return f.T
            s = rest.eigenvalues(POLES)
            s = s.gather(0, _poles_of(s.detach(), w.detach(), modes[known]))
            return torch.cat([f, -s.real / s.abs()]).T

        y = differentiate(rows, rest)
        value, gradient = y.value.expand(run.lanes, -1), y.gradient
        if run.gradients and gradient is None:
            gradient = value.new_zeros(*value.shape, 0)
        notes = self._notes(pairings[0], value[0]) if run.lanes == 1 else ()
        return Prediction(value, gradient, {}, [OK] * run.lanes, notes)

    def _pairing(self, rest: Equilibrium, lane: int) -> Pairing:
        if self.shapes is not None:
            mac = self._mac(rest, lane)
            pairs = _assigned(mac)
            modes = self._elastic(rest, lane)
            return Pairing(
                [modes[pairs[m]] for m in range(len(mac))], [float(mac[m, pairs[m]]) for m in range(len(mac))]
            )
        modes = self._elastic(rest, lane)
        if max(self.numbers) > len(modes):
            raise InputError(
                "numbers",
                max(self.numbers),
                f"1 to {len(modes)}",
                noun=f"mode {max(self.numbers)}",
                state=f"is measured, and the model has {len(modes)} vibrations",
            )
        return Pairing([modes[k - 1] for k in self.numbers], [math.nan] * len(self.numbers))

    def _elastic(self, rest: Equilibrium, lane: int) -> list[int]:
        """Numbers of the vibrations of the model that are not rigid motions, from 0."""
        f = rest.vibrations[lane].frequencies
        if bool(f.isnan().any()):
            raise DesignFailure(
                "system",
                allowed="about a stable equilibrium",
                noun="vibrations about the equilibrium",
                state="grow, so that they do not have frequencies",
            )
        largest = float(torch.nan_to_num(f).max()) if len(f) else 0.0
        return [k for k, x in enumerate(f.tolist()) if x > _ZERO * largest]

    def _mac(self, rest: Equilibrium, lane: int) -> np.ndarray:
        """MAC [measured, vibrations that are not rigid motions]."""
        modes = self._elastic(rest, lane)
        if len(modes) < len(self.frequencies):
            raise InputError(
                "frequencies",
                allowed=f"at most {len(modes)}",
                noun=f"{len(self.frequencies)} modes",
                state=f"are measured, and the model has {len(modes)} vibrations",
            )
        shapes = rest.vibrations[lane].shapes[:, modes].T  # at each "time" the rates of one mode
        q = rest.q[lane, -1].detach().expand(len(modes), -1)
        lam = rest.lam[lane, -1].detach().expand(len(modes), -1)
        states = {"q": q[None], "v": shapes[None], "a": torch.zeros_like(shapes)[None], "lam": lam[None]}
        t = torch.arange(len(modes), dtype=torch.float64)
        with torch.no_grad():
            alone = rest.dynamics.values().select_lanes([lane])
            still = replace(rest.one_lane(lane, t, TensorSignals(states)), dynamics=alone, rotation=None)
            psi = torch.stack([sensor.values(still)[0] for sensor in self.sensors]).numpy()
        assert self.shapes is not None
        sizes = (self.shapes**2).sum(0)[:, None] * np.maximum((psi**2).sum(0), np.finfo(float).tiny)
        return (self.shapes.T @ psi) ** 2 / sizes

    def _notes(self, pairing: Pairing, values: Tensor) -> tuple[str, ...]:
        if self.shapes is None:
            return ()
        rows = zip(self.labels, self.frequencies, pairing.modes, pairing.mac, values.tolist(), strict=False)
        return tuple(
            f"measured mode {label} ({f:.4g} Hz) is mode {mode + 1} of the model ({model:.4g} Hz), MAC {mac:.2f}"
            for label, f, mode, mac, model in rows
        )


def _poles_of(s: Tensor, natural: Tensor, modes: Tensor) -> Tensor:
    """Numbers of the poles [k, lanes] of vibrations: among those that oscillate the one whose size is that frequency.

    Sizes, not imaginary parts: damping changes these, and a mode that is damped more than critically has none.
    """
    from scipy.optimize import linear_sum_assignment

    result = torch.zeros_like(modes)
    for lane in range(modes.shape[1]):
        w = natural[:, lane]
        elastic = torch.nonzero(w.isfinite() & (w > _ZERO * w.nan_to_num(posinf=0.0).max()))[:, 0]
        upper = torch.nonzero(s[:, lane].imag > SWINGS * s[:, lane].abs())[:, 0]
        upper = upper[torch.argsort(s[upper, lane].abs(), stable=True)]
        distance = (s[upper, lane].abs().log() - w[elastic, None].log()).square()
        rows, columns = linear_sum_assignment(distance.numpy())
        pole = dict(
            zip(elastic[torch.from_numpy(rows)].tolist(), upper[torch.from_numpy(columns)].tolist(), strict=True)
        )
        for k, mode in enumerate(modes[:, lane].tolist()):
            if mode not in pole:
                raise DesignFailure(
                    "damping",
                    allowed="must have less damping",
                    noun=f"mode {mode + 1} of the model, {float(w[mode]) / (2.0 * math.pi):.4g} Hz,",
                    state="does not oscillate, because its poles are real",
                )
            result[k, lane] = pole[mode]
    return result


def _assigned(mac: np.ndarray) -> dict[int, int]:
    """Measured mode -> mode of the model, by the largest sum of MAC."""
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(-mac)
    return dict(zip(rows.tolist(), columns.tolist(), strict=True))


def _velocity(sensor: Any) -> Velocity:
    """The velocity of a point whose position or displacement a sensor shows: of a mode its component there."""
    if not isinstance(sensor, Position):
        raise InputError(
            "sensors",
            allowed="must contain positions, such as mbd.Position('arm', 'z', node='right')",
            state=f"has {sensor!r}",
        )
    seen_from = sensor.observer if isinstance(sensor, Displacement) else sensor.seen_from
    return Velocity(sensor.body, sensor.axis, sensor.node, sensor.point, seen_from, sensor.axes)


def _numbers(x: Any) -> np.ndarray:
    """Numbers as float64; one that is none, which no shape allows, for anything else."""
    try:
        return np.asarray(x, dtype=float)
    except (TypeError, ValueError):
        return np.array(np.nan)


def _positive(what: str, numbers: Any, unit: str) -> np.ndarray:
    values = _numbers(numbers)
    if values.ndim != 1 or not len(values) or not (values > 0.0).all() or not np.isfinite(values).all():
        raise InputError(str(what), numbers, f"positive numbers{unit}, at least one")
    return values
