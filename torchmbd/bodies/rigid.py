"""Rigid bodies and the ground.

    mass m [kg], center of mass c in body axes [m], inertia about c [kg m2]

The motion stage uses the second moment P = integral of x x' dm about the body's origin, which serves rigid and
flexible bodies alike:  J = tr(P) 1 - P,  P = (tr(J_c) / 2) 1 - J_c + m c c'.
Checked in tests/bodies/test_rigid.py.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torchmbd.bodies.frame import Frame, identifier, numbers, place, rotation, vector
from torchmbd.errors import InputError
from torchmbd.numerics.owned import positive
from torchmbd.numerics.plausible import GYRATION, doubt


class Ground:
    """The inertial frame; joints attach bodies to it."""

    name = "ground"
    position = torch.zeros(3, dtype=torch.float64)
    axes = torch.eye(3, dtype=torch.float64)

    def at(self, x: float = 0.0, y: float = 0.0, z: float = 0.0, axes: Sequence | Tensor | None = None) -> Frame:
        """Frame at a point in ground axes [m]; `axes`: columns of its triad (default: ground axes)."""
        return Frame(self, vector("point", (x, y, z)), rotation("axes", axes))


class RigidBody(nn.Module):
    """A rigid body.

    name              an identifier, unique in its system
    mass              [kg], positive
    inertia           about the center of mass: (Jxx, Jyy, Jzz) or a symmetric 3 x 3 matrix [kg m2]
    center            center of mass in body axes [m]
    position, axes    approximate initial origin in ground axes [m] and rotation (columns: body axes); joints close the rest
    velocity          initial velocity of the origin in ground axes [m/s], kept as far as the joints allow; None: as they ask
    angular_velocity  initial angular velocity in body axes [rad/s], likewise
    """

    mass: Tensor
    center: Tensor
    second_moment: Tensor
    position: Tensor
    axes: Tensor
    velocity: Tensor
    angular_velocity: Tensor

    def __init__(
        self,
        name: str,
        mass: float,
        inertia: Sequence | Tensor,
        center: Sequence[float] | Tensor = (0.0, 0.0, 0.0),
        position: Sequence[float] | Tensor = (0.0, 0.0, 0.0),
        axes: Sequence | Tensor | None = None,
        velocity: Sequence[float] | Tensor | None = None,
        angular_velocity: Sequence[float] | Tensor | None = None,
    ):
        super().__init__()
        self.name = identifier("rigid body", name)
        m = positive(f"mass of {name!r}", mass, "kg")
        place(self, position, axes, velocity, angular_velocity)
        J = _inertia(name, inertia)
        radius = float(torch.linalg.eigvalsh(J)[-1] / m) ** 0.5
        doubt(f"inertia: radius of gyration of {name!r}", radius, "m", GYRATION)
        self.register_buffer("mass", torch.tensor(m, dtype=torch.float64))
        self.register_buffer("center", vector(f"center of {name!r}", center))
        self.register_buffer("second_moment", J.trace() / 2 * torch.eye(3, dtype=torch.float64) - J)

    def at(self, x: float = 0.0, y: float = 0.0, z: float = 0.0, axes: Sequence | Tensor | None = None) -> Frame:
        """Frame at a point in body axes [m]; `axes`: columns of its triad in body axes."""
        return Frame(self, vector(f"point on {self.name!r}", (x, y, z)), rotation("axes", axes))

    def invariants(self) -> dict[str, Tensor]:
        """Mass, first and second moments about the origin of the body (keys as in reduction/invariants.py)."""
        c = self.center
        return {
            "mass": self.mass,
            "S0": self.mass * c,
            "P0": self.second_moment + self.mass * torch.outer(c, c),
            "mu": torch.zeros_like(self.mass),
        }


def _inertia(name: str, inertia: Sequence | Tensor) -> Tensor:
    allowed = "three numbers or a symmetric 3 x 3 matrix [kg m2]"
    J = numbers(f"inertia of {name!r}", inertia, allowed)
    J = torch.diag(J) if J.shape == (3,) else J
    if J.shape != (3, 3) or not bool(torch.isfinite(J).all()) or not torch.allclose(J, J.T, rtol=1e-12, atol=0):
        raise InputError(f"inertia of {name!r} is {inertia!r}; allowed: {allowed}")
    principal = torch.linalg.eigvalsh(J)
    # A body of positive mass has J1 + J2 >= J3; a rod has J1 = 0 and a driven body may have none at all.
    if float(principal[0]) < 0 or float(principal[0] + principal[1] - principal[2]) < -1e-12 * float(principal[2]):
        raise InputError(
            f"inertia of {name!r} has the principal values {principal.tolist()} kg m2; "
            "allowed: none negative, the sum of any two at least the third"
        )
    return J
