"""The largest response to a harmonic input over a band of frequencies, differentiable.

    d max |G| = Re(conj(G) dG) / |G|                 at the frequency of the largest, which need not move to first order

G and dG are those of frequency_response.py, here at a frequency that each design has of its own.
Between the samples at which peaks are looked for G hardly changes its form: their distance is STEP of that to the nearest pole.
A peak is the zero of d|G|^2/dw between two of them. If the largest is at an end of the band the derivative is that at this
frequency, held.
At a peak stiffness and inertia cancel and damping is left: of beams that are 1e9 times stiffer along than across, with a
damping ratio of 1e-4, magnitudes have three digits.
Source: J. M. Danskin, SIAM J. Appl. Math. 14 (1966) 641-664 (derivative of a largest value).
Checked in tests/extensions/vibrations/measures/test_frequency_response.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import scipy.optimize
import torch
from torch import Tensor

from torchmbd.errors import DesignFailure
from torchmbd.extensions.vibrations.frequency_response import Responses, arguments_of
from torchmbd.extensions.vibrations.linear_system import link_of_ports
from torchmbd.extensions.vibrations.port_functions import PortFunctions, Ports
from torchmbd.extensions.vibrations.spectrum import Spectrum
from torchmbd.extensions.vibrations.steady_states import SteadyStates
from torchmbd.math.gradients import all_true, is_differentiated
from torchmbd.multibody.equilibrium.linearized import Linearization

STEP = 0.25  # between samples, of the distance to the nearest pole: between two of them a pole's part of G changes by a quarter
UNDAMPED = 1e-9  # distance of a pole to the imaginary axis, of its size, at which the response is infinite
_ROOT = 1e-15  # relative accuracy of the frequency of a peak
_LOW = 0.25  # of the largest |G|^2 of the samples: lower peaks between samples are not the largest

PEAK, LOWER, UPPER = "peak", "lower end of the band", "upper end of the band"


class Largest(NamedTuple):
    """magnitude [lanes], differentiable; frequency [lanes] [rad/s]; and where each is: a peak or an end of the band."""

    magnitude: Tensor
    frequency: Tensor
    where: list[str]


def largest_response(states: SteadyStates, ports: Ports, row: int, order: int, band: tuple[float, float]) -> Largest:
    """The largest magnitude of an output over a band [rad/s], about states of a system with ports at one speed.

    ports   of one input; row: the output among those of the ports; order: 1, 2 for its first, second rate
    """
    dynamics, t = states.dynamics, states.t
    functions = PortFunctions(dynamics.topology, t, ports, link_of_ports(dynamics).read[row][None])
    parts = arguments_of(dynamics, t, states.rotation)
    problem = _LargestResponses(**parts, functions=functions, roots=torch.empty(0), order=order, band=band)
    [G] = problem.of(states.q, dynamics)
    if is_differentiated(G) and not all_true(G != 0.0):
        raise DesignFailure(
            "output",
            allowed="an output that the input moves",
            state="does not respond to the input, and a response of zero has no derivative",
            hint="torch.no_grad(), if the value is enough",
        )
    frequency = torch.tensor([w for w, _ in problem.points], dtype=torch.float64)
    return Largest(G.abs(), frequency, [where for _, where in problem.points])


@dataclass(eq=False, kw_only=True)
class _LargestResponses(Responses):
    """Of each design at the frequency of its largest response.

    points   frequency [rad/s] of each design, and where in the band it is
    """

    band: tuple[float, float]
    points: list[tuple[float, str]] = field(default_factory=list, init=False)

    def _roots(self, rest: Linearization, f: Tensor, c: Tensor, rates: Tensor) -> Tensor:
        M, C, K = rest.inertia, rest.reduced(rest.C), rest.stiffness
        response = _Response(M, C, K, rest.N.T @ f[:, 0], rest.N.T @ c[0], rest.N.T @ rates[0], self.order)
        self.points.append(_largest(response, Spectrum.poles(rest).values, self.band))
        return torch.tensor([1j * self.points[-1][0]], dtype=torch.complex128)


@dataclass(frozen=True)
class _Response:
    """G of one design: M, C, K [n, n], F, and the output c by increments and c1 by rates [n], of the degrees of freedom."""

    M: Tensor
    C: Tensor
    K: Tensor
    F: Tensor
    c: Tensor
    c1: Tensor
    order: int

    def squared(self, w: float) -> tuple[float, float]:
        """|G|^2 and its derivative with respect to w."""
        P, c = self._dynamic_stiffness(w), self.c + 1j * w * self.c1
        x = torch.linalg.solve(P, self.F.to(P.dtype))
        slope = -torch.linalg.solve(P, (1j * self.C - 2.0 * w * self.M) @ x)
        G, dG = complex(c @ x), complex(c @ slope + 1j * (self.c1.to(x.dtype) @ x))
        f, k = 1j * w, self.order
        G, dG = f**k * G, f**k * dG + (k * 1j * f ** (k - 1) * G if k else 0.0)
        return abs(G) ** 2, 2.0 * (G.conjugate() * dG).real

    def _dynamic_stiffness(self, w: float) -> Tensor:
        return self.K + 1j * w * self.C - w * w * self.M


def _largest(response: _Response, poles: Tensor, band: tuple[float, float]) -> tuple[float, str]:
    """The frequency of the largest |G| in the band [rad/s], and where it is."""
    w = _samples(poles, band)
    squares, slopes = zip(*(response.squared(x) for x in w), strict=True)
    candidates = [(squares[0], w[0], LOWER), (squares[-1], w[-1], UPPER)]
    enough = _LOW * max(squares)
    for i in range(len(w) - 1):
        if slopes[i] > 0.0 > slopes[i + 1] and max(squares[i : i + 2]) >= enough:
            x = _root(lambda x: response.squared(x)[1], w[i], w[i + 1])
            candidates.append((response.squared(x)[0], x, PEAK))
    _, x, where = max(candidates)
    return x, where


def _root(f: Callable[[float], float], low: float, high: float) -> float:
    return float(scipy.optimize.brentq(f, low, high, xtol=_ROOT * high, rtol=_ROOT))  # pyright: ignore[reportArgumentType]


def _samples(poles: Tensor, band: tuple[float, float]) -> list[float]:
    """Frequencies [rad/s] of the band, with steps of STEP of the distance to the nearest pole; the ends if nothing can move."""
    (w, high), points = band, []
    while len(poles) and w < high:
        distance = (1j * w - poles).abs()
        nearest = int(distance.argmin())
        if float(distance[nearest]) <= UNDAMPED * max(w, float(poles[nearest].abs())):
            raise DesignFailure(
                "band",
                band,
                "finite",
                noun="the response",
                state=f"is infinite, because a vibration of {w:.6g} rad/s in the band has no damping",
                hint="damping, or a band without this vibration",
            )
        points.append(w)
        w += STEP * float(distance[nearest])
    return [*(points or [w]), high]
