"""Rigid bodies and the ground.

    mass m [kg], center of mass c in body axes [m], inertia about c [kg m2]

The motion stage uses the second moment P = integral of x x' dm about the body's origin, which serves rigid and
flexible bodies alike:  J = tr(P) 1 - P,  P = (tr(J_c) / 2) 1 - J_c + m c c'.
Checked in tests/multibody/bodies/test_rigid.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from torchmbd.errors import InputError, keyword_hints
from torchmbd.fixed_arguments import FixedArguments
from torchmbd.math.checked_numbers import parameter, positive
from torchmbd.math.plausible_units import GYRATION, warn_unusual
from torchmbd.multibody.bodies.frame import (
    Frame,
    frame_at,
    identifier,
    read_numbers,
    register,
    set_start,
    vector_or_parameter,
)

_ROUNDING = 1e-12  # share of the largest entry of an inertia by which it may be unsymmetric, or its moments impossible


class Ground:
    """The inertial frame; joints attach bodies to it.

    >>> mbd.Ground().at(0.1, 0, 0)
    ground.at(0.1, 0, 0)
    """

    name = "ground"
    position = torch.zeros(3, dtype=torch.float64)
    axes = torch.eye(3, dtype=torch.float64)

    def __init__(self) -> None:
        """It has no arguments; `at` places frames in it."""

    def at(
        self,
        x: float | Tensor = 0.0,
        y: float | Tensor = 0.0,
        z: float | Tensor = 0.0,
        axes: Sequence | Tensor | None = None,
        turn: Sequence[float | Tensor] = (0.0, 0.0, 0.0),
    ) -> Frame:
        """Frame at a point in ground axes [m]; `axes`: columns of its triad (default: ground axes).

        x, y, z   each may be mbd.variable(...): a design variable of the joint or force, "hinge_a.x"
        turn      rotation vector of the triad, in its own axes [rad], of numbers or variables: "hinge_a.turn_x"
        """
        return frame_at(self, (x, y, z), axes, turn)


def same_body(a: Any, b: Any) -> bool:
    """True if two frames with these bodies are on one body: every `Ground()` is the same."""
    return a is b or (isinstance(a, Ground) and isinstance(b, Ground))


@keyword_hints
class RigidBody(FixedArguments, nn.Module):
    """A rigid body.

    name              an identifier, unique in its system
    mass              [kg], positive
    inertia           about the center of mass: (Jxx, Jyy, Jzz) or a symmetric 3 x 3 matrix [kg m2]
    center            center of mass in body axes [m]
    position, axes    approximate initial origin in ground axes [m] and rotation (columns: body axes); joints may change both
    velocity          initial velocity of the origin in ground axes [m/s], which joints may change; None: the smallest that
                      the joints and drives allow
    angular_velocity  initial angular velocity in body axes [rad/s], which joints may change too

    Each of these but the axes is a design variable where it is given as a torch.nn.Parameter.

    >>> tool = mbd.RigidBody("tool", mass=0.2, inertia=(1e-4, 1e-4, 2e-4), center=(0.01, 0, 0), position=(0.5, 0, 0))
    >>> tool.at(0.02, 0, 0)  # a point in body axes, for joints and forces
    tool.at(0.02, 0, 0)
    """

    positive: ClassVar[tuple[str, ...]] = ("mass",)  # parameters that must be positive in every design
    mass: Tensor
    center: Tensor
    inertia: Tensor
    position: Tensor
    axes: Tensor
    velocity: Tensor
    angular_velocity: Tensor

    def __init__(
        self,
        name: str,
        mass: float | Tensor,
        inertia: Sequence | Tensor,
        center: Sequence[float] | Tensor = (0.0, 0.0, 0.0),
        position: Sequence[float] | Tensor = (0.0, 0.0, 0.0),
        axes: Sequence | Tensor | None = None,
        velocity: Sequence[float] | Tensor | None = None,
        angular_velocity: Sequence[float] | Tensor | None = None,
    ):
        super().__init__()
        self.name = identifier("rigid body", name)
        varies = isinstance(mass, nn.Parameter)
        m = positive((name, "mass"), mass.detach() if varies else mass, "kg")
        set_start(self, position, axes, velocity, angular_velocity)
        J = _inertia(name, inertia)
        self._principal = isinstance(inertia, nn.Parameter) and inertia.dim() == 1
        radius = float(torch.linalg.eigvalsh(J)[-1] / m) ** 0.5
        warn_unusual(f"inertia: radius of gyration of {name!r}", radius, "m", GYRATION)
        register(self, "mass", _scalar(name, mass) if varies else torch.tensor(m, dtype=torch.float64))
        register(self, "center", vector_or_parameter((name, "center"), center))
        register(self, "inertia", parameter((name, "inertia"), inertia) if isinstance(inertia, nn.Parameter) else J)

    def at(
        self,
        x: float | Tensor = 0.0,
        y: float | Tensor = 0.0,
        z: float | Tensor = 0.0,
        axes: Sequence | Tensor | None = None,
        turn: Sequence[float | Tensor] = (0.0, 0.0, 0.0),
    ) -> Frame:
        """Frame at a point in body axes [m]; `axes`: columns of its triad in body axes.

        x, y, z   each may be mbd.variable(...): a design variable of the joint or force, "hinge_b.x"
        turn      rotation vector of the triad, in its own axes [rad], of numbers or variables: "hinge_b.turn_x"
        """
        return frame_at(self, (x, y, z), axes, turn)

    def invariants(self, about: Tensor | None = None) -> dict[str, Tensor]:
        """Mass, first and second moments about a point in body axes [3] [m], or the origin of the body (keys as in
        fem/reduction/invariants.py)."""
        m, c = self.mass, self.center if about is None else self.center - about
        S0 = m[..., None] * c
        return {
            "mass": m,
            "S0": S0,
            "P0": self.second_moment + S0[..., None] * c[..., None, :],
            "mu": torch.zeros_like(m),
        }

    @property
    def second_moment(self) -> Tensor:
        """Integral of x x' dm about the center of mass [3, 3] [kg m2]."""
        # With lanes the number of axes does not tell principal values [lanes, 3] from a matrix.
        J = torch.diag_embed(self.inertia) if self._principal else 0.5 * (self.inertia + self.inertia.mT)
        trace = J.diagonal(dim1=-2, dim2=-1).sum(-1)
        return 0.5 * trace[..., None, None] * torch.eye(3, dtype=torch.float64) - J


def _scalar(name: str, mass: nn.Parameter) -> nn.Parameter:
    if mass.dim():
        raise InputError(
            (name, "mass"),
            mass,
            "must have shape [], as mbd.variable(...) has",
            state=f"is a Parameter of shape {tuple(mass.shape)}",
        )
    return parameter((name, "mass"), mass)


def _inertia(name: str, inertia: Sequence | Tensor) -> Tensor:
    allowed = "three numbers or a symmetric 3 x 3 matrix [kg m2]"
    J = read_numbers((name, "inertia"), inertia.detach() if isinstance(inertia, nn.Parameter) else inertia, allowed)
    J = torch.diag(J) if J.shape == (3,) else J
    rounding = _ROUNDING * float(J.abs().max()) if J.numel() else 0.0  # of a product R J R'
    if J.shape != (3, 3) or not bool(torch.isfinite(J).all()) or not bool(((J - J.T).abs() <= rounding).all()):
        raise InputError((name, "inertia"), inertia, allowed)
    J = 0.5 * (J + J.T)
    principal = torch.linalg.eigvalsh(J)
    # A body of positive mass has J1 + J2 >= J3; a rod has J1 = 0 and a driven body may have none at all.
    if float(principal[0]) < -rounding or float(principal[0] + principal[1] - principal[2]) < -rounding:
        raise InputError(
            (name, "inertia"),
            inertia,
            "must have none that is negative, and none that is larger than the sum of the other two",
            state=f"has the principal values {principal.tolist()} kg m2",
        )
    return J
