"""A Nastran model as mesh, parts, links and reference of a flexible body.

Each PCOMP and PSHELL is a part of its own, "pcomp_7", and where elements have several ZOFFS one more for each further one,
"pcomp_7_offset_1", with parameters of its own; each PBAR another, its bars where their offsets put them (bars.py). Rods,
springs, bushings and solids: springs.py. RBE2, RBAR, RBE3 and MPC become links (rigids.py), and the grid of each rigid element
a named node, "rbe2_30", where a frame may sit; CONM2 are point masses, and NSM (nsm.py). Grids whose six degrees of freedom
are held (SPC, SPC1) become the reference of the body; other supports are left out, with a warning: joints do that in a
mechanism. Checked in tests/extensions/nastran/test_read_bdf.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchmbd.errors import InputError, warn, within, wrong_entry
from torchmbd.extensions.nastran.cards import Deck, read_deck
from torchmbd.extensions.nastran.control import MATRICES, TEMPERATURE, Control
from torchmbd.extensions.nastran.data import BulkData
from torchmbd.extensions.nastran.materials import UNITS, Units, units_of, with_density
from torchmbd.extensions.nastran.mesh import BulkMesh, bulk_mesh
from torchmbd.extensions.nastran.nsm import extra_masses
from torchmbd.extensions.nastran.panels import shear_panels
from torchmbd.extensions.nastran.rigids import followers
from torchmbd.extensions.nastran.sections import section_of
from torchmbd.extensions.nastran.shells import laminate_of
from torchmbd.extensions.nastran.springs import constant_parts
from torchmbd.fem.elements import BeamMatrices, Beams, Follower, Part, Plates, PointMasses
from torchmbd.fem.mesh import Mesh

__all__ = ["UNITS", "BulkBody", "bulk_body"]


@dataclass(frozen=True, eq=False)
class BulkBody:
    """The body of a file.

    reference   None where nothing is held
    properties  number of the property card of each laminated part
    digest      of the text of the file, and of those that it includes
    """

    mesh: Mesh
    parts: dict[str, Part]
    links: list[Follower]
    reference: list[int] | None
    properties: dict[str, int]
    digest: str


@dataclass(eq=False)
class _Line:
    nodes: Tensor
    elements: Tensor
    middles: Tensor | None = None


def bulk_body(path: str | Path, units: str = "m", mass: str = "lumped", density: float | None = None) -> BulkBody:
    """Read a model; `density`: of materials without RHO [kg/m3].

    Raises InputError that names file, card and line; warns of cards that are left out.
    """
    scale = units_of(units)
    deck = read_deck(path)
    try:
        return _body(path, deck, scale, mass, density)
    except InputError as error:
        name = Path(path).name
        raise error if any(name in str(key) for key in error.path) else within(name, error) from None


def _body(path: str | Path, deck: Deck, scale: Units, mass: str, density: float | None) -> BulkBody:
    data, control = BulkData.of(deck.cards), deck.control
    _check_control(data, control)
    if density is not None:
        if not isinstance(density, (int, float)) or isinstance(density, bool) or not 0.0 < density < math.inf:
            raise InputError("density", density, "a number > 0 [kg/m3], of materials without RHO")
        data.materials = with_density(data.materials, float(density), scale, data.weight_to_mass)
    bulk = bulk_mesh(data, scale.length)
    parts: dict[str, Part] = {}
    properties: dict[str, int] = {}
    heights: dict[tuple[int, float], float] = {}
    for (number, offset), cells in bulk.zones.items():
        card = data.properties[number]
        laminate = laminate_of(data, card, scale, offset * scale.length)
        heights[number, offset] = float(laminate.offset)
        name = f"{card.name.lower()}_{number}"
        name = name if name not in parts else f"{name}_offset_{sum(key.startswith(name) for key in parts)}"
        parts[name] = Plates(bulk.mesh, laminate, bulk.direction, cells, mass)
        properties[name] = number
    parts |= _beams(data, bulk, scale)
    if data.panels:
        parts["cshear"] = shear_panels(data, bulk.mesh, bulk.index, scale)
    parts |= constant_parts(data, bulk.mesh, bulk.index, scale)
    if data.masses:
        parts["conm2"] = _masses(data, bulk, scale)
    if (extra := extra_masses(data, bulk, control, scale, heights)) is not None:
        parts["nsm"] = extra
    _warn_ignored(data, path)
    links = followers(data.rigids, data.constraints, bulk.index, data.displacement_axes, scale.length)
    held = _held(data, bulk.index)
    return BulkBody(bulk.mesh, parts, [*links, *bulk.bars.links], held, properties, deck.digest)


def _check_control(data: BulkData, control: Control | None) -> None:
    """InputError if the case control makes another structure, or may do so where there is none.

    It adds a DMIG to mass or stiffness, or gives a temperature to materials that depend on it.
    """
    commands = control.chosen if control else {}
    chosen = {name: where for command in MATRICES for name, where in commands.get(command, {}).items()}
    for name, card in data.matrices.items():
        if name in chosen or control is None:
            how = (
                f"the case control ({chosen[name]}) adds" if control else "the file has no case control, which may add"
            )
            raise wrong_entry(
                card,
                f"{how} it to mass or stiffness",
                f"a DMIG that {', '.join(MATRICES)} do not choose",
                hint="mbd.io.read_matrix, which reads DMIG",
            )
        data.ignored["DMIG that the case control does not add to mass or stiffness"] += 1
    if data.thermal and (control is None or TEMPERATURE in commands):
        how = "gives a temperature" if control else "is missing, and may give a temperature"
        raise wrong_entry(data.thermal[0], f"the case control {how}", "must have materials that do not depend on it")
    for card in data.thermal:
        data.ignored[card.name] += 1
    for name in chosen.keys() - data.matrices.keys():
        raise wrong_entry(chosen[name], f"matrix {name} is chosen, and does not exist", "a matrix of the file")


def _masses(data: BulkData, bulk: BulkMesh, scale: Units) -> PointMasses:
    """Return the CONM2 as masses on arms at their grids."""
    unit, arms = scale.mass * data.weight_to_mass, []
    for mass in data.masses:
        if any(mass.offset) and data.systems.curved(mass.system, mass.card):
            raise wrong_entry(
                mass.card, f"CID {mass.system} is curved", "a rectangular system, or X1 to X3 zero", key="CID"
            )
        axes = data.systems.axes(mass.system, mass.card, np.array(data.grids[mass.grid]))
        arms.append((np.array(mass.offset) @ axes * scale.length).tolist())
    nodes = [bulk.index[mass.grid] for mass in data.masses]
    masses, inertias = [m.mass * unit for m in data.masses], [m.rotary * unit * scale.length**2 for m in data.masses]
    return PointMasses(bulk.mesh, nodes, masses, inertias, arms if np.any(arms) else None)


def _beams(data: BulkData, bulk: BulkMesh, scale: Units) -> dict[str, Part]:
    """Return the beams of each property as a part, with their orientations."""
    parts: dict[str, Part] = {}
    pairs = torch.tensor(bulk.bars.nodes, dtype=torch.long)
    vectors, offsets = (torch.from_numpy(np.array(values)) for values in (bulk.bars.orientation, bulk.bars.offset))
    numbers = torch.tensor([bar.property for bar in data.bars], dtype=torch.long)
    for number in dict.fromkeys(numbers.tolist()):
        rows = numbers == number
        card = data.properties[number]
        line, offset = _Line(bulk.mesh.nodes, pairs[rows]), offsets[rows] * scale.length
        _, e_y, e_z = BeamMatrices(line, vectors[rows]).axes.unbind(1)
        across = torch.stack([(e_y * offset).sum(1), (e_z * offset).sum(1)], dim=1)
        parts[f"{card.name.lower()}_{number}"] = Beams(line, section_of(data, card, scale), vectors[rows], across)
    return parts


def _held(data: BulkData, index: dict[int, int]) -> list[int] | None:
    """Return the nodes whose six degrees of freedom are held; None without any. Warn of nodes that are held in part."""
    components: dict[int, set[str]] = {}
    for support in data.supports:
        for grid in support.grids:
            if grid in data.scalars:
                continue
            components.setdefault(grid, set()).update(support.components)
    turning = {grid for element in (*data.shells, *data.bars) for grid in element.grids}
    turning |= {grid for tied in (*data.rigids, *data.constraints) for grid in tied.grids}
    turning |= {grid for link in data.links for grid in link.grids}
    needed = {grid: set("123456" if grid in turning else "123") for grid in components}
    held = [index[grid] for grid, freedoms in components.items() if freedoms >= needed[grid] and grid in index]
    partly = sorted(grid for grid, freedoms in components.items() if not freedoms >= needed[grid])
    if partly:
        first = next(entry for entry in data.supports if partly[0] in entry.grids)
        warn(
            f"supports of single degrees of freedom are left out ({len(partly)} grids, the first is {partly[0]}, components "
            f"{''.join(sorted(components[partly[0]]))} by {first.card}), so the body is free there. Try: joints of the system, "
            "or supports of all six degrees of freedom, which make the grids a reference"
        )
    return held or None


def _warn_ignored(data: BulkData, path: str | Path) -> None:
    if data.grounded:
        warn(
            f"{data.grounded[0]}: one of its ends is the ground. The reader leaves out {len(data.grounded)} such elements, "
            "because a body does not contain supports. Try: springs to mbd.Ground() in the system"
        )
    if data.ignored:
        cards = ", ".join(f"{name} ({count})" for name, count in sorted(data.ignored.items()))
        warn(f"{Path(path).name}: cards that do not describe structure are left out: {cards}")
