"""Drive: a prescribed rotation of body b about an axis of frame a, or a prescribed travel along it. One equation.

Angle and travel are measured from the given initial positions, so a law starts at zero or the assembly moves there.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor, nn

from torchmbd.errors import InputError
from torchmbd.math.gradients import refuse_gradients, refuse_lost_gradients
from torchmbd.math.plausible_units import warn_degrees
from torchmbd.math.torch_law import require_differentiable
from torchmbd.math.variable import ParameterVector
from torchmbd.multibody.joints.joint import AttachmentTable, Equation, Joint, JointCoordinate, as_frame
from torchmbd.multibody.joints.laws import ConstantSpeed, FiniteLaw, finite
from torchmbd.multibody.joints.parametric_law import ParametricDrive
from torchmbd.multibody.joints.primitive import Angle, Law, Travel

# What of a law may be a design variable; part of messages.
VARIABLES = "a torch module of time as the law itself, whose parameters are design variables; constant tensors"


class Drive(Joint):
    """`Drive(a, b, axis="z", speed=...)`, or one of `angle`, `velocity`, `position` instead of `speed`.

    speed      constant angular speed about `axis` of frame a [rad/s]
    angle      law of the rotation about it: a torch function of time [s] -> [rad], or one of multibody/joints/laws.py
    velocity   constant velocity of the point of b along `axis` of frame a [m/s]
    position   law of the travel along it [m]
    name       of the drive, and of its design variables and reactions

    The numbers of a law may be design variables: speed=mbd.variable(2.0), angle=mbd.SmoothStep(mbd.variable(0.5), 1.0).
    They are parameters of the system, named by the joint: "motor.speed", "motor.size".

    A drive is one equation. It needs a joint that leaves this motion free: Revolute, Prismatic or Cylindrical.

    >>> ground, crank = mbd.Ground(), mbd.RigidBody("crank", 1.0, (0.01, 0.01, 0.01))
    >>> hinge = mbd.Revolute(ground.at(), crank.at(), axis="z")
    >>> motor = mbd.Drive(ground, crank, axis="z", speed=2.0, name="motor")
    >>> motion = mbd.simulate(mbd.System([crank], [hinge, motor]), 0.5, steps=10)
    >>> round(mbd.Angle("crank", "z")(motion)[0, -1].item(), 6)  # 2 rad/s x 0.5 s
    1.0
    """

    def __init__(
        self,
        a: Any,
        b: Any,
        axis: str = "z",
        speed: float | Tensor | None = None,
        angle: Law | None = None,
        velocity: float | Tensor | None = None,
        position: Law | None = None,
        name: str | None = None,
    ):
        super().__init__(as_frame(a), as_frame(b), name)
        self.axis = self.common_axis(axis)
        laws = {"speed": speed, "angle": angle, "velocity": velocity, "position": position}
        laws = {key: x for key, x in laws.items() if x is not None}
        if len(laws) != 1:
            raise InputError(
                (self.name,),
                allowed="must have exactly one of speed, angle, velocity, position",
                hint="speed=2.0, or angle=mbd.SmoothStep(...)",
                noun=repr(self.name),
                state=f"has {laws or 'no law'}",
            )
        ((key, x),) = laws.items()
        self.travels = key in ("velocity", "position")
        if key in ("speed", "velocity"):
            x = ConstantSpeed(finite((self.name, key), x))
        self.law = _checked(self.name, key, x)
        if key == "angle":
            for turn in ("size", "amplitude"):
                warn_degrees(f"{self.name}.{turn}", _number(getattr(x, turn, 0.0)))
            warn_degrees(f"{self.name}.angle at t = 0", _number(x(torch.zeros((), dtype=torch.float64))))

    @property
    def variables(self) -> ParameterVector | None:
        return self.law.variables if isinstance(self.law, ParametricDrive) else None

    def equations(self, attachments: AttachmentTable) -> Iterator[Equation]:
        vectors = JointCoordinate(self, turns=not self.travels).vectors(attachments)
        yield Equation(Travel if self.travels else Angle, vectors, self.law)


OF_TABLES = "a table as a spline of SciPy, and that as torch operations on its x and c"
DIFFERENTIABLE = f"a torch function of time that is differentiable twice; {OF_TABLES}"
_SHOWN = 60  # characters of a wrong result in a message


def _number(x: Any) -> float:
    """A number or a tensor of one number as a float; 0 for all else."""
    x = x.detach() if isinstance(x, Tensor) else x
    return float(x) if isinstance(x, (int, float)) or (isinstance(x, Tensor) and x.numel() == 1) else 0.0


def _checked(name: str, key: str, law: Any) -> FiniteLaw:
    try:
        with torch.inference_mode(False), torch.enable_grad():
            start = law(torch.zeros((), dtype=torch.float64)) if callable(law) else law
    except Exception as error:  # a function of users may raise any error
        start = error
    number = (
        isinstance(start, Tensor) and start.shape == () and start.dtype == torch.float64 and bool(torch.isfinite(start))
    )
    if not callable(law) or not number:
        unit = "rad" if key == "angle" else "m"
        text = repr(start).partition("\n")[0]
        raise InputError(
            (name, key),
            allowed=f"a torch function of time, [] [s] -> finite [] [{unit}], float64; {OF_TABLES}",
            state=f"gives {(text if len(text) <= _SHOWN else text[:_SHOWN] + '...')} at t = 0",
        )
    known = list(law.parameters()) if isinstance(law, nn.Module) else []
    refuse_lost_gradients((name, key), start, VARIABLES, known)
    if not hasattr(law, "slopes"):
        require_differentiable((name, key), law, DIFFERENTIABLE, known=known)
    prescribed: Any = law
    variables = ParameterVector.of(law)
    if variables is None:
        refuse_gradients((name, key), start, VARIABLES)
    return FiniteLaw(name, prescribed) if variables is None else ParametricDrive(name, variables)
