"""Shear panels (CSHEAR, PSHEAR) of a Nastran model: a part of constant stiffness.

    K = G t A b b'          b: the mean shear strain of the panel, of unit displacements of its corners

in the plane through the middles of its sides; x from the middle of side 41 to that of side 23. For rectangles this is the panel
of constant shear flow along the sides; of other quadrilaterals it is that of their mean strain. F1 (sides 12, 34) and F2
(23, 41) are rods along the sides, of the area F t w / 2, or F t^2 / 2 where F > 1.01; w: mean width. A quarter of the mass is
at each corner.
Source: MSC Nastran Quick Reference Guide (PSHEAR). Checked in tests/extensions/nastran/test_shells.py.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import torch

from torchmbd.errors import InputError, wrong_entry
from torchmbd.extensions.nastran.data import BulkData
from torchmbd.extensions.nastran.elements import Solid
from torchmbd.extensions.nastran.materials import Units, moduli_of
from torchmbd.fem.elements import GivenElements
from torchmbd.fem.mesh import Mesh

_SMALL = 1.01  # F up to this is a share of the panel's area


def shear_panels(data: BulkData, mesh: Mesh, index: dict[int, int], units: Units) -> GivenElements:
    """All CSHEAR of the model."""
    pairs = [_panel(data, panel) for panel in data.panels]
    nodes = torch.tensor([[index[grid] for grid in panel.grids] for panel in data.panels], dtype=torch.long)
    freedoms = (6 * nodes[:, :, None] + torch.arange(3)).flatten(1)
    K = torch.from_numpy(np.array([stiffness for stiffness, _ in pairs])) * units.mass
    mass = torch.tensor([panel_mass for _, panel_mass in pairs], dtype=torch.float64).repeat_interleave(4) / 4.0
    mass = mass * units.mass * data.weight_to_mass
    heavy = mass > 0.0
    return GivenElements(mesh, [freedoms], [K], nodes.flatten()[heavy], mass[heavy])


def _panel(data: BulkData, panel: Solid) -> tuple[np.ndarray, float]:
    """Stiffness [12, 12] and mass in units of the file."""
    card = data.property_of(panel.card, "PSHEAR", panel.property)
    material = data.material(card, card.integer(2, "MID"))
    E, G, _ = moduli_of(material)
    t = card.real(3, "T")
    x = np.array([data.grids[grid] for grid in panel.grids])
    normal = np.cross(x[2] - x[0], x[3] - x[1])
    area = 0.5 * float(np.linalg.norm(normal))
    size = float(np.linalg.norm(x[2] - x[0])) * float(np.linalg.norm(x[3] - x[1]))
    if not t > 0.0 or not area > 1e-9 * size:
        raise wrong_entry(panel.card, f"T {t:g}, area {area:g}", "both > 0", key="T")
    e_z = normal / (2.0 * area)
    e_x = x[1] + x[2] - x[0] - x[3]
    e_x = e_x - (e_x @ e_z) * e_z
    e_x = e_x / np.linalg.norm(e_x)
    e_y = np.cross(e_z, e_x)
    u, v = x @ e_x, x @ e_y
    by_x = np.array([v[1] - v[3], v[2] - v[0], v[3] - v[1], v[0] - v[2]]) / (2.0 * area)
    by_y = np.array([u[3] - u[1], u[0] - u[2], u[1] - u[3], u[2] - u[0]]) / (2.0 * area)
    b = (by_y[:, None] * e_x + by_x[:, None] * e_y).ravel()
    K = G * t * area * np.outer(b, b)
    sides = list(pairwise((0, 1, 2, 3, 0)))
    for k, name in ((0, "F1"), (1, "F2")):
        factor = card.real(5 + k, name, 0.0)
        lengths = [float(np.linalg.norm(x[j] - x[i])) for i, j in sides[k::2]]
        if factor < 0.0 or not min(lengths) > 0.0:
            raise InputError(
                (str(card), name),
                factor,
                f"must have {name} >= 0, sides > 0",
                noun=f"{card}: {name}",
                shown=f"{factor:g}, sides {lengths}",
            )
        width = 2.0 * area / sum(lengths)
        section = 0.5 * factor * t * (width if factor <= _SMALL else t)
        for (i, j), length in zip(sides[k::2], lengths, strict=True):
            g = np.zeros((4, 3))
            g[j] = (x[j] - x[i]) / length
            g[i] = -g[j]
            K = K + E * section / length * np.outer(g.ravel(), g.ravel())
    return K, (material.real(5, "RHO", 0.0) * t + card.real(4, "NSM", 0.0)) * area
