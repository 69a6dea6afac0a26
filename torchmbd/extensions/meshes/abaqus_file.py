"""What an Abaqus input file (.inp) has besides the mesh that meshio reads of it: refused, where the structure is another.

meshio skips every keyword but *NODE, *ELEMENT, *NSET, *ELSET and *INCLUDE, and of several *NODE it keeps the last. Here
keywords before *STEP must be among those that change neither the mesh nor its mass, stiffness or ties: nodes and elements that
are generated, instances that are moved, masses, springs, couplings and the like are refused by file, line and keyword.
Supports (*BOUNDARY) are left out, as in Nastran files: joints hold a body.
Source: Abaqus Keywords Reference Guide. Checked in tests/extensions/meshes/test_mesh_file.py.
"""

from __future__ import annotations

from pathlib import Path

from torchmbd.errors import InputError

NESTED = 100  # files that include one another in a chain
#: Keywords that change nothing of the mesh; sections and materials are given to read_mesh as laminates.
_KNOWN = frozenset(
    word.strip()
    for word in """
    HEADING, NODE, ELEMENT, NSET, ELSET, INCLUDE, PREPRINT, RESTART, PARAMETER, PART, END PART, ASSEMBLY, INSTANCE,
    END INSTANCE, END ASSEMBLY, SHELL SECTION, SHELL GENERAL SECTION, MEMBRANE SECTION, SOLID SECTION, ORIENTATION,
    DISTRIBUTION, DISTRIBUTION TABLE, SECTION CONTROLS, HOURGLASS STIFFNESS, TRANSVERSE SHEAR STIFFNESS,
    NODAL THICKNESS, MATERIAL, DENSITY, ELASTIC, EXPANSION, DAMPING, PLASTIC, RATE DEPENDENT, CONDUCTIVITY,
    SPECIFIC HEAT, FAIL STRAIN, FAIL STRESS, HYPERELASTIC, VISCOELASTIC, POTENTIAL, DAMAGE INITIATION, DAMAGE EVOLUTION,
    DAMAGE STABILIZATION, DEPVAR, USER MATERIAL, USER OUTPUT VARIABLES, USER DEFINED FIELD, AMPLITUDE, SURFACE,
    BOUNDARY, INITIAL CONDITIONS, PHYSICAL CONSTANTS, TRANSFORM, NORMAL, OUTPUT, NODE OUTPUT, ELEMENT OUTPUT, MONITOR,
    FILTER, STEP
    """.replace("\n", " ").split(",")
)


def check_abaqus(path: Path) -> None:
    """InputError where meshio would lose nodes, elements, masses or ties of a file or of those that it includes."""
    _check(path, ())


def _check(path: Path, opened: tuple[Path, ...]) -> bool:
    """Check one file; return whether it has nodes."""
    path, has_nodes, instances = path.resolve(), False, 0
    if path in opened or len(opened) > NESTED:
        raise InputError(f"{path.name}: *INCLUDE in a circle, or a chain of more than {NESTED} files; allowed: neither")
    with path.open(encoding="utf-8", errors="replace") as file:
        instance = ""
        for number, line in enumerate(file, start=1):
            where = f"{path.name}, line {number}"
            if line.startswith("**") or not line.strip():
                continue
            if not line.startswith("*"):
                if instance:
                    raise InputError(f"{instance}: *INSTANCE is moved; allowed: one instance at the place of its part")
                continue
            keyword = " ".join(line.partition(",")[0].strip("* \n").upper().split())
            instance = where if keyword == "INSTANCE" else ""
            instances += keyword == "INSTANCE"
            if keyword == "STEP":
                return has_nodes
            if keyword not in _KNOWN or instances > 1:
                raise InputError(
                    f"{where}: *{keyword} is not read, and without it the structure may be another; allowed: nodes and "
                    "elements one by one, at most one instance, sets, sections, materials, *BOUNDARY, steps (left out)"
                )
            if keyword == "INCLUDE":
                has_nodes |= _check(_included(path, line, where), (*opened, path))
            elif keyword == "NODE":
                if has_nodes:
                    raise InputError(
                        f"{where}: *NODE stands twice, or below *INCLUDE with nodes; allowed: once, above it"
                    )
                has_nodes = True
    return has_nodes


def _included(path: Path, line: str, where: str) -> Path:
    """The file that *INCLUDE names: from the working folder, or beside the file that includes it, where meshio looks."""
    name = line.split("=")[-1].strip()
    for file in (Path(name), path.parent / name):
        if name and file.is_file():
            return file
    raise InputError(f"{where}: *INCLUDE of {name!r}; allowed: a file that exists")
