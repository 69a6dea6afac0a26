"""The plate elements on a simply supported rectangle, to be compared with Navier's series."""

from __future__ import annotations

import numpy as np

from tests.fem.elements.plate_cases import freedoms, frequencies, solved, stiffness
from torchmbd.fem.elements import PlateMatrices
from torchmbd.fem.materials import Laminate
from torchmbd.fem.mesh import Mesh, rectangle


def supports(mesh: Mesh, support: str) -> np.ndarray:
    """Freedoms held by SS-1 or SS-2 (navier.py): on x = const u3, phi1 (= -beta_y) and u2 or u1."""
    along_x, along_y = ((1, 0), (0, 1))[support == "SS-2"]
    held = [freedoms(mesh.node_set(name), [2, 3, along_x]) for name in ("left_edge", "right_edge")]
    held += [freedoms(mesh.node_set(name), [2, 4, along_y]) for name in ("bottom_edge", "top_edge")]
    return np.unique(np.concatenate(held))


def center_deflection(
    laminate: Laminate,
    cells: tuple[int, int],
    support: str,
    a: float = 1.0,
    b: float = 1.0,
    load: str = "uniform",
    kind: str = "triangle",
) -> float:
    """Deflection of the center under 1 Pa, uniform or as a half sine in both directions."""
    mesh = rectangle(a, b, cells, kind)
    plate = PlateMatrices(mesh, laminate)
    x, y = mesh.nodes[:, 0].numpy(), mesh.nodes[:, 1].numpy()
    pressure = 1.0 if load == "uniform" else np.cos(np.pi * x / a) * np.cos(np.pi * y / b)
    force = np.zeros(6 * len(x))
    force[2::6] = plate.area.numpy() * pressure
    u = solved(stiffness(plate, laminate), force, supports(mesh, support))
    return float(u[6 * mesh.node("center") + 2])


def plate_frequencies(
    laminate: Laminate,
    cells: tuple[int, int],
    support: str,
    count: int,
    a: float = 1.0,
    b: float = 1.0,
    kind: str = "triangle",
) -> np.ndarray:
    """Lowest natural frequencies [Hz]."""
    mesh = rectangle(a, b, cells, kind)
    return frequencies(PlateMatrices(mesh, laminate), laminate, supports(mesh, support), count)[0]
