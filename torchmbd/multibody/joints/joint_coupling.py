"""Coupling of joints: a linear relation between their angles and travels. One equation.

    c_1 x_1 + c_2 x_2 (+ c_3 x_3) = d

    gear, belt          radius_1 angle_1 + radius_2 angle_2 = 0, with the other sign for a belt or an internal gear
    rack and pinion     radius angle - travel = 0
    screw               lead / (2 pi) angle - travel = 0; both of one cylindrical joint, or of two joints
    differential        angle_1 + angle_2 - 2 angle_3 = 0

Angles and travels are measured from the given initial positions and count full turns. With the multiplier lam of the
equation, joint i has the generalized force -c_i lam: a torque about its axis [N m], or a force along it [N].
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from torch import Tensor, nn

from torchmbd.errors import InputError
from torchmbd.math.variable import ParameterVector, is_variable, number
from torchmbd.multibody.bodies.frame import Frame
from torchmbd.multibody.joints.joint import AttachmentTable, Equation, Joint, JointCoordinate
from torchmbd.multibody.joints.laws import finite
from torchmbd.multibody.joints.relation import RELATIONS, Factors

MOST = 3  # coordinates


class JointCoupling(Joint):
    """`JointCoupling([first.angle, second.angle], [ratio, -1.0])`: sum of factors times coordinates = offset. One equation.

    coordinates  two or three: `angle` of a Revolute or Cylindrical [rad], `travel` of a Prismatic or Cylindrical [m]; each is
                 the motion of the joint's second body relative to its first one
    factors      one for each coordinate, not zero; their units give all products the same unit
    offset       the constant sum of the products, in their unit; if it is not zero, `simulate` moves the joints at the start
    name         of the coupling, and of its design variables and reactions; None: made of the first joint's bodies

    Factors and offset may be design variables, parameters "NAME.factor1", "NAME.offset" of the system. The joints must be
    joints of the system. Raises InputError for other coordinates or numbers.

    >>> ground = mbd.Ground()
    >>> wheels = [mbd.RigidBody(name, 1.0, (0.01, 0.01, 0.02)) for name in ("small", "large")]
    >>> small, large = [mbd.Revolute(ground.at(x, 0, 0), wheel.at(x, 0, 0)) for x, wheel in zip((0.0, 0.3), wheels)]
    >>> gear = mbd.JointCoupling([small.angle, large.angle], [0.1, 0.2], name="gear")  # radii: they turn in opposite senses
    >>> mbd.System(wheels, [small, large, gear]).describe().freedoms
    1
    """

    def __init__(
        self,
        coordinates: Sequence[JointCoordinate],
        factors: Sequence[float | Tensor],
        offset: float | Tensor = 0.0,
        name: str | None = None,
    ):
        coordinates, factors = (_listed(key, x) for key, x in (("coordinates", coordinates), ("factors", factors)))
        for k, x in enumerate(coordinates):
            if not isinstance(x, JointCoordinate):
                raise InputError(
                    ("coordinates", k),
                    x,
                    "the angle or the travel of a joint",
                    hint="hinge.angle, slide.travel",
                    noun=f"coordinates[{k}]",
                )
        if not 2 <= len(coordinates) <= MOST or len(set(coordinates)) < len(coordinates):
            raise InputError(
                "coordinates",
                coordinates,
                "two or three different coordinates",
                hint="several couplings for more",
                shown=f"{coordinates}",
            )
        if len(factors) != len(coordinates):
            raise InputError(
                "factors", factors, f"{len(coordinates)} numbers, one for each coordinate", shown=f"{factors}"
            )
        first = coordinates[0].joint
        super().__init__(first.a, first.b, name)
        labels = [*(f"factor{k + 1}" for k in range(len(factors))), "offset"]
        values = [finite((self.name, label), x) for label, x in zip(labels, [*factors, offset], strict=True)]
        for label, x in zip(labels[:-1], values, strict=False):
            if number(x) == 0.0:
                raise InputError((self.name, label), 0, "must not be zero", hint="coordinates without this one")
        self.coordinates = tuple(coordinates)
        self._set_numbers(labels, values)

    def _set_numbers(self, labels: list[str], values: list[Any]) -> None:
        variables = nn.ParameterDict()
        rows: list[int | None] = []
        for label, x in zip(labels, values, strict=True):
            if not is_variable(x):
                rows.append(None)
                continue
            same = [row for row, known in enumerate(variables.values()) if known is x]
            rows.append(same[0] if same else len(variables))
            if not same:
                variables[label] = x
        self._variables = ParameterVector.of(variables)
        self._numbers, self._rows = [number(x) for x in values], rows

    @property
    def joints(self) -> tuple[Joint, ...]:
        """The coupled joints, each once."""
        return tuple(dict.fromkeys(x.joint for x in self.coordinates))

    @property
    def frames(self) -> tuple[Frame, ...]:
        """Both frames of each joint."""
        return tuple(frame for joint in self.joints for frame in (joint.a, joint.b))

    @property
    def variables(self) -> ParameterVector | None:
        return self._variables

    def equations(self, attachments: AttachmentTable) -> Iterator[Equation]:
        order = sorted(range(len(self.coordinates)), key=lambda k: not self.coordinates[k].turns)  # angles come first
        labels = [*order, len(order)]  # the sum is last
        factors = Factors(
            self.name,
            tuple(self._numbers[k] for k in labels),
            tuple(self._rows[k] for k in labels),
            self._variables,
        )
        angles = sum(x.turns for x in self.coordinates)
        vectors = tuple(i for k in order for i in self.coordinates[k].vectors(attachments))
        yield Equation(RELATIONS[angles, len(order) - angles], vectors, factors)

    def __repr__(self) -> str:
        terms = " + ".join(f"{c:g} {x}" for c, x in zip(self._numbers, self.coordinates, strict=False))
        return f"{type(self).__name__}({terms} = {self._numbers[-1]:g})"


def _listed(key: str, x: Any) -> list:
    if isinstance(x, str) or not isinstance(x, Sequence):
        raise InputError(key, x, "a list")
    return list(x)
