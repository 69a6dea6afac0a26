"""A laminate given by lamination parameters: means of its fiber directions through the thickness, instead of plies.

    V(theta) = (cos 2 theta, sin 2 theta, cos 4 theta, sin 4 theta)
    membrane  xi_A = 1/h     integral of V dz               [4]
    coupling  xi_B = 4/h^2   integral of V z dz             [4], zero of a symmetric stack
    bending   xi_D = 12/h^3  integral of V z^2 dz           [4]

    A = h Q(xi_A)      B = h^2/4 (Q(xi_B) - Q(0))      D = h^3/12 Q(xi_D)      As = k h G(xi_A)

    Q11, Q22 = U1 +- U2 V1 + U3 V3      Q12 = U4 - U3 V3      Q66 = U5 - U3 V3      Q16, Q26 = U2 V2 / 2 +- U3 V4
    G11, G22 = (G13 + G23)/2 +- (G13 - G23)/2 V1              G12 = (G13 - G23)/2 V2

U1 ... U5 are the invariants of the ply's stiffness (Tsai and Pagano). A, B, D are exact for any stack of one ply; they are
linear in the parameters, so a stiffness that is best over them bounds that of every stack. As uses a shear correction k: the
energy of the shear stresses depends on the stack, which is not known here.
Source: Tsai and Hahn, Introduction to Composite Materials (1980); Hammer et al., Parametrization in laminate design for optimal
compliance, Int. J. Solids Struct. 34 (1997) 415-434. Checked in tests/extensions/lamination/test_parameters.py.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchmbd.errors import InputError, true_or_false
from torchmbd.extensions.fibers.field import FiberField
from torchmbd.extensions.lamination.conditions import infeasibility_reasons
from torchmbd.fem.materials import Laminate, LaminateStiffness, Ply
from torchmbd.fem.materials.ply import Lamina
from torchmbd.math.checked_numbers import is_real, parameter
from torchmbd.math.plausible_units import THICKNESS, warn_unusual
from torchmbd.math.variable import varies


class LaminationParameters(Laminate):
    """A laminate given by its lamination parameters; `.membrane`, `.coupling`, `.bending` [4] and `.thickness` vary.

    ply         a Ply; its numbers do not vary
    thickness   of the whole laminate [m]; a number does not vary
    membrane    means over the thickness of cos 2t, sin 2t, cos 4t, sin 4t, with the ply angle t [4]
    bending     means of these functions with the weight 12 z^2 / h^2 [4]; None: equal to `membrane`, as for many thin plies
    coupling    means of these functions with the weight 4 z / h [4]; None: zero, as for a symmetric stack
    field       of parameters that vary over a mesh: [controls, 4], thickness [controls] or a number
    shear_correction   k of As = k h G
    checked     False: also accept numbers that no stack has (the stiffness must be positive definite)

    A tensor of numbers becomes a design variable, a torch.nn.Parameter is registered itself.
    `LaminationRegion` limits the parameters to those of stacks; `recover_stacks` finds stacks for them.

    >>> laminate = mbd.lamination.LaminationParameters(
    ...     mbd.examples.carbon(), 2e-3, membrane=[0.2, 0.0, -0.3, 0.0], bending=[0.1, 0, -0.5, 0]
    ... )
    >>> quasi_isotropic = mbd.lamination.LaminationParameters(mbd.examples.carbon(), 2e-3, membrane=[0, 0, 0, 0])
    >>> A = quasi_isotropic.stiffness().A
    >>> bool((A[0, 0] - A[1, 1]).abs() < 1e-6 * A[0, 0])
    True
    """

    def __init__(
        self,
        ply: Ply,
        thickness: float | Tensor,
        membrane: Sequence | Tensor,
        bending: Sequence | Tensor | None = None,
        coupling: Sequence | Tensor | None = None,
        field: FiberField | None = None,
        shear_correction: float = 5.0 / 6.0,
        checked: bool = True,
    ) -> None:
        nn.Module.__init__(self)
        if not isinstance(ply, Lamina):
            raise InputError("ply", ply, "a Ply", noun="ply of LaminationParameters")
        if varies(ply):
            raise InputError(
                "ply", ply, "a ply of numbers", noun="ply of LaminationParameters", state="has numbers that vary"
            )
        if ply.loss:
            raise InputError(
                "ply",
                ply,
                "must have the loss factor 0, because lamination parameters do not contain the plies",
                noun="ply of LaminationParameters",
                state=f"has the loss factor {ply.loss!r}",
            )
        if not (field is None or isinstance(field, FiberField)):
            raise InputError("field", field, "a FiberField, or None", noun="field of LaminationParameters")
        if not (is_real(shear_correction) and 0.0 < shear_correction <= 1.0):
            raise InputError(
                "shear_correction",
                shear_correction,
                "above 0 and at most 1",
                noun="LaminationParameters: shear_correction",
            )
        checked = true_or_false("checked", checked)
        self.ply, self.field, self.shear_correction = ply, field, float(shear_correction)
        self.membrane = _four("membrane", membrane, field)
        self.bending = None if bending is None else _four("bending", bending, field)
        self.coupling = None if coupling is None else _four("coupling", coupling, field)
        self.thickness = _thickness(thickness, field)
        self._thickness_varies = self.thickness.ndim == 1
        constant = torch.cat([ply.plane_stiffness().flatten(), ply.shear_stiffness().flatten()])
        self.register_buffer("_constant", constant, persistent=False)
        self._check(checked)

    @property
    def loses(self) -> bool:
        """No ply has a loss factor."""
        return False

    def _check(self, checked: bool) -> None:
        with torch.no_grad():
            if checked:
                for k, reason in enumerate(infeasibility_reasons(*self.sets())):
                    if reason:
                        place = "" if self.field is None else f" of control {k}"
                        raise InputError(
                            ("membrane", k) if place else "membrane",
                            allowed="lamination parameters of a stack of plies",
                            noun=f"LaminationParameters{place}:",
                            state=reason,
                        )
            X = self.stiffness()
            ABD = torch.cat([torch.cat([X.A, X.B], -1), torch.cat([X.B, X.D], -1)], -2)
            if not bool((torch.linalg.eigvalsh(ABD) > 0.0).all()):
                raise InputError(
                    "membrane",
                    self.membrane.tolist(),
                    "lamination parameters of a stack of plies",
                    noun="LaminationParameters: membrane",
                    shown=str(self.membrane.tolist()),
                    state="and the other parameters have a stiffness that is not positive definite",
                )

    def sets(self) -> tuple[Tensor, Tensor, Tensor]:
        """Membrane, coupling and bending parameters [..., 4], of every control of a field."""
        bending = self.membrane if self.bending is None else self.bending
        return self.membrane, torch.zeros_like(self.membrane) if self.coupling is None else self.coupling, bending

    def stiffness(self) -> LaminateStiffness:
        """A, B, D, As of the parameters; with a field those of each cell."""
        sets = map(self._of_cells, self.sets())
        a, b, d, h = torch.broadcast_tensors(*sets, self.total_thickness[..., None])  # those that vary have lanes
        h = h[..., :1, None]
        U, G = _invariants(self._constant)
        A, D = h * _plane(U, a), h**3 / 12.0 * _plane(U, d)
        B = h**2 / 4.0 * (_plane(U, b) - _plane(U, torch.zeros_like(b)))
        return LaminateStiffness(A, B, D, self.shear_correction * h * _shear(G, a))

    @property
    def mean_inputs(self) -> tuple[Tensor, ...]:
        """The tensors that `isotropic_stiffness` depends on."""
        return self._constant, self.total_thickness

    def isotropic_stiffness(self) -> LaminateStiffness:
        """The stiffness if all parameters are zero, which is the mean over all directions."""
        U, G = _invariants(self._constant)
        h, none = self.total_thickness[..., None, None], torch.zeros(4, dtype=torch.float64)
        Q = _plane(U, none)
        return LaminateStiffness(h * Q, 0.0 * h * Q, h**3 / 12.0 * Q, self.shear_correction * h * _shear(G, none))

    def _of_cells(self, x: Tensor) -> Tensor:
        return x if self.field is None else self.field.values(x)

    @property
    def total_thickness(self) -> Float[Tensor, "*lanes"]:
        """Thickness h of the laminate [m]; of a field that of each cell."""
        if self.field is None:
            return self.thickness
        if self._thickness_varies:
            return self.field.values(self.thickness[..., None])[..., 0]
        return self.thickness[..., None].expand(*self.thickness.shape, len(self.field.cells))

    @property
    def mass_per_area(self) -> Float[Tensor, "*lanes"]:
        """Density times thickness [kg/m2]."""
        return float(self.ply.density) * self.total_thickness

    @property
    def first_moment_per_area(self) -> Float[Tensor, "*lanes"]:
        """Zero: one density [kg/m]."""
        return torch.zeros_like(self.total_thickness)

    @property
    def rotary_inertia_per_area(self) -> Float[Tensor, "*lanes"]:
        """Second moment of the density about the mid-surface [kg]."""
        return float(self.ply.density) * self.total_thickness**3 / 12.0

    @property
    def centered(self) -> bool:
        """True: one density."""
        return True

    @property
    def merge_key(self) -> tuple:
        return (id(self),)

    @property
    def mean_laminate(self) -> Laminate:
        if self.field is None:
            return self
        means = [x.detach().mean(-2) for x in self.sets()]
        return LaminationParameters(
            self.ply,
            float(self.thickness.detach().mean()),
            means[0],
            means[2],
            means[1],
            None,
            self.shear_correction,
            False,
        )

    @property
    def plies(self) -> tuple[Ply, ...]:
        """The only ply."""
        return (self.ply,)

    @property
    def layer_plies(self) -> tuple[Ply, ...]:
        return (self.ply,)

    @property
    def layer_angles(self) -> Tensor:
        raise _without_plies(self)

    @property
    def layer_thickness(self) -> Tensor:
        raise _without_plies(self)

    def extra_repr(self) -> str:
        return ", ".join(f"{name}={x.tolist()}" for name, x in self.named_parameters() if x.numel() <= 4)


def _without_plies(laminate: LaminationParameters) -> InputError:
    state = "is given by lamination parameters, and its plies are not known"
    return InputError("laminate", laminate, "a Laminate, such as recover_stacks finds", noun="a laminate", state=state)


def _four(name: str, values: Sequence | Tensor, field: FiberField | None) -> nn.Parameter:
    x = parameter(name, values)
    if field is not None and x.shape == (4,) and not isinstance(values, nn.Parameter):
        x = nn.Parameter(x.detach().expand(field.controls, 4).clone())
    shape = (4,) if field is None else (field.controls, 4)
    if x.shape != shape:
        words = "must have shape [4]" if field is None else f"must have shape [{field.controls} controls, 4]"
        raise InputError(name, x, words, noun=f"{name} of LaminationParameters", state=f"has shape {tuple(x.shape)}")
    return x


def _thickness(thickness: float | Tensor, field: FiberField | None) -> nn.Parameter:
    h = parameter("thickness", thickness)
    if h is not thickness and h.ndim == 0:
        h = nn.Parameter(h.detach(), requires_grad=False)
    if h.ndim and (field is None or h.shape != (field.controls,)):
        raise InputError(
            "thickness",
            h,
            "a number [m], or one for each control",
            noun="thickness of LaminationParameters",
            state=f"has shape {tuple(h.shape)}",
        )
    if not bool((h > 0.0).all() and h.isfinite().all()):
        raise InputError(
            "thickness",
            h.tolist(),
            "finite numbers > 0",
            noun="LaminationParameters: thickness",
            shown=f"{h.tolist()!r} m",
        )
    warn_unusual("LaminationParameters: thickness", float(h.detach().max()), "m", THICKNESS)
    return h


def _invariants(constant: Tensor) -> tuple[Tensor, Tensor]:
    """U1 ... U5 of the ply's stiffness in plane, and mean and half difference of G13 and G23 [Pa]."""
    Q11, Q12, _, _, Q22, _, _, _, Q66, G13, _, _, G23 = constant.unbind()
    U = (
        (3 * Q11 + 3 * Q22 + 2 * Q12 + 4 * Q66) / 8,
        (Q11 - Q22) / 2,
        (Q11 + Q22 - 2 * Q12 - 4 * Q66) / 8,
        (Q11 + Q22 + 6 * Q12 - 4 * Q66) / 8,
        (Q11 + Q22 - 2 * Q12 + 4 * Q66) / 8,
    )
    return torch.stack(U), torch.stack([(G13 + G23) / 2, (G13 - G23) / 2])


def _plane(U: Tensor, V: Float[Tensor, "*lanes 4"]) -> Float[Tensor, "*lanes 3 3"]:
    """Stiffness in plane whose mean directions are V."""
    U1, U2, U3, U4, U5 = U.unbind()
    V1, V2, V3, V4 = V.unbind(-1)
    Q16, Q26 = U2 * V2 / 2 + U3 * V4, U2 * V2 / 2 - U3 * V4
    Q12 = U4 - U3 * V3
    rows = (U1 + U2 * V1 + U3 * V3, Q12, Q16, Q12, U1 - U2 * V1 + U3 * V3, Q26, Q16, Q26, U5 - U3 * V3)
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def _shear(G: Tensor, V: Float[Tensor, "*lanes 4"]) -> Float[Tensor, "*lanes 2 2"]:
    """Transverse shear stiffness whose mean directions are V."""
    mean, half = G.unbind()
    direct, mixed = half * V[..., 0], half * V[..., 1]
    return torch.stack([mean + direct, mixed, mixed, mean - direct], -1).unflatten(-1, (2, 2))
