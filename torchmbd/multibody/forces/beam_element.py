"""An elastic connection of two frames, as one element of a beam: any rotations, coupled stiffness.

    l = log(H_a^-1 H_b),    f = K (l - l_0 + d l')

H_a, H_b   the two frames; l their relative screw in the axes of a: (rho, phi), phi the rotation vector; l_0 at the given
           initial positions

A straight beam of length L with the stiffness S of its sections has K = S / L: forces and moments N, V_y, V_z, T, M_y,
M_z by strains, and l - l_0 is L times these. Equations in system/beams.py.
Checked in tests/multibody/forces/test_beam_element.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor, nn

from torchmbd.errors import InputError, Path
from torchmbd.math.checked_numbers import nonnegative, parameter, reals
from torchmbd.math.rigid_motion import LARGEST, logarithm
from torchmbd.math.variable import ParameterVector
from torchmbd.multibody.bodies.frame import Frame
from torchmbd.multibody.forces.force import ForceElement
from torchmbd.multibody.joints.joint import AttachmentTable


class BeamElement(ForceElement):
    """An elastic connection of two frames of rigid bodies, whose displacements and rotations are not small.

    a, b       frames of rigid bodies, or of the ground
    stiffness  [6, 6], symmetric and positive definite: forces [N] and moments [N m] per unit of the screw from a to b, in the
               axes of a. For a straight beam of length L along x it is the section stiffness divided by L. A
               torch.nn.Parameter is the design variable "NAME.stiffness"
    damping    time [s]: forces grow by stiffness x damping x rate of the screw
    name       of the element, and of its design variable

    It is free of force at the given initial positions, whatever the relative position of the frames. Its energy is part of
    the strain energy.

    >>> S = mbd.GivenSection.isotropic(E=70e9, nu=0.3, density=2700.0, area=1e-4, Iyy=1e-9, Izz=1e-9, J=2e-9).stiffness()
    >>> tip = mbd.RigidBody("tip", 1.0, (0.01, 0.01, 0.01), position=(0.5, 0, 0))
    >>> strip = mbd.BeamElement(mbd.Ground().at(), tip.at(), S / 0.5, name="strip")
    >>> rest = mbd.equilibrium(mbd.System([tip], [], [strip, mbd.Torque(tip.at(), (0, 0, 70.0))]))
    >>> rest.body("tip").r[0, 0].round(decimals=4).tolist()  # an arc of half a radian [m]
    [0.4794, 0.1224, 0.0]
    """

    variables_in_laws: ClassVar[bool] = False

    def __init__(self, a: Frame, b: Frame, stiffness: Sequence | Tensor, damping: float = 0.0, name: str | None = None):
        super().__init__((a, b), name)
        for frame in self.frames:
            _check(self.name, frame)
        label = (self.name, "stiffness")
        self._variables = nn.ParameterDict()
        if isinstance(stiffness, nn.Parameter):
            self._variables["stiffness"] = parameter(label, stiffness)
        K = reals(label, stiffness.detach() if isinstance(stiffness, Tensor) else stiffness)
        _check_stiffness(label, K)
        self.stiffness: Tensor = self._variables["stiffness"] if len(self._variables) else K
        self.damping = nonnegative((self.name, "damping"), damping, "s")
        self.rest = _screw(a, b)
        if float(self.rest[3:].norm()) > LARGEST:
            raise InputError(
                (self.name, "frames"), allowed="turned by less", state=f"are turned by more than {LARGEST} rad"
            )

    @property
    def variables(self) -> ParameterVector | None:
        """The stiffness, if it varies."""
        return ParameterVector.of(self._variables)

    def actions(self, attachments: AttachmentTable) -> list:
        """No actions: the force is that of a beam element."""
        return []

    def beams(self, attachments: AttachmentTable) -> list[tuple[int, int]]:
        """Attached points at its two ends."""
        a, b = self.frames
        return [(attachments.point(a), attachments.point(b))]

    def beam_data(self) -> dict[str, Tensor]:
        """Data of one element; only the symmetric part of the stiffness counts, as in the energy."""
        K = self._variables["stiffness"] if len(self._variables) else self.stiffness
        a, b = self.frames
        data = {"beam_stiffness": 0.5 * (K + K.mT)[..., None, :, :], "beam_rest": self.rest[None]}
        data |= {"beam_start": a.axes[None], "beam_end": b.axes[None]}
        if self.damping:
            data["beam_damping"] = torch.full((1,), self.damping, dtype=torch.float64)
        return data


def _check_stiffness(name: str | Path, K: Tensor) -> None:
    """InputError for anything but a symmetric positive definite matrix [6, 6]."""
    allowed = "a symmetric, positive definite matrix [6, 6]"
    if K.shape != (6, 6) or not bool(torch.isfinite(K).all()):
        raise InputError(name, K, allowed, state=f"has shape {tuple(K.shape)} or is not finite")
    size = K.diagonal().abs().sqrt()
    if bool(((K - K.T).abs() > 1e-9 * size[:, None] * size).any()):
        raise InputError(name, allowed=allowed, state="is not symmetric")
    if int(torch.linalg.cholesky_ex(K)[1]):
        raise InputError(name, allowed=allowed, state="is not positive definite")


def _check(name: str, frame: Frame) -> None:
    allowed = "frames of the ground or of rigid bodies, without design variables"
    if frame.interpolation is not None:
        raise InputError((name,), allowed=allowed, noun=repr(name), state=f"ends at {frame!r}, on a flexible body")
    if frame.varying is not None or isinstance(frame.body.position, nn.Parameter):
        raise InputError(
            (name,), allowed=allowed, noun=repr(name), state=f"ends at {frame!r}, whose place varies with the design"
        )


def _screw(a: Frame, b: Frame) -> Tensor:
    """Relative screw of frame b from a at the given initial positions [6]."""
    x, y = (frame.body.position + frame.body.axes @ frame.point for frame in (a, b))
    A, B = (frame.body.axes @ frame.axes for frame in (a, b))
    return logarithm(A.T @ (y - x), A.T @ B)
