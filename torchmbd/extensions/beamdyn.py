"""Sections along a beam out of a BeamDyn blade file.

Source: BeamDyn of OpenFAST, blade input file. Checked in tests/extensions/test_beamdyn.py.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torchmbd.errors import InputError, within, wrong_entry
from torchmbd.fem.exact_beam import SectionTable

__all__ = ["read_beamdyn"]

#: Indices of our forces and moments (x along the beam, y, z) among those of BeamDyn (z along the blade, x, y).
_BEAMDYN = [2, 0, 1, 5, 3, 4]


def read_beamdyn(path: str | Path) -> SectionTable:
    """Return a SectionTable of the stations of a BeamDyn blade file, with x instead of z along the blade.

    path   the blade file, named by BldFile of a primary input file

    The primary file contains the twist. BeamDyn turns its sections about -z, so a beam with this table takes
    `twist=-mbd.deg(initial_twist)`.
    Raises InputError that names file and line.

    >>> rows = "\\n".join(" ".join(map(str, row)) for row in np.diag([2.0, 2, 9, 4, 3, 1]).tolist())
    >>> with open("blade.inp", "w") as file:
    ...     _ = file.write(f"a blade\\n2 station_total\\n--- Distributed Properties ---\\n"
    ...                    f"0.0\\n{rows}\\n\\n{rows}\\n\\n1.0\\n{rows}\\n\\n{rows}\\n")
    >>> mbd.io.read_beamdyn("blade.inp").stiffness(torch.tensor([0.0]))[0].diagonal().tolist()
    [9.0, 2.0, 2.0, 1.0, 4.0, 3.0]
    """
    positions, sections = [], []
    for numbers in _stations(path):
        matrices = numbers[1:].reshape(2, 6, 6)[:, _BEAMDYN][:, :, _BEAMDYN]
        positions.append(float(numbers[0]))
        sections.append((matrices[0], matrices[1]))
    try:
        return SectionTable(positions, sections)
    except InputError as error:
        raise within(Path(path).name, error) from None


def _stations(path: str | Path) -> list[np.ndarray]:
    """Read position, stiffness and mass of each station: 73 numbers."""
    if not isinstance(path, (str, Path)) or not Path(path).is_file():
        raise InputError("path", str(path), "a BeamDyn blade file that exists")
    file = Path(path)
    lines = file.read_text(encoding="utf-8", errors="replace").splitlines()
    total = next((line.split()[0] for line in lines if "station_total" in line), "")
    start = next((k for k, line in enumerate(lines) if "distributed properties" in line.lower()), None)
    allowed = "a BeamDyn blade file with station_total and a section Distributed Properties"
    if start is None or not total.isdecimal() or int(total) < 2:
        raise InputError(
            file.name, allowed=f"{allowed}, at least two stations", state=f"has no stations, station_total {total!r}"
        )
    rows = [(k, line.split()) for k, line in enumerate(lines[start + 1 :], start=start + 2) if line.strip()]
    if len(rows) < 13 * int(total):
        raise InputError(
            file.name, allowed="must have 13 for each", state=f"has {len(rows)} lines for {total} stations"
        )
    numbers: list[float] = []
    for row, (k, words) in enumerate(
        rows[: 13 * int(total)]
    ):  # a position, then two matrices; words behind are comments
        count = 6 if row % 13 else 1
        try:
            numbers += [float(word.lower().replace("d", "e")) for word in words[:count]]
        except ValueError as error:
            raise wrong_entry(f"{file.name}, line {k}", f"{error}", f"must have {count} numbers") from None
        if len(words) < count:
            raise wrong_entry(f"{file.name}, line {k}", f"has {len(words)} numbers", f"must have {count}")
    return list(np.array(numbers).reshape(-1, 73))
