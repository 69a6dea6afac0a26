"""The largest response to a harmonic input over a band of frequencies, differentiable: an `Integration` of `Motion`.

    G(w) = (i w)^k c' P(s)^-1 F,  s = i w            F: forces of a unit input; c: the output by increments x and their rates
    d max |G| = Re(conj(G) dG) / |G|                 at the frequency of the largest, which need not move to first order
    dG / (i w)^k = dc' x + l^H (dF - dP x)           P x = F,  P^H l = c

Between the samples at which peaks are looked for G hardly changes its form: their distance is STEP of that to the nearest pole.
A peak is the zero of d|G|^2/dw between two of them. If the largest is at an end of the band the derivative is that at this
frequency, held.
At a peak stiffness and inertia cancel and damping is left: of beams that are 1e9 times stiffer along than across, with a
damping ratio of 1e-4, magnitudes have three digits.
Source: J. M. Danskin, SIAM J. Appl. Math. 14 (1966) 641-664 (derivative of a largest value).
Checked in tests/design/test_frequency_response.py.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import scipy.optimize
import torch
from torch import Tensor

from torchmbd.errors import DesignFailure
from torchmbd.integrate.motion import Motion, Tensors
from torchmbd.integrate.pullback import leaf
from torchmbd.multibody.system import Dynamics
from torchmbd.multibody.system.equilibrium import SPIN
from torchmbd.multibody.system.linearized import Linearization
from torchmbd.multibody.system.rank import RELATIVE
from torchmbd.multibody.system.steady_rotation import Observer, SteadyRotation
from torchmbd.vibrations.inner_products import Vectors, inner, inner_products, real_and_imaginary
from torchmbd.vibrations.linear_system import Ports, link_of_ports
from torchmbd.vibrations.port_functions import PortFunctions
from torchmbd.vibrations.spectrum import Spectrum
from torchmbd.vibrations.steady_states import SteadyStates

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
    dynamics = states.dynamics
    model, names = replace(dynamics, data={}), tuple(dynamics.data)
    problem = _Harmonic(model, names, states.t, states.rotation, ports, row, order, band)
    outputs: Any = Motion.apply(problem, states.q, *dynamics.data.values())
    w = torch.tensor([x.frequency for x in problem.points], dtype=torch.float64)
    return Largest(outputs[0][0, 0], w, [x.where for x in problem.points])


class _Point(NamedTuple):
    """The largest response of one design: x solves P x = F, w solves P' w = c, both of the freedoms."""

    frequency: float
    where: str
    G: complex
    right: Tensor
    left: Tensor


@dataclass(eq=False)
class _Harmonic:
    """`Integration`; inputs are q and the data, the output is the magnitude [1, 1, lanes]."""

    model: Dynamics
    names: tuple[str, ...]
    t: Tensor
    rotation: SteadyRotation
    ports: Ports
    row: int
    order: int
    band: tuple[float, float]
    inputs: list[Tensor] = field(default_factory=list, init=False)
    states: list[Linearization] = field(default_factory=list, init=False)
    points: list[_Point] = field(default_factory=list, init=False)

    def values(self, inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
        lanes = max(x.shape[-1] for x in inputs)
        self.inputs = [x.expand(*x.shape[:-1], lanes) for x in inputs]
        q, data, observer = self._split(self.inputs)
        self.states = Linearization.each(replace(self.model, data=data), q, self.t, None, observer)
        by_x, by_xd = (x[0] for x in self._functions.output_rows(q, data, observer))
        forces = self._functions.forces(q, data, observer)[:, 0]
        for lane, rest in enumerate(self.states):
            active, N = rest.active, rest.N
            F, c, c1 = (N.T @ x[active, lane] for x in (forces, by_x, by_xd))
            response = _Response(rest.inertia, rest.reduced(rest.C), rest.stiffness, F, c, c1, self.order)
            w, where = _largest(response, Spectrum.poles(rest).values, self.band)
            self.points.append(response.point(w, where))
        factor = torch.tensor([x.frequency**self.order for x in self.points], dtype=torch.float64)
        sizes = torch.tensor([abs(x.G) for x in self.points], dtype=torch.float64)
        return ((factor * sizes)[None, None],)

    def tangents(self, directions: Tensors) -> list[Tensor]:
        count = max(x.shape[-2] for x in directions if x is not None)
        total = torch.zeros(count, len(self.points), dtype=torch.float64)
        for g, x in zip(self._gradients(), directions, strict=True):
            if g is not None and x is not None:
                total = total + (g * x).flatten(0, -3).sum(0)
        return [total[None]]

    def cotangents(self, outputs: Tensors, needs_grad: Sequence[bool]) -> list[Tensor | None]:
        [bar] = outputs
        assert bar is not None
        return [g * bar if g is not None and y else None for g, y in zip(self._gradients(), needs_grad, strict=True)]

    def _split(self, inputs: Sequence[Tensor]) -> tuple[Tensor, dict[str, Tensor], Observer]:
        data = dict(zip(self.names, inputs[1:], strict=True))
        return inputs[0], data, self.rotation.of_spin(data[SPIN])

    def _gradients(self) -> Sequence[Tensor | None]:
        """Gradients of the magnitudes by the inputs [..., 1, lanes]."""
        if zero := [x.frequency for x in self.points if not x.G]:
            raise DesignFailure(
                f"a response that is zero, at {zero[0]:.6g} rad/s, has no derivative; allowed: an output that the input moves"
            )
        leaves = [leaf(x) for x in self.inputs]
        q, data, observer = self._split(leaves)
        s = torch.tensor([1j * x.frequency for x in self.points], dtype=torch.complex128)[None, None]
        plain = self._split(self.inputs)
        c, c1 = (x[0][:, None] for x in self._functions.output_rows(*plain))
        vectors = self._vectors(s, self._functions.forces(*plain), c + s * c1)
        with torch.enable_grad():
            products = inner_products(self.model.topology, data, q, self.t, observer, self.states, s, vectors)
            x, xd = (real_and_imaginary(s**k * vectors.right) for k in range(2))
            output = self._functions.outputs(q, data, observer, x, xd).unbind(1)
            F = self._functions.forces(q, data, observer)
            work = inner(vectors.left, torch.cat([F, torch.zeros_like(F)], 1))
            G = torch.tensor([x.G for x in self.points], dtype=torch.complex128)
            unit = self._factor() * G / G.abs()
            parts = [y + f - p for y, f, p in zip(output, work, products, strict=True)]
            total = (unit.real * parts[0] + unit.imag * parts[1]).sum()
        return torch.autograd.grad(total, leaves, allow_unused=True)

    def _factor(self) -> Tensor:
        """|i w|^k [lanes]."""
        return torch.tensor([x.frequency**self.order for x in self.points], dtype=torch.float64)

    def _vectors(self, s: Tensor, forces: Tensor, c: Tensor) -> Vectors:
        """The vectors of all lanes with their multipliers; forces, c [n_v, 1, lanes]."""
        columns = []
        for lane, (point, rest) in enumerate(zip(self.points, self.states, strict=True)):
            active, z = rest.active, s[0, 0, lane]
            full = torch.zeros(len(rest.forces), 2, dtype=torch.complex128)
            full[active] = rest.N.to(full.dtype) @ torch.stack([point.right, point.left.conj()], 1)
            M, C, K = (x[active][:, active].to(full.dtype) for x in (rest.M, rest.C, rest.K))
            P = z * z * M + z * C + K
            back = torch.linalg.pinv(rest.Phi_q[:, active].T, rtol=RELATIVE).to(full.dtype)
            force = back @ (forces[active, 0, lane] - P @ full[active, 0])
            slip = back @ (c[active, 0, lane].conj() - P.mH @ full[active, 1])
            columns.append(Vectors(full[:, 1], slip, full[:, 0], force))
        return Vectors(*(torch.stack(x, -1)[:, None] for x in zip(*columns, strict=True)))

    @property
    def _functions(self) -> PortFunctions:
        T = self.model.topology
        return PortFunctions(T, self.t, self.ports, link_of_ports(self.model).read[self.row][None])


@dataclass(frozen=True)
class _Response:
    """G of one design: M, C, K [n, n], F, and the output c by increments and c1 by rates [n], of the freedoms."""

    M: Tensor
    C: Tensor
    K: Tensor
    F: Tensor
    c: Tensor
    c1: Tensor
    order: int

    def point(self, w: float, where: str) -> _Point:
        """G without the factor (i w)^order."""
        P, c = self._dynamic_stiffness(w), self.c + 1j * w * self.c1
        right = torch.linalg.solve(P, self.F.to(P.dtype))
        return _Point(w, where, complex(c @ right), right, torch.linalg.solve(P.T, c))

    def squared(self, w: float) -> tuple[float, float]:
        """|G|^2 and its derivative by w."""
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
    """Frequencies [rad/s] of the band, with steps of STEP of the distance to the nearest pole."""
    (w, high), points = band, []
    while w < high:
        distance = (1j * w - poles).abs()
        nearest = int(distance.argmin())
        if float(distance[nearest]) <= UNDAMPED * max(w, float(poles[nearest].abs())):
            raise DesignFailure(
                f"the response is infinite: a vibration of {w:.6g} rad/s in the band has no damping; allowed: damping, or a "
                "band without it"
            )
        points.append(w)
        w += STEP * float(distance[nearest])
    return [*points, high]
