"""Vibrations of a machine over speeds of rotation, each followed by its shape: the numbers of a Campbell diagram.

Vibrations are poles that oscillate at the first speed, the slowest first. From speed to speed those pairs go together whose
likeness (likeness.py) has the largest sum, among poles of either sign of the imaginary part: seen by a turning observer a whirl
may pass through zero, and turns the other way behind it. So a vibration keeps its number where it crosses another. Where two
veer the shapes exchange gradually: numbers follow the curves by small steps, and shapes by steps across the veering. A
vibration whose likeness falls below LOST is nan from there on, and the status says so: steps between speeds are too large, or
it has become a part of several.
The order m of a vibration and its frequency in axes of a fixed observer tell which way it whirls (whirl.py).
Checked in tests/extensions/vibrations/test_campbell_diagram.py.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import scipy.optimize
import torch
from jaxtyping import Complex, Float, Int
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.extensions.vibrations.eigenvalues import POLES
from torchmbd.extensions.vibrations.likeness import Shapes
from torchmbd.extensions.vibrations.spectrum import SWINGS, Spectrum
from torchmbd.extensions.vibrations.steady_states import Shaft, SteadyStates, steady_states
from torchmbd.extensions.vibrations.whirl import Whirl
from torchmbd.math.checked_numbers import is_whole
from torchmbd.math.module_call import outside_transforms
from torchmbd.multibody.equilibrium.equilibrium import SPIN
from torchmbd.multibody.equilibrium.linearized import Linearization
from torchmbd.multibody.equilibrium.steady_rotation import TURNING
from torchmbd.multibody.system import System
from torchmbd.summary import Summary

TIE = 1e-2  # of MAC, that decides between shapes alike: a pole and its conjugate at rest
_EQUAL = 1e-6  # share of a pole: poles that differ by less are equal but for rounding
_SHOWN = 12  # vibrations that a summary lists
LOST = 0.4  # MAC; at equal frequencies the shapes of a round shaft at rest and in rotation have 0.5


@dataclass(frozen=True, eq=False, repr=False)
class CampbellDiagram(Summary):
    """The result of `campbell`, for each design and speed; nan where a vibration is lost.

    speeds          [k] [rad/s]
    frequencies     |Im s| / (2 pi) [designs, k, n] [Hz]
    damping_ratios  -Re s / |s| [designs, k, n] [-], negative where the vibration grows
    poles           s [designs, k, n] [1/s]
    status          of each design "ok", or which vibrations are lost
    whirl           [designs, k, n]: 1 forward (with the rotation), -1 backward, 0 for other vibrations: at rest, along the
                    axis, in torsion, or with forward and backward parts, as with anisotropic bearings and blades

    >>> drawn = mbd.vibrations.campbell(mbd.examples.pendulum(), [0.0], modes=1)
    >>> drawn.status, round(drawn.frequencies.item(), 3)
    (['ok'], 0.498)
    """

    speeds: Float[Tensor, " k"]
    frequencies: Float[Tensor, "designs k n"]
    damping_ratios: Float[Tensor, "designs k n"]
    poles: Complex[Tensor, "designs k n"]
    status: list[str]
    whirl: Int[Tensor, "designs k n"]

    def _summary(self) -> list[tuple[str, str]]:
        designs, count, n = self.frequencies.shape
        speeds, f = self.speeds.tolist(), self.frequencies.detach()
        rows = [("status", "; ".join(self.status)), ("speeds", f"{count}, {speeds[0]:.4g} to {speeds[-1]:.4g} rad/s")]
        rows += [("designs", f"{designs}; the frequencies of the first one follow")] if designs > 1 else []
        shown = range(min(n, _SHOWN))
        rows += [(f"vibration {i + 1}", f"{float(f[0, 0, i]):.4g} to {float(f[0, -1, i]):.4g} Hz") for i in shown]
        more = (
            f"frequencies, damping_ratios, poles, whirl: tensors [designs, speeds, vibrations] = {[designs, count, n]}"
        )
        return [*rows, ("numbers", more)]


def campbell(
    system: System,
    speeds: Sequence[float] | Tensor,
    axis: str | Sequence[float] = "z",
    center: Sequence[float] | Tensor = (0.0, 0.0, 0.0),
    observer: str = TURNING,
    designs: Mapping[str, Tensor] | None = None,
    modes: int = 6,
) -> CampbellDiagram:
    """Vibrations of a machine that rotates as a whole, over speeds; differentiable like equilibria.

    system           the model; drives that rotate the whole machine get each of the speeds, whatever their laws
    speeds           rising [k] [rad/s]
    axis, center     of the rotation: "x", "y", "z" or a vector, and a point [m]
    observer         "turning" with the machine, or in the "ground", as in `equilibrium`
    designs          as in `simulate`
    modes            number of vibrations, from the lowest at the first speed; fewer if the system has fewer

    Raises InputError if a speed has no steady state.

    >>> mass = mbd.RigidBody("mass", 2.0, (1.0, 1.0, 1.0))
    >>> hold = mbd.Bushing(mbd.Ground().at(), mass.at(), (200.0,) * 3, (2.0,) * 3)
    >>> drawn = mbd.vibrations.campbell(mbd.System([mass], forces=[hold]), [0.0, 3.0, 6.0], observer="ground", modes=3)
    >>> [round(f, 2) for f in drawn.frequencies[0, :, 0].tolist()]  # sqrt(k / m) / (2 pi), seen from the ground
    [1.59, 1.59, 1.59]
    """
    if not isinstance(system, System):
        raise InputError("system", system, "a System")
    if not is_whole(modes) or modes < 1:
        raise InputError("modes", modes, "1, 2, ...")
    shaft = Shaft(axis, center, observer)
    states = steady_states(system, speeds, shaft, designs)
    follower = _Follower(
        outside_transforms(Tensor.tolist, _speeds(states, shaft)), modes, _Senses(system, states, shaft)
    )
    s = states.eigenvalues(POLES, follower)
    numbers = follower.numbers
    place = torch.searchsorted(follower.chosen, numbers.clamp_min(0).contiguous())
    s = s.gather(-1, place) if len(follower.chosen) else place.to(s.dtype)
    none = torch.complex(*(torch.full(s.shape, torch.nan, dtype=torch.float64) for _ in range(2)))
    s = torch.where(numbers >= 0, s, none)
    frequencies, damping_ratios = s.imag.abs() / (2.0 * math.pi), -s.real / s.abs()
    return CampbellDiagram(_speeds(states, shaft), frequencies, damping_ratios, s, follower.status, follower.whirl)


def _ordered(first: Tensor, last: Tensor, lost: Mapping[int, int]) -> list[int]:
    """Vibrations with equal poles `first` [n] at the first speed, as of a round shaft at rest, in the order of their
    frequencies at the `last` one [n]: rounding decides their order in the spectrum. Those that are lost come after others."""
    near = (first[1:] - first[:-1]).abs() <= _EQUAL * first[1:].abs()
    group = torch.cat([near.new_zeros(1), ~near])[: len(first)].cumsum(0).tolist()
    return sorted(range(len(first)), key=lambda i: (group[i], i in lost, float(last[i])))


def _speeds(states: SteadyStates, shaft: Shaft) -> Tensor:
    """Speeds [k] [rad/s]."""
    return (states.dynamics.data[SPIN][:, 0, : states.speeds] * shaft.direction[:, None]).sum(0)


class _Senses:
    """The sense in which the vibrations of a lane whirl."""

    def __init__(self, system: System, states: SteadyStates, shaft: Shaft):
        self.q, self.count, self.turns = states.q.detach(), states.speeds, shaft.observer == TURNING
        self.sizes = states.sizes
        designs = self.q.shape[-1] // states.speeds
        modes = [{name: x[i if len(x) > 1 else 0].detach() for name, x in states.modes.items()} for i in range(designs)]
        self.whirls = [Whirl(system, states.dynamics.topology, each, shaft) for each in modes]

    def __call__(self, lane: int, spectrum: Spectrum, speed: float) -> Tensor:
        """1, -1 or 0 of each pole [k], as in `CampbellDiagram`."""
        m = self.whirls[lane // self.count].orders(spectrum, self.q[:, 0, lane], self.sizes[lane])
        seen = spectrum.values.imag + (m * speed if self.turns else 0.0)
        return (seen * m * speed).nan_to_num(0.0).sign().long()


class _Follower:
    """A `Choice` of the vibrations of designs at rising speeds, lanes as in SteadyStates.

    numbers  of the poles [designs, speeds, n], -1 where a vibration is lost
    chosen   all of these numbers, ascending
    status   of each design
    whirl    of these poles [designs, speeds, n]
    """

    def __init__(self, speeds: list[float], modes: int, senses: _Senses):
        self.speeds, self.modes, self.senses = speeds, modes, senses
        self.whirl = torch.zeros(0, 0, 0, dtype=torch.long)
        self.numbers = self.chosen = torch.zeros(0, 0, 0, dtype=torch.long)
        self.status: list[str] = []

    def __call__(self, spectra: Sequence[Spectrum], states: Sequence[Linearization]) -> list[int]:
        shapes = [Shapes.of(x, rest) for x, rest in zip(spectra, states, strict=True)]
        count = len(self.speeds)
        followed = [self._of_design(shapes[k : k + count]) for k in range(0, len(shapes), count)]
        n = min(numbers.shape[1] for numbers, _ in followed)
        self.numbers = torch.stack([numbers[:, :n] for numbers, _ in followed])
        self.chosen = self.numbers[self.numbers >= 0].unique()
        self.status = [self._status(lost) for _, lost in followed]
        senses = [self.senses(k, x, self.speeds[k % count]) for k, x in enumerate(spectra)]
        pairs = zip(senses, self.numbers.flatten(0, 1), strict=True)
        whirl = torch.stack([torch.where(at >= 0, sense[at.clamp_min(0)], 0) for sense, at in pairs])
        self.whirl = whirl.unflatten(0, (-1, count))
        return self.chosen.tolist()

    def _of_design(self, states: Sequence[Shapes]) -> tuple[Tensor, dict[int, int]]:
        """Numbers [speeds, n], and from which speed on a vibration is lost."""
        here = states[0]
        chosen = (here.poles.imag > SWINGS * here.poles.abs()).nonzero()[: self.modes, 0]
        path, lost = [chosen], {}
        for k, there in enumerate(states[1:], 1):
            poles, shapes = here.poles[chosen], here.shapes[:, chosen]
            likeness = there.likeness(shapes)
            far = (there.poles - poles[:, None]).abs() / (there.poles.abs() + poles[:, None].abs())
            _, columns = scipy.optimize.linear_sum_assignment((likeness - TIE * far).numpy(), maximize=True)
            here, chosen = there, torch.from_numpy(columns)
            for i in (likeness.gather(1, chosen[:, None])[:, 0] < LOST).nonzero()[:, 0].tolist():
                lost.setdefault(i, k)
            path.append(torch.tensor([-1 if i in lost else n for i, n in enumerate(chosen.tolist())], dtype=torch.long))
        order = _ordered(states[0].poles[path[0]], here.poles[chosen].imag.abs(), lost)
        return torch.stack(path)[:, order], {order.index(i): k for i, k in lost.items()}

    def _status(self, lost: dict[int, int]) -> str:
        gone = ", ".join(f"vibration {i + 1} from {self.speeds[k]:.4g} rad/s on" for i, k in lost.items())
        return f"lost: {gone}: no shape is like it. Try: smaller steps between speeds" if lost else "ok"
