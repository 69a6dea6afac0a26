"""The largest response of the whole system to a harmonic force or torque over a band of frequencies.

    FrequencyResponse("tip", "motor", band=(5.0, 40.0), direction="y") <= 1e-3        [m/(N m)]

The input is a unit force on a body, or the unit effort of a motor in a joint; the output is the position of a point of a body,
or the angle or travel of a joint, or its rates. `linearize` has the same inputs and outputs; the states are those of
other measures of vibrations (system_vibrations.py).
Checked in tests/extensions/vibrations/measures/test_frequency_response.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

from torch import Tensor

from torchmbd.errors import one_of
from torchmbd.extensions.vibrations.frequency_response import QUANTITIES
from torchmbd.extensions.vibrations.largest_response import largest_response
from torchmbd.extensions.vibrations.linear_system import system_with_ports
from torchmbd.extensions.vibrations.measures.system_vibrations import OfVibrations, rising
from torchmbd.extensions.vibrations.port_functions import Ports
from torchmbd.extensions.vibrations.ports_by_name import NamedPort, Place
from torchmbd.extensions.vibrations.steady_states import steady_states
from torchmbd.integrate import Trajectory
from torchmbd.math.checked_numbers import nonnegative
from torchmbd.math.module_call import outside_transforms
from torchmbd.multibody.system import System


class ResponsePeak(NamedTuple):
    """The largest response of each design.

    magnitude   [lanes], differentiable
    frequency   [lanes] [Hz], without derivatives
    where       "peak", or the end of the band at which it is: there the response may be larger outside

    >>> motion = mbd.simulate(mbd.examples.pendulum(), 0.01, steps=2)
    >>> above = mbd.vibrations.FrequencyResponse("hinge", "hinge", band=(0.6, 2.0))  # the only vibration is at 0.498 Hz
    >>> above.peak(motion).where
    ['lower end of the band']
    """

    magnitude: Tensor
    frequency: Tensor
    where: list[str]


@dataclass(frozen=True)
class FrequencyResponse(OfVibrations):
    """Largest magnitude [lanes] of a response to a harmonic input of size one over a band of frequencies; use <= as limit.

    output      name of a joint, for its angle [rad] or travel [m]; or name of a body, for the position of a point [m]
    input       name of a joint, in which a motor acts [N m] or [N]; or of a body on which a force acts [N]
    band        (lowest, highest) frequency [Hz]
    direction   of the position: "x", "y", "z" of the ground; None: output is a joint. A direction perpendicular to the axis of
                rotation needs observer="ground", because it rotates for an observer who turns
    place       of the point: a node of a flexible body, or (x, y, z) on a rigid one [m]; None: its origin
    input_direction, input_place   of the force, as for the position
    quantity    "displacement", or its rates "velocity", "acceleration"
    speed       of rotation [rad/s]
    axis, center, observer   of the rotation, as in OfVibrations

    The measure locates the peak exactly, not on a grid. Its derivative is the derivative of the magnitude at the frequency of
    the peak. If two peaks are equal, it is the derivative at one of them.
    Raises InputError if a vibration in the band has no damping, because the response is infinite, and if a direction
    rotates for the observer of a rotation.

    >>> body = mbd.RigidBody("load", 2.0, (1.0, 1.0, 1.0))
    >>> rail = mbd.Prismatic(mbd.Ground().at(), body.at(), axis="y", name="rail")
    >>> spring = mbd.AxialSpringDamper(mbd.Ground().at(), body.at(), axis="y", stiffness=50.0, damping=2.0)
    >>> motion = mbd.simulate(mbd.System([body], [rail], [spring]), 0.01, steps=2)
    >>> largest = mbd.vibrations.FrequencyResponse("rail", "rail", band=(0.1, 10.0))
    >>> round(largest(motion).item(), 6)  # 1 / (k 2 zeta sqrt(1 - zeta^2)), zeta = 0.1
    0.100504
    >>> largest.peak(motion).where, round(largest.peak(motion).frequency.item(), 4)
    (['peak'], 0.7878)
    """

    unit: ClassVar[str] = ""  # that of the output by the input, which are not known here
    output: str
    input: str
    band: tuple[float, float] = (1.0, 100.0)
    direction: str | None = None
    place: Place = None
    input_direction: str | None = None
    input_place: Place = None
    quantity: str = QUANTITIES[0]
    speed: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        output, source = self._named
        object.__setattr__(self, "place", output.place)
        object.__setattr__(self, "input_place", source.place)
        band = rising("band", self.band)
        nonnegative("band", band[0], "Hz")
        object.__setattr__(self, "band", band)
        one_of("quantity", self.quantity, QUANTITIES)
        nonnegative("speed", self.speed, "rad/s")

    def check(self, system: System) -> None:
        output, source = self._named
        output.output(system)
        source.input(system)

    def value(self, motion: Trajectory) -> Tensor:
        return self.peak(motion).magnitude

    def peak(self, motion: Trajectory) -> ResponsePeak:
        """The largest response with its frequency, and whether it is at an end of the band."""
        output, source = self._named
        signal, row = output.output(motion.system)
        actuator = source.input(motion.system)

        def probed() -> tuple[System, Ports]:
            ports = Ports(1)
            return system_with_ports(motion.system, ports, [actuator], [signal]), ports

        system, ports = outside_transforms(probed)
        states = steady_states(system, [float(self.speed)], self.shaft, motion.designs)
        low, high = self.band
        band = 2.0 * math.pi * low, 2.0 * math.pi * high
        largest = largest_response(states, ports, row, QUANTITIES.index(self.quantity), band)
        return ResponsePeak(largest.magnitude, largest.frequency / (2.0 * math.pi), largest.where)

    @property
    def _named(self) -> tuple[NamedPort, NamedPort]:
        """Output and input."""
        return (
            NamedPort(self.output, self.direction, self.place, ("output", "direction", "place")),
            NamedPort(self.input, self.input_direction, self.input_place, ("input", "input_direction", "input_place")),
        )
