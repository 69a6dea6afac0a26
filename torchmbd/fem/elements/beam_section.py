"""The stiffness and mass that a beam takes from its section, sections given by numbers, and sections off the line of the nodes.

    stiffness   (N, V_y, V_z, T, M_y, M_z) = K (eps, gamma_y, gamma_z, kappa_x, kappa_y, kappa_z)   N, N m, N m2
    mass        inertia per length of (v, omega) of the section's axes                              kg/m, kg, kg m

`torchmbd.fem.sections.Section` is one; `GivenSection` holds two matrices, of another code or of a closed form.

A section whose origin lies at `offset` from the line of the nodes and whose y-axis is turned by `twist` from the beam's
acts on the line by the same forces, and by moments with an arm: f_line = W f_section, so K_line = W K W', and the same
for the mass.
Checked in tests/fem/elements/test_beam_section.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchmbd.errors import InputError
from torchmbd.math.checked_numbers import is_real, parameter
from torchmbd.math.gradients import all_true, constant_arguments, refuse_gradients
from torchmbd.math.gradients import untransformed as plain_numbers
from torchmbd.math.plausible_units import DIMENSION, warn_unusual, warn_unusual_material
from torchmbd.math.variable import Numbers, is_variable, number, stacked, varies, without_variables


@runtime_checkable
class BeamSection(Protocol):
    """A module with a stiffness and a mass, which may depend on parameters and carry lanes."""

    @property
    def mass_varies(self) -> bool: ...

    def stiffness(self) -> Float[Tensor, "*lanes 6 6"]: ...

    def mass(self) -> Float[Tensor, "*lanes 6 6"]: ...


@runtime_checkable
class ExpandingSection(BeamSection, Protocol):
    """A section that expands with temperature or moisture."""

    def free_strain(self, change: str) -> Float[Tensor, "*lanes 6"]:
        """(eps, gamma_y, gamma_z, kappa_x, kappa_y, kappa_z) of the free section by a unit change (elements/part.py)."""
        ...


class GivenSection(nn.Module):
    """A section of known matrices. `.matrix` is a parameter, the stiffness; it requires no gradient by default.

    stiffness   6 x 6, symmetric and positive definite; for other designs its symmetric part counts
    mass        6 x 6, symmetric and positive definite, of a plane section (polar inertia = sum of the other two)

    An entry may be mbd.variable(...): a design variable, "section.stiffness_55" or "section.mass_11", rows and columns from 1.
    An entry off the diagonal applies to both sides; entries with the same variable are one. A torch.nn.Parameter [6, 6] is a
    design variable as a whole: "section.matrix", "section.inertia".

    >>> area, I = 1e-4, 8.3e-10  # a square rod of 10 mm [m2], [m4]
    >>> rod = mbd.GivenSection.isotropic(E=210e9, nu=0.3, density=7850.0, area=area, Iyy=I, Izz=I, J=1.4e-9)
    >>> round(rod.stiffness()[0, 0].item() / 1e6, 3)  # E A [MN]
    21.0
    """

    matrix: Tensor
    inertia: Tensor
    alpha: float | None = None

    def __init__(self, stiffness: Sequence | Tensor, mass: Sequence | Tensor) -> None:
        super().__init__()
        self._entries = _VaryingEntries(self, "stiffness", stiffness), _VaryingEntries(self, "mass", mass)
        K, M = (entries.numbers for entries in self._entries)
        varying = isinstance(stiffness, nn.Parameter)
        self.matrix = (
            parameter(("section", "stiffness"), stiffness) if varying else nn.Parameter(K, requires_grad=False)
        )
        if isinstance(mass, nn.Parameter):
            self.inertia = parameter(("section", "mass"), mass)
        else:
            self.register_buffer("inertia", M, persistent=False)

    @property
    def mass_varies(self) -> bool:
        """True if the mass depends on the design."""
        return "inertia" in self._parameters or bool(self._entries[1].places)

    @classmethod
    @constant_arguments
    def isotropic(
        cls,
        E: float | Tensor,
        nu: float | Tensor,
        density: float | Tensor,
        area: float | Tensor,
        Iyy: float | Tensor,
        Izz: float | Tensor,
        J: float | Tensor,
        shear_y: float | Tensor = 5.0 / 6.0,
        shear_z: float | Tensor = 5.0 / 6.0,
        alpha: float | Tensor | None = None,
    ) -> GivenSection | IsotropicSection:
        """A section of metal in its principal axes: area [m2], second moments and torsion constant [m4], shear corrections,
        coefficient of thermal expansion [1/K].

        Each number may be mbd.variable(...): a design variable, "section.area".
        """
        section = Isotropic(E, nu, density, area, Iyy, Izz, J, shear_y, shear_z, alpha)
        if varies(section):
            return IsotropicSection(section)
        result = cls(section.stiffness(), section.mass())
        result.alpha = section.alpha
        return result

    def free_strain(self, change: str) -> Float[Tensor, " 6"]:
        """Strains of the free section by a unit change; InputError without a coefficient of expansion."""
        return _isotropic_strain(self.alpha, change)

    def stiffness(self) -> Float[Tensor, "*lanes 6 6"]:
        """Stiffness matrix of the section."""
        K = self._entries[0].put(self, self.matrix)
        return 0.5 * (K + K.mT)

    def mass(self) -> Float[Tensor, "*lanes 6 6"]:
        """Mass matrix of the section, per length."""
        M = self._entries[1].put(self, self.inertia)
        return 0.5 * (M + M.mT)


class _VaryingEntries:
    """Entries of a 6 x 6 matrix that are variables, parameters of `owner`.

    numbers   the matrix with their first values [6, 6]
    places    name of a parameter -> its places in the matrix, as a matrix of ones [6, 6]
    """

    def __init__(self, owner: nn.Module, label: str, matrix: Any):
        rows = matrix if isinstance(matrix, (list, tuple)) else []
        entries = {
            (i, j): x
            for i, row in enumerate(rows)
            for j, x in enumerate(row if isinstance(row, (list, tuple)) else [])
            if is_variable(x)
        }
        for (i, j), x in entries.items():
            if entries.get((j, i)) is not x:
                place, other = f"{i + 1},{j + 1}", f"{j + 1},{i + 1}"
                raise InputError(
                    (label,),
                    allowed="must have one variable in both places",
                    state=f"is a variable, and entry {other} is not the same variable",
                    noun=f"{label} of a section: entry {place}",
                )
        plain = [[number(x) for x in row] for row in rows] if entries else matrix
        self.numbers = checked(label, plain.detach() if isinstance(plain, nn.Parameter) else plain)
        self.places: dict[str, Tensor] = {}
        names: dict[int, str] = {}
        for (i, j), x in entries.items():
            name = names.setdefault(id(x), f"{label}_{i + 1}{j + 1}")
            self.places.setdefault(name, torch.zeros(6, 6, dtype=torch.float64))[i, j] = 1.0
            owner.register_parameter(name, x)

    def put(self, owner: nn.Module, matrix: Tensor) -> Tensor:
        """The matrix [*lanes, 6, 6] with the present entries."""
        for name, place in self.places.items():
            matrix = matrix * (1.0 - place) + getattr(owner, name)[..., None, None] * place
        return matrix


@dataclass(frozen=True)
class Isotropic:
    """Numbers of a section of metal, as in `GivenSection.isotropic`."""

    positive: ClassVar[tuple[str, ...]] = ("E", "density", "area", "Iyy", "Izz", "J", "shear_y", "shear_z")
    E: Any
    nu: Any
    density: Any
    area: Any
    Iyy: Any
    Izz: Any
    J: Any
    shear_y: Any
    shear_z: Any
    alpha: Any = None

    def __post_init__(self) -> None:
        for name in self.positive:
            value = number(getattr(self, name))
            if not 0.0 < value < float("inf"):
                raise InputError(name, value, "a finite number > 0", noun=f"GivenSection: {name}")
        if not -1.0 < number(self.nu) <= 0.5:
            raise InputError(
                "nu",
                number(self.nu),
                "above -1 and at most 0.5",
                noun="GivenSection: nu",
            )
        alpha = number(self.alpha)
        if alpha is not None and not (is_real(alpha) and math.isfinite(alpha)):
            allowed = "a finite number [1/K], mbd.variable(...) of one, or None"
            raise InputError("alpha", alpha, allowed, noun="GivenSection: alpha")
        numbers = without_variables(self)
        warn_unusual_material("GivenSection", {"E": numbers.E}, numbers.density, None)
        for name in ("Iyy", "Izz", "J"):
            radius = math.sqrt(getattr(numbers, name) / numbers.area)
            warn_unusual(f"GivenSection: area and {name}: radius of gyration", radius, "m", DIMENSION)
        warn_unusual("GivenSection: area", numbers.area, "m2", (DIMENSION[0] ** 2, DIMENSION[1] ** 2))

    def stiffness(self) -> Float[Tensor, "*lanes 6 6"]:
        """Stiffness matrix."""
        E, area, G = self.E, self.area, self.E / (2.0 * (1.0 + self.nu))
        shear = [G * area * self.shear_y, G * area * self.shear_z]
        return torch.diag_embed(stacked([E * area, *shear, G * self.J, E * self.Iyy, E * self.Izz]))

    def mass(self) -> Float[Tensor, "*lanes 6 6"]:
        """Mass matrix, per length."""
        area, second = self.area, (self.Iyy + self.Izz, self.Iyy, self.Izz)
        return torch.diag_embed(stacked([self.density * x for x in (area, area, area, *second)]))


class IsotropicSection(Numbers):
    """A section of metal, numbers of which vary; made by `GivenSection.isotropic`."""

    mass_varies = True

    def stiffness(self) -> Float[Tensor, "*lanes 6 6"]:
        """Stiffness matrix of the section."""
        return self().stiffness()

    def mass(self) -> Float[Tensor, "*lanes 6 6"]:
        """Mass matrix of the section, per length."""
        return self().mass()

    def free_strain(self, change: str) -> Float[Tensor, "*lanes 6"]:
        """Strains of the free section by a unit change; InputError without a coefficient of expansion."""
        return _isotropic_strain(self().alpha, change)


#: Change -> place and sign of the strain of a homogeneous section; the strain at (y, z) is eps + z kappa_y - y kappa_z.
_BY_TEMPERATURE = {"temperature": (0, 1.0), "gradient": (4, 1.0), "gradient_y": (5, -1.0)}


def _isotropic_strain(alpha: Any, change: str) -> Float[Tensor, "*lanes 6"]:
    if alpha is None or change not in _BY_TEMPERATURE:
        missing = "alpha" if change in _BY_TEMPERATURE else "coefficient of moisture expansion"
        raise InputError(
            missing,
            None,
            f"must have {missing}",
            hint="mbd.GivenSection.isotropic(..., alpha=...), or a Section of plies",
            noun=f"{change} acts on a section of given numbers, which",
            state=f"has no {missing}",
        )
    place, sign = _BY_TEMPERATURE[change]
    unit = torch.zeros(6, dtype=torch.float64)
    unit[place] = sign
    return torch.as_tensor(alpha, dtype=torch.float64)[..., None] * unit


def free_strain_of(section: BeamSection, change: str) -> Float[Tensor, "*lanes 6"]:
    """Strains of a free section by a unit change; InputError for one that does not expand, or has no coefficient."""
    if not isinstance(section, ExpandingSection):
        allowed = "a section that has free_strain(change), such as a Section of plies"
        raise InputError("section", section, allowed, noun=f"section {section!r}", state="does not expand")
    return section.free_strain(change)


def definite_stiffness(section: BeamSection) -> Float[Tensor, "*lanes 6 6"]:
    """Stiffness of a section in the present design; InputError if it is not positive definite."""
    S = section.stiffness()
    good = torch.linalg.cholesky_ex(plain_numbers(S))[1] == 0
    if not all_true(good):
        lane = int(good.flatten().logical_not().nonzero()[0])
        where = f" in lane {lane}" * (good.numel() > 1)
        raise InputError(
            "stiffness",
            noun="stiffness of a section",
            allowed="positive definite",
            state=f"has a deformation without energy{where}",
        )
    return S


def line_transform(offset: Float[Tensor, "*n 2"], twist: Float[Tensor, "*n"]) -> Float[Tensor, "*n 6 6"]:
    """W: forces of the section about the line of the nodes, in the beam's axes. offset: (y, z) [m]; twist [rad]."""
    if not all_true(torch.isfinite(offset)):
        raise InputError("offset", offset.tolist(), "finite numbers, y and z [m]", shown=f"{offset.tolist()}")
    if not all_true(twist.abs() <= 2 * torch.pi):
        raise InputError(
            "twist", plain_numbers(twist).tolist(), "-2 pi to 2 pi [rad]", shown=f"{plain_numbers(twist).tolist()}"
        )
    y, z, twist = torch.broadcast_tensors(*offset.unbind(-1), twist)
    c, s = torch.cos(twist), torch.sin(twist)
    o, unit = torch.zeros_like(c), torch.ones_like(c)
    turn = _matrix([[unit, o, o], [o, c, -s], [o, s, c]])
    arm = _matrix([[o, -z, y], [z, o, o], [-y, o, o]])
    return torch.cat([torch.cat([turn, torch.zeros_like(turn)], -1), torch.cat([arm @ turn, turn], -1)], -2)


def _matrix(rows: Sequence[Sequence[Tensor]]) -> Tensor:
    return torch.stack([torch.stack(list(row), dim=-1) for row in rows], dim=-2)


def checked(name: str, matrix: Sequence | Tensor) -> Tensor:
    """Read a symmetric positive definite 6 x 6 matrix; InputError names the entry or the eigenvalue."""
    refuse_gradients(("section", name), matrix, "a 6 x 6 matrix")
    try:
        A = torch.as_tensor(matrix, dtype=torch.float64).detach().clone()
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(name, matrix, "a 6 x 6 matrix", noun=f"{name} of a section") from error
    if A.shape != (6, 6) or not torch.isfinite(A).all():
        raise InputError(
            name,
            A,
            "a 6 x 6 matrix of finite numbers",
            noun=f"{name} of a section",
            state=f"has shape {tuple(A.shape)}",
        )
    diagonal = A.diagonal()
    if not (diagonal > 0).all():
        k = int((~(diagonal > 0)).nonzero()[0])
        raise InputError(
            (name, k + 1, k + 1), float(diagonal[k]), "above 0", noun=f"{name} of a section: entry {k + 1},{k + 1}"
        )
    unit = A / (diagonal[:, None] * diagonal).sqrt()
    if float((unit - unit.T).abs().max()) > 1e-6:
        i, j = divmod(int((unit - unit.T).abs().argmax()), 6)
        pair = (float(A[i, j]), float(A[j, i]))
        raise InputError(
            (name, i + 1, j + 1),
            allowed="equal",
            state=f"are {pair}",
            noun=f"{name} of a section: entries {i + 1},{j + 1} and {j + 1},{i + 1}",
        )
    if not float(torch.linalg.eigvalsh(unit).min()) > 1e-12:
        raise InputError(
            name,
            allowed="positive definite",
            noun=f"{name} of a section",
            state="has deformations that do not cost energy",
        )
    return (A + A.T) / 2
