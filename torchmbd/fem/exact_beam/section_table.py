"""Sections along a beam: stiffness and mass at given positions, linear between them.

Checked in tests/fem/exact_beam/test_section_table.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchmbd.errors import InputError, within
from torchmbd.fem.elements import BeamSection, GivenSection
from torchmbd.fem.elements.beam_section import free_strain_of
from torchmbd.math.checked_numbers import reals


class SectionTable(nn.Module):
    """Sections at positions along a beam; between them stiffness and mass are linear in the position.

    positions  parts of the length of the line from its start, rising from 0 to 1
    sections   one for each position: a Section, a GivenSection, or a pair of 6 x 6 matrices (stiffness, mass)

    Parameters are those of the sections: "0.angles", "1.angles", ... Raises InputError for a section that is not positive
    definite, with its position.

    >>> thick, thin = (mbd.GivenSection.isotropic(70e9, 0.3, 2700.0, a, 1e-9, 2e-9, 2e-9) for a in (2e-4, 1e-4))
    >>> table = mbd.SectionTable([0.0, 1.0], [thick, thin])
    >>> float(table.stiffness(torch.tensor([0.5], dtype=torch.float64))[0, 0, 0])  # E A in the middle [N]
    10500000.0
    """

    positions: Tensor

    def __init__(self, positions: Sequence[float] | Tensor, sections: Sequence[Any]) -> None:
        super().__init__()
        at = reals("positions", positions)
        if (
            at.ndim != 1
            or len(at) < 2
            or float(at[0]) != 0.0
            or float(at[-1]) != 1.0
            or not bool((at.diff() > 0).all())
        ):
            raise InputError(
                "positions",
                at.tolist(),
                "rising numbers from 0 to 1",
                noun="positions of a SectionTable",
                state=f"are {at.tolist()}",
            )
        if len(sections) != len(at):
            raise InputError(
                "sections", allowed="one for each position", state=f"are {len(sections)} for {len(at)} positions"
            )
        self.register_buffer("positions", at, persistent=False)
        self.sections = [_section(float(s), section) for s, section in zip(at, sections, strict=True)]
        for k, section in enumerate(self.sections):
            self.add_module(str(k), section)

    @property
    def mass_varies(self) -> bool:
        """True if the mass depends on the design."""
        return any(section.mass_varies for section in self.sections)

    def stiffness(self, at: Float[Tensor, "*places"]) -> Float[Tensor, "*lanes *places 6 6"]:
        """Stiffness at parts of the length."""
        return self._between([section.stiffness() for section in self.sections], at)

    def mass(self, at: Float[Tensor, "*places"]) -> Float[Tensor, "*lanes *places 6 6"]:
        """Mass per length at parts of the length."""
        return self._between([section.mass() for section in self.sections], at)

    def free_strain(self, change: str, at: Float[Tensor, "*places"]) -> Float[Tensor, "*lanes *places 6"]:
        """Strains of the free sections by a unit change at parts of the length; InputError without coefficients."""
        strains = [free_strain_of(section, change)[..., None] for section in self.sections]
        return self._between(strains, at)[..., 0]

    def _between(self, matrices: list[Tensor], at: Tensor) -> Tensor:
        every = torch.stack(torch.broadcast_tensors(*matrices), -3)
        k = (at.detach()[..., None] >= self.positions).sum(-1).clamp(1, len(self.sections) - 1)
        share = (at - self.positions[k - 1]) / (self.positions[k] - self.positions[k - 1])
        before, after = every[..., k - 1, :, :], every[..., k, :, :]
        return before + share[..., None, None] * (after - before)


def _section(position: float, section: Any) -> Any:
    if isinstance(section, nn.Module) and isinstance(section, BeamSection):
        return section
    if not isinstance(section, Sequence) or len(section) != 2:
        raise InputError(
            ("sections", f"{position:g}"),
            section,
            "a Section, a GivenSection, or (stiffness, mass)",
            noun=f"section at position {position:g}",
        )
    try:
        return GivenSection(*section)
    except InputError as error:
        raise within(f"section at position {position:g}", error, "sections", f"{position:g}") from None
