"""A laminated body as a file of another program, by the ending of its name.

Checked in tests/extensions/shell_models/test_write_model.py.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torchmbd.design.flexible_bodies import flexible_bodies
from torchmbd.errors import InputError, unknown
from torchmbd.extensions.nastran.materials import units_of
from torchmbd.extensions.shell_models.bulk_data import bulk_data
from torchmbd.extensions.shell_models.input_file import ELEMENTS, input_file
from torchmbd.extensions.shell_models.shell_model import ShellModel
from torchmbd.math.checked_numbers import is_whole

BULK_DATA = (".bdf", ".dat", ".nas")


def write_model(
    design: Any,
    path: str | Path,
    body: str | None = None,
    units: str = "m",
    modes: int = 10,
    elements: str = "quadratic",
) -> Path:
    """Write a laminated body as a model for Nastran (.bdf, .dat, .nas), or for CalculiX and Abaqus (.inp).

    design    a body, a System, a result of mbd.optimize or mbd.optimization.multistart, or a study of mbd.load
    path      the file to write; its ending chooses the program
    body      name of the body; needed if the design has several
    units     of the file: "m", "mm", "cm", "in", "ft", as in read_bdf
    modes     number of modes that the file asks for, while the reference nodes of the body are held
    elements  of an .inp: "quadratic" (S8R, S6, which CalculiX needs for composites), or "linear" (S4, S3 of Abaqus)
    Returns the path. Raises InputError for a body that has other parts than laminated shells.

    >>> laminate = mbd.Laminate(mbd.examples.carbon(), mbd.deg([20, -50]), thickness=1e-3)
    >>> plate = mbd.FlexibleBody.plate("plate", mbd.mesh.rectangle(0.3, 0.1, (6, 2)), laminate, 2, reference="left_edge")
    >>> again = mbd.io.read_bdf(mbd.io.write_model(plate, "plate.bdf"), "plate", modes=2)
    >>> bool(torch.isclose(again.structure()["mass"], plate.structure()["mass"], rtol=1e-9))
    True
    """
    bodies = flexible_bodies("design", design)
    named = [item for item in bodies if body in (None, item.name)]
    if body is not None and not named:
        raise unknown("body", body, [item.name for item in bodies])
    if len(named) > 1:
        raise InputError("body", body, f"the name of one of {', '.join(item.name for item in named)}")
    scale = units_of(units)
    if not is_whole(modes) or modes < 1:
        raise InputError("modes", modes, "a whole number, 1 or more")
    if elements not in ELEMENTS:
        raise unknown("elements", elements, ELEMENTS)
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (*BULK_DATA, ".inp"):
        raise InputError("path", str(path), f"a name that ends in {', '.join(BULK_DATA)} or .inp")
    model = ShellModel.of(named[0])
    lines = input_file(model, scale, modes, elements) if suffix == ".inp" else bulk_data(model, scale, modes)
    path.write_text("\n".join([*lines, ""]), encoding="utf-8")
    return path
