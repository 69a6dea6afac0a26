"""Linear relations between angles and travels of joints: gears, belts, racks, screws, differentials. One equation.

    c_1 x_1 + c_2 x_2 (+ c_3 x_3) = d

    x    angle [rad] as in `Angle`, or travel [m] as in `Travel`, from the given initial positions
    c    factors, d their sum: numbers, or design variables

Angles count full turns: x is the angle within half a turn of that of the rigid bodies, which is a coordinate of the motion
(multibody/equations/turns.py). An angle x_i of lam has the torque lam c_i about its axis, a travel the force lam c_i along it.
Checked in tests/contracts/test_primitives.py, tests/multibody/joints/test_joint_coupling.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchmbd.math.elementwise import reciprocal, sqrt
from torchmbd.math.jet import Jet, angle_near, dot
from torchmbd.math.pair import cat, linear, value
from torchmbd.math.variable import ParameterVector, law_key
from torchmbd.multibody.joints.primitive import Primitive, required, row


@dataclass(frozen=True)
class Factors:
    """Factors of the coordinates of a relation and then its sum d; some are rows of the data of the joint `name`.

    numbers    present values; rows: the row of each in `variables`, or None
    """

    name: str
    numbers: tuple[float, ...]
    rows: tuple[int | None, ...]
    variables: ParameterVector | None

    def of(self, data: Mapping[str, Any] | None) -> list[Any]:
        """Each [1, pair, lanes]; without data, design variables have the values of their Parameters."""
        values: Any = None
        if self.variables is not None:
            values = self.variables.flat().detach() if data is None else data[law_key(self.name)]
        numbers = [torch.full((1, 1, 1), x, dtype=torch.float64) for x in self.numbers]
        return [x if row is None else values[row : row + 1] for x, row in zip(numbers, self.rows, strict=True)]


class Relation(Primitive):
    """Angles and travels of joints have a linear relation, sum c_i x_i = d; subclasses state how many of each.

    An angle has the arguments of `Angle`, a travel those of `Travel`; `drive` is (c_1, c_2, ..., d, turns of the angles).
    """

    rows = 1
    word = "relation"

    def __init_subclass__(cls, angles: int, travels: int):
        cls.angles, cls.travels = angles, travels
        cls.arguments = ("axis",) * (3 * angles) + ("point", "point", "axis") * travels
        cls.driven = angles + travels + 1

    @property
    def varies(self) -> bool:
        return any(factors.variables is not None for factors in self.data)

    def prescribed(self, times: Tensor, data: Mapping[str, Any] | None = None) -> tuple:
        n = len(times)
        return tuple(linear(lambda y: y.expand(n, *y.shape), x) for x in self._factors(data))

    def prescribed_jets(self, t: Tensor, data: Mapping[str, Any] | None = None) -> tuple[Jet, ...]:
        return tuple(Jet(x, 0.0 * x, 0.0 * x) for x in self._factors(data))

    def _factors(self, data: Mapping[str, Any] | None) -> list[Any]:
        """Factors and sum [n, pair, lanes]."""
        return [cat(x) for x in zip(*(factors.of(data) for factors in self.data), strict=True)]

    def largest_factors(self, data: Mapping[str, Any]) -> Tensor:
        """Largest |c| of each relation [n], of its travels or, without these, of its angles, in a design of values."""
        factors = torch.stack(self._factors(data)[: self.driven - 1])[self.angles if self.travels else 0 :]
        return factors[..., 0, 0].abs().amax(0)

    def sizes(self, size: Any, data: Mapping[str, Any] | None = None) -> Any:
        factors = self._factors(data)[: self.driven - 1]
        parts = factors[: self.angles] + [size * c for c in factors[self.angles :]]
        squares = [c * c for c in parts]
        return sqrt(sum(squares[1:], squares[0]))

    def _groups(self, vectors: list) -> list[list]:
        """The vectors of each coordinate."""
        return [vectors[3 * i : 3 * i + 3] for i in range(self.angles + self.travels)]

    def phi(self, vectors, drive=None):
        *factors, total = required(drive)[: self.driven]
        turns = required(drive)[self.driven :]
        phi: Any = None
        for i, (first, second, third) in enumerate(self._groups(vectors)):
            if i < self.angles:
                x = angle_near(dot(second, third), dot(first, third), value(turns[i]))
            else:
                x = dot(second - first, third)
            phi = x * factors[i] if phi is None else phi + x * factors[i]
        return row(phi - total)

    def forces(self, vectors, lam, drive=None):
        factors, forces = required(drive)[: self.driven - 1], []
        for i, (first, second, third) in enumerate(self._groups(vectors)):
            pull = lam * factors[i]
            if i < self.angles:
                c, s = dot(first, third), dot(second, third)
                inverse = reciprocal(c * c + s * s)
                c, s = (pull * (part * inverse) for part in (c, s))
                forces += [-(s * third), c * third, c * second - s * first]
            else:
                pull = pull * third
                forces += [-pull, pull, lam * factors[i] * (second - first)]
        return forces


class TwoAngles(Relation, angles=2, travels=0):
    """Of two angles: gears, belts."""


class AngleTravel(Relation, angles=1, travels=1):
    """Of an angle and a travel: rack and pinion, screw."""


class TwoTravels(Relation, angles=0, travels=2):
    """Of two travels: levers, hydraulic cylinders."""


class ThreeAngles(Relation, angles=3, travels=0):
    """Of three angles: differentials, planetary gears."""


class TwoAnglesTravel(Relation, angles=2, travels=1):
    """Of two angles and a travel."""


class AngleTwoTravels(Relation, angles=1, travels=2):
    """Of an angle and two travels: a drum with two ropes."""


class ThreeTravels(Relation, angles=0, travels=3):
    """Of three travels: hoists."""


RELATIONS: dict[tuple[int, int], type[Relation]] = {
    (kind.angles, kind.travels): kind
    for kind in (TwoAngles, AngleTravel, TwoTravels, ThreeAngles, TwoAnglesTravel, AngleTwoTravels, ThreeTravels)
}
