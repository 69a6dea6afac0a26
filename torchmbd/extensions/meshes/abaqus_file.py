"""What an Abaqus input file (.inp) has besides the mesh that meshio reads of it: refused, where the structure is another.

meshio skips every keyword but *NODE, *ELEMENT, *NSET, *ELSET and *INCLUDE, and of several *NODE it keeps the last. Here
keywords before *STEP must be among those that change neither the mesh nor its mass, stiffness or ties: nodes and elements that
are generated, instances that are moved, masses, springs, couplings and the like are refused by file, line and keyword.
Supports (*BOUNDARY) are left out, as in Nastran files: joints hold a body. Options of *NODE and *ELEMENT that meshio passes
over are refused (SYSTEM, INPUT, OFFSET). Named edges, which mesh generators write as trusses without a section, are node sets.

meshio counts the ELSETs of *ELEMENT as if each block had one of its own: zones of a file with several blocks are made here.
Source: Abaqus Keywords Reference Guide. Checked in tests/extensions/meshes/test_mesh_file.py.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from torchmbd.errors import InputError, wrong_entry

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


#: Options of a keyword that meshio reads, or that change nothing of the mesh.
_OPTIONS = {"NODE": {"NSET"}, "ELEMENT": {"TYPE", "ELSET"}}
_TRUSS_SECTION = "SOLID SECTION"  # in a mesh of shells
_EDGES = ("T2D2", "T3D2")  # by which mesh generators write named edges


class AbaqusFile:
    """The lines of a file and of the files that it includes, without the mesh. InputError if meshio would lose a part of it.

    elsets       the ELSET of each *ELEMENT in the order of the file, "" where it has none
    sections     places of *SOLID SECTION, which trusses have
    trusses      number of *ELEMENT of trusses
    includes     whether it includes others
    """

    def __init__(self, path: Path) -> None:
        self.elsets: list[str] = []
        self.sections: list[str] = []
        self.trusses, self.includes = 0, False
        self._sets: set[str] = set()
        self._read(path, ())

    def check_lines(self, source: Any) -> None:
        """InputError for lines that are trusses; those of a file without their section are named edges."""
        lines = sum(cells.type == "line" for cells in source.cells)
        if lines and (self.sections or lines > self.trusses):
            raise InputError(
                "elements",
                allowed="must have triangles, quadrilaterals, and named edges without a section alone",
                noun="the file",
                state="has beams, rods or masses",
            )

    def correct_zones(self, source: Any) -> None:
        """Give meshio's sets of cells the members that the ELSETs of *ELEMENT have."""
        if self.includes or len(self.elsets) != len(source.cells):
            return
        for name in set(self.elsets) - {""}:
            if name in self._sets:
                raise InputError(
                    ("ELSET", name),
                    allowed="given in one of them alone",
                    noun=f"ELSET {name!r}",
                    state="is given in *ELEMENT and in *ELSET",
                )
            blocks = zip(self.elsets, source.cells, strict=True)
            source.cell_sets[name] = [np.arange(len(cells.data) if elset == name else 0) for elset, cells in blocks]

    def _read(self, path: Path, opened: tuple[Path, ...]) -> bool:
        """Check one file; return whether it has nodes."""
        path, has_nodes, instances = path.resolve(), False, 0
        if path in opened or len(opened) > NESTED:
            state = f"has *INCLUDE in a circle, or a chain of more than {NESTED} files"
            raise wrong_entry(path.name, state, f"must have a chain of at most {NESTED}")
        with path.open(encoding="utf-8", errors="replace") as file:
            instance = ""
            for number, line in enumerate(file, start=1):
                where = f"{path.name}, line {number}"
                if line.startswith("**") or not line.strip():
                    continue
                if not line.startswith("*"):
                    if instance:
                        raise wrong_entry(
                            instance,
                            "*INSTANCE is moved",
                            "one instance, which is not moved or rotated relative to its part",
                            key="INSTANCE",
                        )
                    continue
                keyword = " ".join(line.partition(",")[0].strip("* \n").upper().split())
                instance = where if keyword == "INSTANCE" else ""
                instances += keyword == "INSTANCE"
                if keyword == "STEP":
                    return has_nodes
                if keyword not in _KNOWN or instances > 1:
                    raise wrong_entry(
                        where,
                        f"*{keyword} is not read, and without it the structure may be another",
                        "nodes and elements one by one, at most one instance, sets, sections, materials, *BOUNDARY, steps "
                        "(left out)",
                    )
                self._note(keyword, line, where)
                if keyword == "INCLUDE":
                    self.includes = True
                    has_nodes |= self._read(_included(path, line, where), (*opened, path))
                elif keyword == "NODE":
                    if has_nodes:
                        raise wrong_entry(
                            where,
                            "*NODE appears twice, or below *INCLUDE with nodes",
                            "must appear once, above it",
                            key="NODE",
                        )
                    has_nodes = True
        return has_nodes

    def _note(self, keyword: str, line: str, where: str) -> None:
        """Note sets and sections; refuse options that meshio passes over."""
        words = [word.partition("=") for word in line.split(",")[1:]]
        options = {key.strip().upper(): value.strip() for key, _, value in words}
        for option in options.keys() - _OPTIONS.get(keyword, options.keys()) - {""}:
            allowed = f"one of {', '.join(sorted(_OPTIONS[keyword]))}"
            raise wrong_entry(where, f"*{keyword}, {option} is not read", allowed)
        if keyword == "ELEMENT":
            self.elsets.append(options.get("ELSET", ""))
            self.trusses += options.get("TYPE", "").upper() in _EDGES
        elif keyword == "ELSET":
            self._sets.add(options.get("ELSET", ""))
        elif keyword == _TRUSS_SECTION:
            self.sections.append(where)


def _included(path: Path, line: str, where: str) -> Path:
    """The file that *INCLUDE names: from the working folder, or beside the file that includes it, where meshio looks."""
    name = line.split("=")[-1].strip()
    for file in (Path(name), path.parent / name):
        if name and file.is_file():
            return file
    raise wrong_entry(where, f"*INCLUDE of {name!r}", "must name a file that exists")
