"""Rods, springs, bushings and solids of a Nastran model as parts of constant stiffness.

    CROD, CTUBE, CONROD    E A / l along, G J / l about the line of its grids; half of the mass at each
    CELAS1, CELAS2  K (u_1 - u_2) between two components, in the systems CD of the grids
    CBUSH           K1 to K6 at the place S between its grids (0.5), in the system CID, or x along its line and X1 to X3 or G0
    solids          solids.py, of MAT1 or MAT9 in the system CORDM of the property

A body has one part for each kind of card: "crod", "celas2", "cbush", "solids".
Checked in tests/extensions/nastran/test_elements.py.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from torchmbd.errors import InputError, wrong_entry
from torchmbd.extensions.nastran.card import Card
from torchmbd.extensions.nastran.data import BulkData
from torchmbd.extensions.nastran.elements import LINKS, Link, Solid
from torchmbd.extensions.nastran.materials import Units, density_of, moduli_of
from torchmbd.extensions.nastran.solids import solid_matrices
from torchmbd.fem.elements import GivenElements, Part
from torchmbd.fem.mesh import Mesh

_VOIGT = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0))


def constant_parts(data: BulkData, mesh: Mesh, index: dict[int, int], units: Units) -> dict[str, Part]:
    """The parts of rods, springs, bushings and solids."""
    parts: dict[str, Part] = {}
    for kind in LINKS:
        links = [link for link in data.links if link.card.name == kind]
        if links:
            parts[kind.lower()] = _link_part(data, mesh, index, units, links)
    if data.solids:
        parts["solids"] = _solids(data, mesh, index, units)
    return parts


def _link_part(data: BulkData, mesh: Mesh, index: dict[int, int], units: Units, links: list[Link]) -> Part:
    stiffness, masses = zip(*(_link_matrix(data, link) for link in links), strict=True)
    scale = torch.tensor([1.0, 1.0, 1.0, units.length, units.length, units.length] * 2, dtype=torch.float64)
    K = torch.from_numpy(np.array(stiffness)) * units.mass * scale[:, None] * scale
    nodes = torch.tensor([[index[grid] for grid in link.grids] for link in links], dtype=torch.long)
    freedoms = (6 * nodes[:, :, None] + torch.arange(6)).flatten(1)
    mass = torch.tensor(masses, dtype=torch.float64).repeat_interleave(2) / 2.0 * units.mass * data.weight_to_mass
    heavy = mass > 0.0
    return GivenElements(mesh, [freedoms], [K], nodes.flatten()[heavy], mass[heavy])


def _link_matrix(data: BulkData, link: Link) -> tuple[np.ndarray, float]:
    """Stiffness [12, 12] and mass in units of the file."""
    if link.card.name in ("CROD", "CTUBE", "CONROD"):
        return _rod(data, link)
    return (_bushing(data, link) if link.card.name == "CBUSH" else _spring(data, link)), 0.0


def _rod(data: BulkData, link: Link) -> tuple[np.ndarray, float]:
    kind = LINKS[link.card.name][2]
    card, first = (link.card, 4) if link.property is None else (data.property_of(link.card, kind, link.property), 2)
    material = data.material(card, card.integer(first, "MID"))
    A, J, extra = _tube_numbers(card) if kind == "PTUBE" else _rod_numbers(card, first)
    a, b = (np.array(data.grids[grid]) for grid in link.grids)
    length = float(np.linalg.norm(b - a))
    if not length > 0.0 or not A > 0.0 or J < 0.0:
        raise wrong_entry(
            link.card, f"length {length:g}, A {A:g}, J {J:g}", "must have length and A > 0, and J >= 0", key="A"
        )
    E, G, _ = moduli_of(material)
    e = (b - a) / length
    K = np.zeros((12, 12))
    for start, k in ((0, E * A / length), (3, G * J / length)):
        g = np.zeros(12)
        g[start : start + 3], g[6 + start : 9 + start] = -e, e
        K += k * np.outer(g, g)
    return K, (material.real(5, "RHO", 0.0) * A + extra) * length


def _rod_numbers(card: Card, first: int) -> tuple[float, float, float]:
    """A, J and mass per length without stiffness of a PROD or CONROD; its material stands at `first`."""
    return card.real(first + 1, "A"), card.real(first + 2, "J", 0.0), card.real(first + 4, "NSM", 0.0)


def _tube_numbers(card: Card) -> tuple[float, float, float]:
    """The same of a PTUBE: outer diameter, thickness (blank, 0: solid), the diameter at end B like that at end A."""
    outer = card.real(3, "OD")
    inner = outer - 2.0 * (card.real(4, "T", 0.0) or outer / 2.0)
    if not 0.0 <= inner < outer or card.real(6, "OD2", outer) != outer:
        raise wrong_entry(
            card,
            f"OD {outer:g}, T {card.text(4)}, OD2 {card.text(6)!r}",
            "must have 0 <= T <= OD / 2, and OD2 = OD",
            key="OD",
        )
    A, J = math.pi / 4.0 * (outer**2 - inner**2), math.pi / 32.0 * (outer**4 - inner**4)
    return A, J, card.real(5, "NSM", 0.0)


def _spring(data: BulkData, link: Link) -> np.ndarray:
    card = link.card
    k = card.real(2, "K") if link.property is None else data.property_of(card, "PELAS", link.property).real(2, "K")
    g = np.zeros(12)
    for end, (grid, place, sign) in enumerate(zip(link.grids, (4, 6), (1.0, -1.0), strict=True)):
        component = card.integer(place, f"C{end + 1}")
        if not 1 <= component <= 6:
            raise wrong_entry(card, f"C{end + 1} = {component}", "1 to 6", key="C")
        axes = data.displacement_axes(grid)
        start = 6 * end + (0 if component <= 3 else 3)
        g[start : start + 3] = sign * axes[(component - 1) % 3]
    return k * np.outer(g, g)


def _bushing(data: BulkData, link: Link) -> np.ndarray:
    bush = data.property_of(link.card, "PBUSH", link.property or 0)
    k = _bushing_stiffness(bush)
    a, b = (np.array(data.grids[grid]) for grid in link.grids)
    axes = _bushing_axes(data, link, a, b, k)
    share = link.card.real(9, "S", 0.5)
    if not 0.0 <= share <= 1.0 or link.card.text(10) not in ("", "-1"):
        raise InputError(
            (str(link.card), "S"),
            share,
            "0 to 1, without an OCID",
            noun=f"{link.card}: S",
            shown=f"{share:g}, OCID {link.card.text(10)!r}",
        )
    place, G = a + share * (b - a), np.zeros((6, 12))
    for column, x, sign in ((0, a, -1.0), (6, b, 1.0)):
        d = place - x
        lever = np.array([[0.0, d[2], -d[1]], [-d[2], 0.0, d[0]], [d[1], -d[0], 0.0]])  # turned x d
        G[:3, column : column + 3], G[:3, column + 3 : column + 6] = sign * axes, sign * axes @ lever
        G[3:, column + 3 : column + 6] = sign * axes
    return G.T @ np.diag(k) @ G


def _bushing_stiffness(card: Card) -> list[float]:
    """Return K1 to K6; damping and other data are left out."""
    for start in range(2, len(card.fields) + 1, 8):
        if card.text(start).upper() == "K":
            return [card.real(start + 1 + i, f"K{i + 1}", 0.0) for i in range(6)]
    raise wrong_entry(card, "it has no K", "must have K, or K1 to K6", key="K")


def _bushing_axes(data: BulkData, link: Link, a: np.ndarray, b: np.ndarray, k: list[float]) -> np.ndarray:
    card = link.card
    if card.text(8):
        return data.systems.axes(card.integer(8, "CID"), card, (a + b) / 2.0)
    along = b - a
    length = float(np.linalg.norm(along))
    if length == 0.0:
        raise wrong_entry(card, "its grids are at one place", "must have CID, its system", key="CID")
    if card.text(5).isdigit():
        grid = card.integer(5, "G0")
        if grid not in data.grids:
            raise wrong_entry(card, f"GRID {grid} does not exist", "the number of a GRID", key="G0")
        v = np.array(data.grids[grid]) - a
    else:
        v = np.array([card.real(5 + i, f"X{i + 1}", 0.0) for i in range(3)])
        if not v.any() and any(k[i] for i in (1, 2, 4, 5)):
            raise wrong_entry(card, "it has no vector, and K2, K3, K5 or K6", "must have X1 to X3, G0 or CID", key="X")
        v = v @ data.displacement_axes(link.grids[0]) if v.any() else np.eye(3)[np.argmin(np.abs(along))]
    z = np.cross(along, v)
    if np.linalg.norm(z) <= 1e-9 * length * np.linalg.norm(v):
        raise wrong_entry(card, f"its vector {v.tolist()} lies along its line", "another one", key="X")
    x, z = along / length, z / np.linalg.norm(z)
    return np.array([x, np.cross(z, x), z])


def _solids(data: BulkData, mesh: Mesh, index: dict[int, int], units: Units) -> Part:
    freedoms, matrices, nodes, masses = [], [], [], []
    groups: dict[tuple[int, int], list[Solid]] = {}
    for solid in data.solids:
        groups.setdefault((solid.property, len(solid.grids)), []).append(solid)
    for (number, corners), group in groups.items():
        D, density = _solid_material(data, group[0].card, number, units)
        members = torch.tensor([[index[grid] for grid in solid.grids] for solid in group], dtype=torch.long)
        K, share = _oriented_matrices(mesh, members, D, group)
        freedoms.append((6 * members[:, :, None] + torch.arange(3)).flatten(1))
        matrices.append(K)
        nodes.append(members.flatten())
        masses.append(share.reshape(-1, corners).flatten() * density)
    node, place = torch.unique(torch.cat(nodes), return_inverse=True)
    mass = torch.zeros(len(node), dtype=torch.float64).index_add(0, place, torch.cat(masses))
    return GivenElements(mesh, freedoms, matrices, node, mass)


def _oriented_matrices(mesh: Mesh, members: Tensor, D: Tensor, group: list[Solid]) -> tuple[Tensor, Tensor]:
    """Return stiffness and volumes; solids whose corners are in mirrored order have negative ones, whose signs are changed."""
    K, share, volume = solid_matrices(mesh.nodes[members], D)
    right, mirrored = (volume > 0).all(1), (volume < 0).all(1)
    wrong = (~(right | mirrored)).nonzero()[:, 0]
    if len(wrong):
        raise wrong_entry(
            group[int(wrong[0])].card, "it is collapsed or crosses itself", "must have a volume > 0", key="G"
        )
    sign = 2.0 * right.to(K.dtype) - 1.0
    return K * sign[:, None, None], share * sign[:, None]


def _solid_material(data: BulkData, card: Card, number: int, units: Units) -> tuple[Tensor, float]:
    """D [6, 6] in mesh axes [Pa] and density [kg/m3]."""
    solid = data.property_of(card, "PSOLID", number)
    material = data.material(solid, solid.integer(2, "MID"))
    if material.name == "MAT1":
        E, G, nu = moduli_of(material)
        C = np.zeros((6, 6))
        C[:3, :3] = -nu / E
        C[range(6), range(6)] = [1 / E] * 3 + [1 / G] * 3
        return torch.from_numpy(np.linalg.inv(C)) * units.stress, density_of(material, 5, units, data.weight_to_mass)
    if material.name != "MAT9":
        raise InputError(
            (str(solid), str(material)),
            allowed="MAT1 or MAT9",
            noun=f"{solid}: {material}",
            state="is the material of a solid",
        )
    D = np.zeros((6, 6))
    D[np.triu_indices(6)] = [material.real(2 + k, "G", 0.0) for k in range(21)]
    D = D + np.triu(D, 1).T
    if not np.linalg.eigvalsh(D)[0] > 0.0:
        raise wrong_entry(material, "its matrix G is not positive definite", "that of an elastic material", key="G")
    system = solid.integer(3, "CORDM", 0)
    if system < 0:
        raise InputError(
            (str(solid), "CORDM"), system, "0 or a system, with MAT9", noun=f"{solid}: CORDM", shown=f"{system}"
        )
    if data.systems.curved(system, solid):
        raise wrong_entry(
            solid, f"CORDM {system} is not a rectangular system", "a rectangular one, with MAT9", key="CORDM"
        )
    T = _strain_transformation(data.systems.axes(system, solid, np.zeros(3)))
    return torch.from_numpy(T.T @ D @ T) * units.stress, density_of(material, 23, units, data.weight_to_mass)


def _strain_transformation(axes: np.ndarray) -> np.ndarray:
    """Strains along the rows of axes from those along x, y, z; shear is engineering shear."""
    T = np.zeros((6, 6))
    for column, (i, j) in enumerate(_VOIGT):
        e = np.zeros((3, 3))
        e[i, j] = e[j, i] = 1.0 if i == j else 0.5
        turned = axes @ e @ axes.T
        T[:, column] = [turned[p, q] * (1.0 if p == q else 2.0) for p, q in _VOIGT]
    return T
