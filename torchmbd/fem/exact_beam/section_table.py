"""Sections along a beam: stiffness and mass at given positions, linear between them.

Checked in tests/fem/exact_beam/test_section_table.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchmbd.errors import InputError
from torchmbd.fem.elements import BeamSection, GivenSection
from torchmbd.math.checked_numbers import reals

#: Indices of our forces and moments (x along the beam, y, z) among those of BeamDyn (z along the blade, x, y).
_BEAMDYN = [2, 0, 1, 5, 3, 4]


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
        at = reals("positions of a SectionTable", positions)
        if (
            at.ndim != 1
            or len(at) < 2
            or float(at[0]) != 0.0
            or float(at[-1]) != 1.0
            or not bool((at.diff() > 0).all())
        ):
            raise InputError(f"positions of a SectionTable are {at.tolist()}; allowed: rising numbers from 0 to 1")
        if len(sections) != len(at):
            raise InputError(
                f"{len(sections)} sections for {len(at)} positions of a SectionTable; allowed: one for each"
            )
        self.register_buffer("positions", at, persistent=False)
        self.sections = [_section(float(s), given) for s, given in zip(at, sections, strict=True)]
        for k, section in enumerate(self.sections):
            self.add_module(str(k), section)

    @classmethod
    def beamdyn(cls, file: str | Path) -> SectionTable:
        """Read the stations of a BeamDyn blade file: their axes (z along the blade) become ours (x along the beam).

        file   the blade file, named by BldFile of a primary input file

        >>> rows = "\\n".join(" ".join(map(str, row)) for row in np.diag([2.0, 2, 9, 4, 3, 1]).tolist())
        >>> with open("blade.inp", "w") as file:
        ...     _ = file.write(f"a blade\\n2 station_total\\n--- Distributed Properties ---\\n"
        ...                    f"0.0\\n{rows}\\n\\n{rows}\\n\\n1.0\\n{rows}\\n\\n{rows}\\n")
        >>> mbd.SectionTable.beamdyn("blade.inp").stiffness(torch.tensor([0.0]))[0].diagonal().tolist()
        [9.0, 2.0, 2.0, 1.0, 4.0, 3.0]
        """
        positions, sections = [], []
        for numbers in _stations(Path(file)):
            matrices = numbers[1:].reshape(2, 6, 6)[:, _BEAMDYN][:, :, _BEAMDYN]
            positions.append(float(numbers[0]))
            sections.append((matrices[0], matrices[1]))
        try:
            return cls(positions, sections)
        except InputError as error:
            raise InputError(f"{file}: {error}") from None

    @property
    def mass_varies(self) -> bool:
        """Whether the mass depends on the design."""
        return any(section.mass_varies for section in self.sections)

    def stiffness(self, at: Float[Tensor, "*places"]) -> Float[Tensor, "*lanes *places 6 6"]:
        """Stiffness at parts of the length."""
        return self._between([section.stiffness() for section in self.sections], at)

    def mass(self, at: Float[Tensor, "*places"]) -> Float[Tensor, "*lanes *places 6 6"]:
        """Mass per length at parts of the length."""
        return self._between([section.mass() for section in self.sections], at)

    def _between(self, matrices: list[Tensor], at: Tensor) -> Tensor:
        every = torch.stack(torch.broadcast_tensors(*matrices), -3)
        k = (at.detach()[..., None] >= self.positions).sum(-1).clamp(1, len(self.sections) - 1)
        share = (at - self.positions[k - 1]) / (self.positions[k] - self.positions[k - 1])
        before, after = every[..., k - 1, :, :], every[..., k, :, :]
        return before + share[..., None, None] * (after - before)


def _section(position: float, given: Any) -> Any:
    if isinstance(given, nn.Module) and isinstance(given, BeamSection):
        return given
    if not isinstance(given, Sequence) or len(given) != 2:
        raise InputError(
            f"section at position {position:g} is {given!r}; allowed: a Section, a GivenSection, or (stiffness, mass)"
        )
    try:
        return GivenSection(*given)
    except InputError as error:
        raise InputError(f"section at position {position:g}: {error}") from None


def _stations(file: Path) -> list[np.ndarray]:
    """Read position, stiffness and mass of each station: 73 numbers."""
    if not file.is_file():
        raise InputError(f"file is {str(file)!r}; allowed: a BeamDyn blade file that exists")
    lines = file.read_text(encoding="utf-8", errors="replace").splitlines()
    total = next((line.split()[0] for line in lines if "station_total" in line), "")
    start = next((k for k, line in enumerate(lines) if "distributed properties" in line.lower()), None)
    allowed = "a BeamDyn blade file, with station_total and Distributed Properties"
    if start is None or not total.isdecimal() or int(total) < 2:
        raise InputError(f"{file} has no stations, station_total {total!r}; allowed: {allowed}, two stations at least")
    rows = [(k, line.split()) for k, line in enumerate(lines[start + 1 :], start=start + 2) if line.strip()]
    if len(rows) < 13 * int(total):
        raise InputError(f"{file} has {len(rows)} lines for {total} stations; allowed: 13 for each")
    numbers: list[float] = []
    for row, (k, words) in enumerate(
        rows[: 13 * int(total)]
    ):  # a position, then two matrices; words behind are comments
        count = 6 if row % 13 else 1
        try:
            numbers += [float(word.lower().replace("d", "e")) for word in words[:count]]
        except ValueError as error:
            raise InputError(f"{file}, line {k}: {error}; allowed: {count} numbers") from None
        if len(words) < count:
            raise InputError(f"{file}, line {k}: {len(words)} numbers; allowed: {count}")
    return list(np.array(numbers).reshape(-1, 73))
