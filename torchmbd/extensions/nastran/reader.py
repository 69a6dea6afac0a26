"""A flexible body out of a Nastran model.

Checked in tests/extensions/nastran/test_read_bdf.py.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torchmbd.extensions.nastran.body import bulk_body
from torchmbd.extensions.nastran.writer import NastranBody, Source
from torchmbd.multibody.bodies import FlexibleBody
from torchmbd.multibody.bodies.unit_checks import warn_units


def read_bdf(
    path: str | Path,
    name: str,
    modes: int = 8,
    units: str = "m",
    mass: str = "lumped",
    density: float | None = None,
    **options: Any,
) -> FlexibleBody:
    """A body of a Nastran model; the angles of its PCOMP cards are the design parameters (extensions/nastran/body.py).

    path      the file
    name      of the body
    modes     number of vibration modes
    units     of the file: "m" (m, kg, s, N, Pa), "mm" (mm, t, s, N, MPa), "cm" (cm, N s2/cm, s, N, N/cm2), "in" (in,
              lbf s2/in, s, lbf, psi), "ft" (ft, slug, s, lbf, lbf/ft2); a PARAM WTMASS of the file counts
    mass      "lumped", or "consistent", for comparison
    density   of materials without RHO [kg/m3], as in decks for statics; None: they raise an error
    options   position, axes, damping, reference, reduction, interface, updated, stiffening: as in `FlexibleBody.plate`; without
              a reference it is the grids whose six degrees of freedom the file fixes (SPC, SPC1)
    Raises InputError that names card and line; warns if units are implausible, and of cards that are left out.

    >>> cards = "MAT1,1,2.1+11,,.3,7850.", "PBAR,5,1,1.-4,1.-9,1.-9,2.-9", "GRID,1,,0.,0.,0.", "GRID,2,,1.,0.,0."
    >>> with open("bar.bdf", "w") as file:
    ...     _ = file.write("\\n".join(["BEGIN BULK", *cards, "CBAR,1,5,1,2,0.,1.,0.", "SPC1,1,123456,1", "ENDDATA"]))
    >>> body = mbd.io.read_bdf("bar.bdf", "bar", modes=2)
    >>> round(body.structure()["mass"].item(), 3)
    0.785
    """
    deck = bulk_body(path, units, mass, density)
    options = {"reference": deck.reference} | options
    body = NastranBody(name, deck.mesh, deck.parts, modes, links=deck.links, **options)
    body.source = Source(deck.digest, units, deck.properties)
    warn_units(name, deck.mesh, body.plates.values(), body.structure)
    return body
