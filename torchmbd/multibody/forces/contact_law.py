"""Laws of contact: a normal force that never pulls, and friction in the plane of contact.

    N = k d^n max(0, 1 + c d')          penetration d > 0, its rate d'; zero where d <= 0
    T = -mu N tanh(|u| / u0) u / |u|    of the velocity u of sliding [2]

With damping c of this kind (Hunt and Crossley) contact begins and ends at zero force, so bodies do not stick to each other.
Without other forces a mass that hits at speed v leaves at speed w, for any mass, k and n:

    c v - ln(1 + c v) = -c w - ln(1 - c w)        e = w / v = 1 - 2/3 c v for small c v

Friction is regularized: below u0 bodies creep instead of sticking.
N has a continuous derivative with respect to d for n > 1; for n = 1 it jumps where bodies touch, and derivatives of a motion
are valid unless a step ends there exactly.
Laws are controls (feedback.py): their numbers may be design variables, and native code calls them back.
Source: Hunt, Crossley, J. Appl. Mech. 42 (1975) 440-445. Checked in tests/multibody/forces/test_contact.py.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torchmbd.errors import InputError
from torchmbd.math.variable import is_variable, number
from torchmbd.multibody.forces.feedback import Control
from torchmbd.multibody.joints.laws import finite

_POSITIVE = ("stiffness", "speed")
_LEAST = {"exponent": 1.0, "damping": 0.0, "friction": 0.0, "radius": 0.0}
_STILL = 1e-9  # share of the speed of friction below which sliding has no direction


class NormalForce(NamedTuple):
    """The normal force N, and its derivatives with respect to penetration and rate of penetration."""

    force: Tensor
    by_depth: Tensor
    by_rate: Tensor


def normal_force(p: Mapping[str, Any], depth: Tensor, rate: Tensor) -> NormalForce:
    """N of penetrations and their rates; p: stiffness, exponent and damping."""
    k, n, c = p["stiffness"], p["exponent"], p["damping"]
    inside = depth > 0.0
    d = torch.where(inside, depth, 1.0)  # powers of zero have no derivative by the exponent
    spring = torch.where(inside, k * d**n, 0.0)
    damping = 1.0 + c * rate
    factor = torch.clamp_min(damping, 0.0)
    by_depth = torch.where(inside, k * n * d ** (n - 1.0), 0.0) * factor
    return NormalForce(spring * factor, by_depth, torch.where(damping > 0.0, spring * c, torch.zeros_like(spring)))


class ContactNumbers(nn.Module):
    """Checked numbers of a law by name; design variables are parameters of the module. owner: name of the element."""

    def __init__(self, owner: str, numbers: Mapping[str, Any]):
        super().__init__()
        self.names = tuple(numbers)
        for name, x in numbers.items():
            x = finite((owner, name), x)
            least = _LEAST.get(name, -math.inf)
            if number(x) < least or (name in _POSITIVE and not number(x) > 0.0):
                allowed = "a positive number" if name in _POSITIVE else f"{least:g} or more"
                raise InputError(
                    (str(owner), name),
                    number(x),
                    f"{allowed}, or mbd.variable(...) of such a number",
                )
            if is_variable(x):
                self.register_parameter(name, x)
            else:
                setattr(self, name, x)

    def forward(self) -> dict[str, Any]:
        """The numbers by name."""
        return {name: getattr(self, name) for name in self.names}


class ContactControl(Control):
    """A law of contact as a controller that is evaluated for all lanes at once.

    what    the bodies that touch, for messages
    count   number of gaps
    """

    def __init__(self, name: str, module: ContactNumbers, inputs: int, outputs: int, what: str, count: int = 1):
        super().__init__(name, module, inputs, outputs)
        self.what, self.count = what, count

    @property
    def label(self) -> str:
        return f"contact {self.name!r}"

    def numbers(self, p: Tensor) -> dict[str, Any]:
        """The numbers of the law by name, with parameters p [k, lanes or 1]; k = 0: those that the module has."""
        numbers = self.module()
        return numbers | self.variables.named(p) if self.variables is not None and len(p) else numbers

    @abstractmethod
    def strengths(self, p: Mapping[str, Any], x: Tensor) -> Tensor:
        """Forces [outputs, lanes] of inputs [inputs, lanes]."""

    @abstractmethod
    def slopes(self, p: Mapping[str, Any], x: Tensor) -> Tensor:
        """Their derivatives with respect to the inputs [outputs, inputs, lanes]."""

    @abstractmethod
    def gaps(self, p: Mapping[str, Any], x: Tensor) -> tuple[Tensor, Tensor]:
        """Distances between the surfaces that may touch, and their rates [gaps, lanes]."""

    def at(self, p: Tensor, x: Tensor, t: Any) -> Tensor:
        numbers = self.numbers(p)
        return x.new_zeros(self.outputs, x.shape[1]) if self._apart(numbers, x) else self.strengths(numbers, x)

    def with_jacobian(self, p: Tensor, x: Tensor, t: Any) -> tuple[Tensor, Tensor]:
        numbers, lanes = self.numbers(p), x.shape[1]
        if self._apart(numbers, x):
            return x.new_zeros(self.outputs, lanes), x.new_zeros(self.outputs, self.inputs, lanes)
        with torch.no_grad():
            slopes = self.slopes(numbers, x)
        return self.strengths(numbers, x), slopes

    def _apart(self, numbers: Mapping[str, Any], x: Tensor) -> bool:
        """True if nothing touches, and derivatives in the numbers are not recorded. The test costs a tenth of the law."""
        recorded = self.variables is not None and torch.is_grad_enabled()
        return not recorded and bool((self.gaps(numbers, x)[0] > 0.0).all())

    def jacobian(self, x: Tensor, t: Any, data: Mapping[str, Any]) -> Tensor:
        return self.slopes(self.numbers(self._parameters(x, data)[:, 0]), x[:, 0]).movedim(-1, 0)

    def _over_lanes(self, t: Any, f: Any = None) -> Any:
        return lambda p, x: self.strengths(self.numbers(p), x)


class StopControl(ContactControl):
    """Contact of one coordinate with its limits: (s, s') -> f. sides: the limits that it has, "lower", "upper"."""

    def __init__(self, name: str, module: ContactNumbers, sides: Sequence[str], what: str):
        super().__init__(name, module, 2, 1, what, len(sides))
        self.sides = tuple(sides)

    def strengths(self, p: Mapping[str, Any], x: Tensor) -> Tensor:
        parts = [sign * normal_force(p, -gap, -rate).force for sign, gap, rate in self._each(p, x)]
        return sum(parts[1:], parts[0])[None]

    def slopes(self, p: Mapping[str, Any], x: Tensor) -> Tensor:
        parts = [normal_force(p, -gap, -rate) for _, gap, rate in self._each(p, x)]
        by = [-sum((y[k] for y in parts[1:]), parts[0][k]) for k in (1, 2)]
        return torch.stack(by)[None]

    def gaps(self, p: Mapping[str, Any], x: Tensor) -> tuple[Tensor, Tensor]:
        _, gaps, rates = zip(*self._each(p, x), strict=True)
        return torch.stack(gaps), torch.stack(rates)

    def _each(self, p: Mapping[str, Any], x: Tensor) -> list[tuple[float, Tensor, Tensor]]:
        """Of each side: the sign of its force, the gap and its rate."""
        signs = {"lower": 1.0, "upper": -1.0}
        return [(signs[side], signs[side] * (x[0] - p[side]), signs[side] * x[1]) for side in self.sides]


class PlaneControl(ContactControl):
    """Contact of a point, or a sphere, with a plane; friction acts at the point of contact.

    inputs    s, s'; with friction velocities of the point along two axes of the plane, of a sphere also the spins about these
    outputs   force along the normal; with friction forces along the axes, of a sphere also torques about them
    """

    def __init__(self, name: str, module: ContactNumbers, has_friction: bool, rolls: bool, what: str):
        super().__init__(name, module, 2 + 2 * has_friction + 2 * rolls, 1 + 2 * has_friction + 2 * rolls, what)
        self.has_friction, self.rolls = has_friction, rolls

    def strengths(self, p: Mapping[str, Any], x: Tensor) -> Tensor:
        force = normal_force(p, p["radius"] - x[0], -x[1]).force
        if not self.has_friction:
            return force[None]
        u = self._sliding(p, x)
        first, second = (-p["friction"] * force * self._share(p, u)[0] * y for y in u)
        torques = [p["radius"] * second, -p["radius"] * first] if self.rolls else []
        return torch.stack([force, first, second, *torques])

    def slopes(self, p: Mapping[str, Any], x: Tensor) -> Tensor:
        contact = normal_force(p, p["radius"] - x[0], -x[1])
        normal = torch.stack([-contact.by_depth, -contact.by_rate])
        if not self.has_friction:
            return normal[None]
        u, r = self._sliding(p, x), p["radius"]
        share, falling = self._share(p, u)
        J = x.new_zeros(self.outputs, self.inputs, x.shape[1])
        J[0, :2] = normal
        for i in range(2):
            J[1 + i, :2] = -p["friction"] * share * u[i] * normal
            for j in range(2):
                same = share if i == j else 0.0
                J[1 + i, 2 + j] = -p["friction"] * contact.force * (same + falling * u[i] * u[j])
        if self.rolls:  # spins and torques are those of sliding and of its forces, by the radius
            J[1:3, 4], J[1:3, 5] = r * J[1:3, 3], -r * J[1:3, 2]
            J[3], J[4] = r * J[2], -r * J[1]
        return J

    def gaps(self, p: Mapping[str, Any], x: Tensor) -> tuple[Tensor, Tensor]:
        return (x[0] - p["radius"])[None], x[1][None]

    def _sliding(self, p: Mapping[str, Any], x: Tensor) -> list[Tensor]:
        """Velocity of the touching material along the two axes."""
        if not self.rolls:
            return [x[2], x[3]]
        return [x[2] - p["radius"] * x[5], x[3] + p["radius"] * x[4]]

    @staticmethod
    def _share(p: Mapping[str, Any], u: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """w = tanh(|u| / u0) / |u|, and (dw/d|u|) / |u|."""
        u0 = p["speed"]
        r = (u[0] * u[0] + u[1] * u[1] + (_STILL * u0) ** 2).sqrt()
        z = r / u0
        flat = torch.tanh(z)
        share = flat / r
        # z sech(z)^2 - tanh(z) is -2/3 z^3 for small z, where the difference is rounding.
        bend = torch.where(z < 1e-3, -(2.0 / 3.0) * z**3, z * (1.0 - flat * flat) - flat)
        return share, bend / (r * r * r)
