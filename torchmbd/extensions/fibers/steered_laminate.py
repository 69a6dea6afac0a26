"""A laminate of steered fibers: its angles, and optionally its thicknesses, vary over the cells of a mesh.

    theta_c = sum_k W_ck theta_k        t_c = sum_k W_ck t_k        (field.py), constant within a cell c

Stiffness, mass and stresses are those of the cell's own stack. Elements take the constants of their shape functions from the
mean of the controls (isotropic_mean.py), as they do from the first values of thicknesses that vary.

    curvature   kappa = grad theta . (cos theta e1 + sin theta e2)       of the path that a fiber follows [1/m]; its inverse is
                        the steering radius
    divergence  psi   = grad theta . (-sin theta e1 + cos theta e2)      relative growth of the distance of neighboring paths
                        along them [1/m]: tows of one width gap where it is positive and overlap where it is negative

e1, e2: axes of the laminate in the cell. Assumed: their own turning over the surface is not counted, as is right on flat
plates and where the surface unrolls with the axes straight.
Source: Gürdal and Olmedo, In-plane response of laminates with spatially varying fiber orientations, AIAA J. 31 (1993) 751-758;
Fernandez et al., Optimal design of fiber reinforced composite structures and their direct ink write fabrication, Comput.
Methods Appl. Mech. Engrg. 353 (2019) 277-307. Checked in tests/extensions/fibers/test_field.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchmbd.errors import InputError
from torchmbd.extensions.fibers.field import FiberField
from torchmbd.fem.materials import Laminate
from torchmbd.fem.materials.ply import Lamina
from torchmbd.math.checked_numbers import parameter
from torchmbd.math.plausible_units import check_angles


class FiberPaths(NamedTuple):
    """Curvature and divergence of the fiber paths in every cell and given layer [..., cells, layers] [1/m]."""

    curvature: Float[Tensor, "*lanes cells layers"]
    divergence: Float[Tensor, "*lanes cells layers"]


class SteeredLaminate(Laminate):
    """A stack of plies that vary over a mesh; parameters `.angles` [controls, layers] [rad] and `.thickness` [m].

    ply               one Ply, or one per given layer; its numbers do not vary
    angles            [controls, layers], from bottom to top [rad]; or [layers], the initial value of all controls
    thickness         [controls, layers] [m]; or a number, or [layers], which does not vary over the mesh: as in Laminate.
                      A torch.nn.Parameter with an axis of controls is registered itself
    field             control points and how cells follow from them
    symmetric, shear_correction   as in Laminate

    `stiffness`, `mass_per_area`, `layer_angles` and so on have an axis of cells: [..., cells, ...].

    >>> mesh = mbd.mesh.rectangle(0.4, 0.1, cells=(16, 4))
    >>> field = mbd.fibers.FiberField(mesh, controls=(5, 3))
    >>> laminate = mbd.fibers.SteeredLaminate(mbd.examples.carbon(), mbd.deg([30, -30]), thickness=1e-3, field=field)
    >>> blade = mbd.FlexibleBody.plate("blade", mesh, laminate, modes=4, reference="left_edge")
    >>> [(name, tuple(x.shape)) for name, x in blade.named_parameters()]
    [('laminate.angles', (15, 2)), ('laminate.thickness', (2,))]
    >>> laminate.layer_angles.shape  # of each cell
    torch.Size([64, 2])
    """

    #: An angle of one control enters means of several controls, which half a turn of it alone changes.
    periods: ClassVar[Mapping[str, float]] = {}

    def __init__(
        self,
        ply: Lamina | Sequence[Lamina],
        angles: Sequence | Tensor,
        thickness: float | Sequence | Tensor,
        field: FiberField,
        symmetric: bool = False,
        shear_correction: float | str = "energy",
    ) -> None:
        if not isinstance(field, FiberField):
            raise InputError("field", field, "a FiberField", noun="field of a SteeredLaminate")
        if isinstance(angles, nn.Parameter) and angles.ndim != 2:
            raise InputError(
                "angles",
                angles,
                "must have shape [controls, layers]",
                noun="angles of a SteeredLaminate",
                state="is a Parameter without an axis of controls",
            )
        theta, t = (
            parameter("angles", angles),
            parameter("thickness", thickness),
        )
        varies = t.ndim == 2
        super().__init__(
            ply,
            _row("angles", theta, field),
            _row("thickness", t, field) if varies else thickness,
            symmetric,
            shear_correction,
        )
        if self._plies.vary:
            raise InputError(
                "ply",
                ply,
                "must have constants that are not mbd.variable(...)",
                noun="ply of a SteeredLaminate",
                state="has design variables",
            )
        check_angles("angles", theta.flatten().tolist(), "SteeredLaminate: ")
        if varies and not bool((t > 0.0).all() and t.isfinite().all()):
            raise InputError(
                "thickness",
                thickness,
                "finite numbers > 0",
                noun="SteeredLaminate: thickness",
                state=f"is from {float(t.min()):g} m",
            )
        self.field, self._thickness_varies = field, varies
        self.angles = theta if theta.ndim == 2 else nn.Parameter(theta.detach().expand(field.controls, -1).clone())
        if varies:
            self.thickness = t

    @property
    def merge_key(self) -> tuple:
        """Unique: it is not merged with other laminates."""
        return (id(self),)

    @property
    def mean_laminate(self) -> Laminate:
        """The laminate of mean angles and thicknesses."""
        mean, t = self.angles.detach().mean(-2), self.thickness.detach()
        return Laminate(self.plies, mean, t.mean(-2) if t.ndim == 2 else t, self.symmetric, self.shear_correction)

    @property
    def layer_angles(self) -> Float[Tensor, "*lanes cells all_layers"]:
        """Angle of every layer in each cell [rad]."""
        return self._stack(self.field.values(self.angles))

    @property
    def layer_thickness(self) -> Float[Tensor, "*lanes cells all_layers"]:
        """Thickness of every layer in each cell [m]."""
        if self._thickness_varies:
            return self._stack(self.field.values(self.thickness))
        return self._stack(self.thickness).unsqueeze(-2).expand(*self.thickness.shape[:-1], len(self.field.cells), -1)

    def paths(self, axes: Float[Tensor, "cells 3 3"]) -> FiberPaths:
        """Curvature and divergence of the fiber paths; axes: rows e1, e2, e3 of the laminate in each cell of the field."""
        theta, slope = self.field.values(self.angles), self.field.gradients(self.angles)
        first, second = torch.einsum("cix,...ckx->...cki", axes[:, :2], slope).unbind(-1)
        c, s = theta.cos(), theta.sin()
        return FiberPaths(c * first + s * second, c * second - s * first)

    def extra_repr(self) -> str:
        low, high = (torch.rad2deg(x.detach()).tolist() for x in (self.angles.amin(-2), self.angles.amax(-2)))
        ranges = ", ".join(f"{a:g} to {b:g}" for a, b in zip(low, high, strict=True))
        return f"angles=[{ranges}] deg at {self.field.controls} controls, symmetric={self.symmetric}"


def _row(name: str, value: Tensor, field: FiberField) -> Tensor:
    """Numbers of the first control, as the plain laminate checks them."""
    if value.ndim == 1:
        return value.detach()
    if value.ndim != 2 or len(value) != field.controls:
        raise InputError(
            name,
            allowed=f"must have shape [layers], or [{field.controls} controls, layers]",
            state=f"has shape {tuple(value.shape)}",
            noun=f"SteeredLaminate: {name}",
        )
    return value.detach()[0]
