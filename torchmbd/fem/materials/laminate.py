"""Classical lamination with first-order shear: from plies to the plate stiffness A, B, D, As.

Plies are listed from the bottom face z = offset - h/2 to the top face z = offset + h/2; z = 0 is the surface of the nodes.

    N = A eps + B kappa        membrane forces     [N/m]
    M = B eps + D kappa        moments             [N]
    Q = As gamma               shear forces        [N/m]

    (A, B, D) = sum_k Qbar_k (z_k+1 - z_k,  (z_k+1^2 - z_k^2) / 2,  (z_k+1^3 - z_k^3) / 3)
    As        from the energy of the shear stresses in equilibrium (transverse_shear.py), or, with a number given,
                shear_correction * sum_k Gbar_k (z_k+1 - z_k), which is wrong for sandwiches: 5/6 is 30 % too stiff for
                the plate of NAFEMS R0031/3

eps     eps_xx, eps_yy, gamma_xy of the mid-surface
kappa   curvatures: the strain at height z is eps + z kappa  [1/m]
gamma   gamma_xz, gamma_yz
theta   ply angle about +z from the plate x-axis             [rad]
z       heights of the n + 1 ply interfaces                  [m]

Differentiable, forward and reverse, in angles, thicknesses and numbers of plies; all may carry leading lanes `...`
(one laminate per lane) when they are given through torch.func.functional_call.
Assumed: perfect bond, small strains, plane stress in each ply.
Source: eqs. (11)-(12) of the paper (the paper's H_2 and H_3 carry z and z^2); Jones, Mechanics of Composite Materials,
chapter 4; Reddy, Mechanics of Laminated Composite Plates and Shells, section 3.4.
Checked in tests/fem/materials/test_laminate.py.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchmbd.errors import InputError, keyword_hints, true_or_false
from torchmbd.fem.materials.expansion import Expansion, HeldExpansion, free_expansion, free_strains, held_expansion
from torchmbd.fem.materials.laminate_checks import checked_angles, checked_correction, checked_plies, checked_thickness
from torchmbd.fem.materials.ply import Lamina
from torchmbd.fem.materials.transverse_shear import ShearShape, energy_shear_stiffness, shear_shape
from torchmbd.fixed_arguments import FixedArguments
from torchmbd.math.checked_numbers import is_real
from torchmbd.math.variable import LayerNumbers, is_variable, stacked

_UPPER3 = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_UPPER2 = ((0, 0), (0, 1), (1, 1))

#: What each of the 21 numbers of `Laminate.entries()` is: (matrix, row, column), rows counted from 0.
ENTRIES: tuple[tuple[str, int, int], ...] = (
    *(("A", i, j) for i, j in _UPPER3),
    *(("B", i, j) for i, j in _UPPER3),
    *(("D", i, j) for i, j in _UPPER3),
    *(("As", i, j) for i, j in _UPPER2),
)


class LaminateStiffness(NamedTuple):
    """Plate stiffness: A [N/m], B [N], D [N m] of shape [..., 3, 3], As [N/m] of shape [..., 2, 2]."""

    A: Float[Tensor, "*lanes 3 3"]
    B: Float[Tensor, "*lanes 3 3"]
    D: Float[Tensor, "*lanes 3 3"]
    As: Float[Tensor, "*lanes 2 2"]

    def entries(self) -> Float[Tensor, "*lanes 21"]:
        """Collect the 21 independent numbers in the order of `ENTRIES`: upper triangles of A, B, D, As, row by row."""
        upper = [0, 1, 2, 4, 5, 8]
        three = (X.flatten(-2)[..., upper] for X in (self.A, self.B, self.D))
        return torch.cat([*three, self.As.flatten(-2)[..., [0, 1, 3]]], dim=-1)

    @classmethod
    def of(cls, entries: Float[Tensor, "*lanes 21"]) -> LaminateStiffness:
        """Spread the 21 numbers out again."""
        numbers = entries.split([6, 6, 6, 3], dim=-1)
        three, two = [0, 1, 2, 1, 3, 4, 2, 4, 5], [0, 1, 1, 2]
        A, B, D = (block[..., three].unflatten(-1, (3, 3)) for block in numbers[:3])
        return cls(A, B, D, numbers[3][..., two].unflatten(-1, (2, 2)))


@keyword_hints
class Laminate(FixedArguments, nn.Module):
    """A stack of plies; `.angles` [rad] and `.thickness` [m] are parameters, one value per given layer.

    A torch.nn.Parameter is registered itself, not copied; computed tensors that require gradients raise an error.

    ply               one Ply, or one per given layer; numbers of it that vary are parameters "ply.E1", of several plies
                      "ply2.E1": of the third layer
    angles            [layers] rad, from bottom to top
    thickness         of every layer, or one per given layer [m]; numbers become a parameter that requires no gradient
    symmetric         the given layers are the lower half, mirrored about the mid-plane
    offset            height of the middle of the stack above the surface of the nodes [m]; constant, whatever the thickness
    shear_correction  "energy": the transverse shear stiffness of equal energy, a full matrix that follows the stack
                      (5/6 of G h if it is homogeneous); or a number that multiplies the sum of the plies' G t

    >>> laminate = mbd.Laminate(mbd.examples.carbon(), angles=mbd.deg([0, 90]), thickness=0.5e-3, symmetric=True)
    >>> laminate.total_thickness.item()  # four layers [m]
    0.002
    >>> stiffness = laminate.stiffness()
    >>> stiffness.A.shape, stiffness.D.shape  # [N/m], [N m]
    (torch.Size([3, 3]), torch.Size([3, 3]))
    >>> bool(stiffness.D[0, 0] > stiffness.D[1, 1])  # the outer plies bend along x
    True
    """

    positive: ClassVar[tuple[str, ...]] = ("thickness",)  # parameters that are, whatever the design
    #: Parameter -> how far an entry of it may turn until every number of the laminate is the same again [rad].
    periods: ClassVar[Mapping[str, float]] = {"angles": math.pi}
    angles: Tensor
    thickness: Tensor
    field: Any = None  # a FiberField, where parameters vary over a mesh (fem/elements)
    _constant: Tensor
    _factors: Tensor | None = None  # of the moduli of the plies, see `stiffened`

    def __init__(
        self,
        ply: Lamina | Sequence[Lamina],
        angles: Sequence[float] | Tensor,
        thickness: float | Sequence[float] | Tensor,
        symmetric: bool = False,
        shear_correction: float | str = "energy",
        offset: float = 0.0,
    ) -> None:
        super().__init__()
        if not is_real(offset):
            raise InputError("offset", offset, "a finite number [m]", noun="Laminate: offset")
        self.offset = float(offset)
        self.angles = checked_angles("Laminate", angles)
        layers = self.angles.numel()
        plies = checked_plies(ply, layers)
        self.symmetric = true_or_false("Laminate: symmetric", symmetric)
        self._plies = LayerNumbers(self, "ply", plies)
        self.shear_correction = checked_correction(shear_correction)
        self.thickness = checked_thickness(thickness, layers)
        self.register_buffer("_constant", _constants_of(plies).detach(), persistent=False)

    @property
    def plies(self) -> tuple[Lamina, ...]:
        """The ply of every given layer, with the numbers of the present design."""
        return self._plies.current(self)

    @property
    def merge_key(self) -> tuple:
        """Key that is equal for laminates that differ in their angles only; unique where numbers of plies vary."""
        if self._plies.vary:
            return (id(self),)
        return self.plies, self.symmetric, self.shear_correction, self.offset, tuple(self.thickness.tolist())

    @property
    def mean_laminate(self) -> Laminate:
        """The laminate of the constants of elements (isotropic_mean.py): this one, or the mean over a field."""
        return self

    @staticmethod
    def stacked(laminates: Sequence[Laminate]) -> Laminate:
        """Return laminates of the same plies as one, whose parameters have one more axis: [*lanes, laminates, layers]."""
        result = copy.copy(laminates[0])
        result._parameters = {}  # of the copy, which has tensors instead
        for name in ("angles", "thickness"):
            values = torch.broadcast_tensors(*(getattr(laminate, name) for laminate in laminates))
            vars(result)[name] = torch.stack(values, -2)
        return result

    def forward(self) -> Float[Tensor, "*lanes 21"]:
        """Return `entries()`, so that torch.func.functional_call can evaluate the laminate with other parameters."""
        return self.entries()

    def entries(self) -> Float[Tensor, "*lanes 21"]:
        """Return the 21 independent stiffness numbers, in the order of `ENTRIES`."""
        return self.stiffness().entries()

    def stiffness(self) -> LaminateStiffness:
        """Integrate the ply stiffnesses through the thickness."""
        return self._integrated(*turned_stiffness(self.layer_angles, *self.layer_stiffness))

    def _integrated(self, Qbar: Tensor, Gbar: Tensor) -> LaminateStiffness:
        """Stiffness of layers in plate axes."""
        H = self._moments()
        A, B, D = self._integrals(H, Qbar)
        if isinstance(self.shear_correction, str):
            As = energy_shear_stiffness(shear_shape(Qbar, self.faces, A, B, D), Gbar)
        else:
            As = self.shear_correction * torch.einsum("...k,...kij->...ij", H[0], Gbar)
        return LaminateStiffness(A, B, D, As)

    @property
    def loses(self) -> bool:
        """True if a ply has a loss factor."""
        return any(is_variable(p.loss) or p.loss for p in self._plies.layers)

    @property
    def loss_factors(self) -> Float[Tensor, "*lanes layers"]:
        """Loss factors of the plies, in the order of `angles` [-]."""
        return stacked([p.loss for p in self.plies])

    def stiffened(self, factors: Float[Tensor, "*lanes layers"]) -> Laminate:
        """The laminate with all moduli of each ply, in the order of `angles`, times a factor."""
        result = copy.copy(self)
        vars(result)["_factors"] = factors
        return result

    @property
    def mean_inputs(self) -> tuple[Tensor, ...]:
        """The tensors that `isotropic_stiffness` depends on."""
        return *self.layer_stiffness, self.layer_thickness

    def isotropic_stiffness(self) -> LaminateStiffness:
        """Stiffness of the stack with each ply averaged over all directions; it does not depend on the angles."""
        Q, G = self.layer_stiffness
        direct, mixed = plane_invariants(Q)
        none = torch.zeros_like(direct)
        rows = [direct, mixed, none, mixed, direct, none, none, none, (direct - mixed) / 2.0]
        Q = torch.stack(rows, -1).unflatten(-1, (3, 3))
        G = G.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None] * torch.eye(2, dtype=G.dtype)
        return self._integrated(Q, G)

    def expansion(
        self, temperature: float | Tensor = 0.0, gradient: float | Tensor = 0.0, moisture: float | Tensor = 0.0
    ) -> Expansion:
        """Return strains, curvatures and ply stresses of the free laminate after a change of temperature or moisture.

        temperature  change of the temperature at z = 0, the surface on which the nodes lie [K], [] or [lanes]
        gradient     change of the temperature per meter along the normal [K/m]
        moisture     change of the moisture, a share of the mass [-]
        Returns force, moment, strain, curvature and stress; force and moment are the loads that would cause the same strain and
        curvature. Raises InputError that names a ply without a coefficient for a change that acts.

        >>> ply = mbd.Ply(128e9, 10.1e9, 5.36e9, 5.36e9, 3.6e9, 0.23, 1586.0, alpha1=-0.3e-6, alpha2=28e-6)
        >>> strip = mbd.Laminate(ply, mbd.deg([0, 90]), thickness=0.125e-3).expansion(temperature=-120.0)
        >>> strip.curvature[0].item() < -5.0, strip.stress.shape  # [1/m]; layers, their bottom and top, (11, 22, 12) [Pa]
        (True, torch.Size([2, 2, 3]))
        """
        held = self.held_expansion(temperature, gradient, moisture)
        T, _ = strain_rotations(self.layer_angles)
        Q, _ = self.layer_stiffness
        A, B, D, _ = self.stiffness()
        return free_expansion(held, T, Q, self.faces, (A, B, D))

    def held_expansion(
        self, temperature: float | Tensor = 0.0, gradient: float | Tensor = 0.0, moisture: float | Tensor = 0.0
    ) -> HeldExpansion:
        """Return the loads and ply stresses that would cause the free strains of a change; arguments as in `expansion`.

        A laminate that is held without strain carries the opposite ones.
        """
        strains = free_strains(self.layer_plies, temperature, gradient, moisture)
        T, _ = strain_rotations(self.layer_angles)
        Q, _ = self.layer_stiffness
        return held_expansion(strains, T, Q, self.faces, self._moments())

    def shear_shape(self) -> ShearShape:
        """Return the stresses through the thickness of unit transverse shear forces."""
        Qbar, _ = turned_stiffness(self.layer_angles, *self.layer_stiffness)
        return shear_shape(Qbar, self.faces, *self._integrals(self._moments(), Qbar))

    @property
    def layer_angles(self) -> Float[Tensor, "*lanes all_layers"]:
        """Angle of every layer, both halves of a symmetric stack [rad]."""
        return self._stack(self.angles)

    @property
    def layer_thickness(self) -> Float[Tensor, "*lanes all_layers"]:
        """Thickness of every layer, both halves of a symmetric stack [m]."""
        return self._stack(self.thickness)

    @property
    def layer_plies(self) -> tuple[Lamina, ...]:
        """Ply of every layer, both halves of a symmetric stack."""
        plies = self.plies
        return plies + plies[::-1] if self.symmetric else plies

    @property
    def layer_stiffness(self) -> tuple[Float[Tensor, "*lanes all_layers 3 3"], Float[Tensor, "*lanes all_layers 2 2"]]:
        """Stiffness of every layer in its own axes, in plane and in transverse shear [Pa]."""
        Q, G, _ = self._numbers.split([9, 4, 1], -1)
        return self._stack(Q.unflatten(-1, (3, 3)), -3), self._stack(G.unflatten(-1, (2, 2)), -3)

    @property
    def _numbers(self) -> Float[Tensor, "*lanes layers 14"]:
        numbers = _constants_of(self.plies) if self._plies.vary else self._constant
        if self._factors is None:
            return numbers
        moduli, density = numbers.split([13, 1], -1)
        moduli = moduli * self._factors[..., None]
        return torch.cat([moduli, density.expand(*moduli.shape[:-1], 1)], -1)

    @property
    def _density(self) -> Float[Tensor, "*lanes layers"]:
        return self._numbers[..., -1]

    @property
    def faces(self) -> Float[Tensor, "*lanes all_layers 2"]:
        """Heights of the bottom and the top of every layer [m]."""
        t = self.layer_thickness
        top = t.cumsum(-1) - 0.5 * t.sum(-1, keepdim=True) + self.offset
        return torch.stack([top - t, top], dim=-1)

    @property
    def total_thickness(self) -> Float[Tensor, "*lanes"]:
        """Height h of the whole stack, both halves of a symmetric one [m]."""
        return self.layer_thickness.sum(-1)

    @property
    def mass_per_area(self) -> Float[Tensor, "*lanes"]:
        """Mass per area of the mid-surface, sum of density times thickness [kg/m2]."""
        return (self._stack(self._density) * self._moments()[0]).sum(-1)

    @property
    def first_moment_per_area(self) -> Float[Tensor, "*lanes"]:
        """First moment of the density about the mid-surface, along its normal [kg/m]."""
        return (self._stack(self._density) * self._moments()[1]).sum(-1)

    @property
    def centered(self) -> bool:
        """True if the first moment is zero whatever the thicknesses: a symmetric stack, or one density, without offset."""
        densities = {id(p.density) if is_variable(p.density) else p.density for p in self._plies.layers}
        return self.offset == 0.0 and (self.symmetric or len(densities) == 1)

    @property
    def rotary_inertia_per_area(self) -> Float[Tensor, "*lanes"]:
        """Second moment of the density about the mid-surface [kg]."""
        return (self._stack(self._density) * self._moments()[2]).sum(-1)

    def extra_repr(self) -> str:
        degrees = ", ".join(f"{a:g}" for a in torch.rad2deg(self.angles.detach()).flatten().tolist())
        return f"angles=[{degrees}] deg, symmetric={self.symmetric}"

    def _stack(self, values: Tensor, layer_axis: int = -1) -> Tensor:
        """Values of every layer, bottom to top: the mirrored half is appended here."""
        return torch.cat([values, values.flip(layer_axis)], dim=layer_axis) if self.symmetric else values

    @staticmethod
    def _integrals(H: tuple[Tensor, ...], Qbar: Tensor) -> tuple[Tensor, ...]:
        """A, B, D."""
        # A single matrix product has other rounding than a batch, and a body could not use its modes in its first motion.
        return torch.einsum("...mk,...kj->...mj", torch.stack(H, -2), Qbar.flatten(-2)).unflatten(-1, (3, 3)).unbind(-3)

    def _moments(self) -> tuple[Tensor, Tensor, Tensor]:
        """Integrals of 1, z, z^2 over each layer [m, m2, m3], shape [..., layers]."""
        bottom, top = self.faces.unbind(-1)
        return self.layer_thickness, (top**2 - bottom**2) / 2.0, (top**3 - bottom**3) / 3.0


def _constants_of(plies: Sequence[Lamina]) -> Float[Tensor, "*lanes layers 14"]:
    """Stiffness in plane (9 numbers) and in transverse shear (4), and density of every ply."""
    rows = [(p.plane_stiffness().flatten(-2), p.shear_stiffness().flatten(-2), stacked([p.density])) for p in plies]
    lanes = np.broadcast_shapes(*(x.shape[:-1] for row in rows for x in row))
    return torch.stack([torch.cat([x.expand(*lanes, -1) for x in row], -1) for row in rows], -2)


def turned_stiffness(
    theta: Float[Tensor, "*lanes layers"], Q: Float[Tensor, "*lanes layers 3 3"], G: Float[Tensor, "*lanes layers 2 2"]
) -> tuple[Float[Tensor, "*lanes layers 3 3"], Float[Tensor, "*lanes layers 2 2"]]:
    """Return ply stiffnesses in plate axes: T' Q T and R' G R."""
    T, R = strain_rotations(theta)
    return T.mT @ Q @ T, R.mT @ G @ R


def plane_invariants(X: Float[Tensor, "*lanes 3 3"]) -> tuple[Float[Tensor, "*lanes"], Float[Tensor, "*lanes"]]:
    """Return U1 and U4 of a stiffness in the plane: its direct and mixed numbers in the mean over all directions."""
    U1 = (3.0 * X[..., 0, 0] + 3.0 * X[..., 1, 1] + 2.0 * X[..., 0, 1] + 4.0 * X[..., 2, 2]) / 8.0
    U4 = (X[..., 0, 0] + X[..., 1, 1] + 6.0 * X[..., 0, 1] - 4.0 * X[..., 2, 2]) / 8.0
    return U1, U4


def strain_rotations(
    theta: Float[Tensor, "*lanes layers"],
) -> tuple[Float[Tensor, "*lanes layers 3 3"], Float[Tensor, "*lanes layers 2 2"]]:
    """Return T and R, which map strains in plate axes to ply axes: (xx, yy, xy) to (11, 22, 12), (xz, yz) to (13, 23)."""
    c, s = torch.cos(theta), torch.sin(theta)
    cc, ss, cs = c * c, s * s, c * s
    T = torch.stack([cc, ss, cs, ss, cc, -cs, -2 * cs, 2 * cs, cc - ss], dim=-1).reshape(*theta.shape, 3, 3)
    return T, torch.stack([c, s, -s, c], dim=-1).reshape(*theta.shape, 2, 2)
