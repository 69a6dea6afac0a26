"""Plies, meshes and solutions that the plate tests share: general positions, not convenient ones."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import numpy as np
import scipy.sparse.linalg
import torch
from torch import Tensor

from torchmbd.fem.elements import PlateMatrices
from torchmbd.fem.materials import Laminate, Ply
from torchmbd.fem.mesh import Mesh, cut_quads, rectangle
from torchmbd.math.angles import deg

CARBON = Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=5.36e9, nu12=0.23, density=1586.0)

#: An unbalanced, unsymmetric stack: no entry of A, B, D, As vanishes.
GENERAL = Laminate(CARBON, deg([20, -50, 75]), [1e-3, 2e-3, 1.5e-3])


def rotation(seed: int) -> Tensor:
    """Rotate by a general proper rotation [3, 3]."""
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return torch.from_numpy(q * np.sign(np.linalg.det(q)))


#: Kinds of meshes: of triangles, of quadrilaterals, and of both in the pattern of a chessboard.
KINDS = ("triangle", "quad", "mixed")


def grid(length: float, width: float, cells: tuple[int, int], kind: str = "triangle") -> Mesh:
    """Mesh a rectangle with cells of a kind."""
    if kind != "mixed":
        return rectangle(length, width, cells, kind)
    flat = rectangle(length, width, cells, "quad")
    i, j = (k.flatten() for k in torch.meshgrid(torch.arange(cells[0]), torch.arange(cells[1]), indexing="ij"))
    whole = (i + j) % 2 == 0
    triangles = cut_quads(flat.nodes, flat.quads[~whole]).flatten(0, 1)
    return Mesh(flat.nodes, triangles, flat.node_sets, quads=flat.quads[whole])


def moved(mesh: Mesh, nodes: Tensor) -> Mesh:
    """Put the nodes of a mesh to other places."""
    return Mesh(nodes, mesh.triangles, mesh.node_sets, quads=mesh.quads)


def mapped(cells: tuple[int, int], place: Callable[[float, float], Iterable[float]], kind: str = "triangle") -> Mesh:
    """Map the unit square's structured mesh; `place` takes (s, t) in [0, 1] to (x, y, z)."""
    flat = grid(1.0, 1.0, cells, kind)
    nodes = [list(place(x + 0.5, y + 0.5)) for x, y, _ in flat.nodes.tolist()]
    return moved(flat, torch.tensor(nodes, dtype=torch.float64))


def irregular(
    length: float, width: float, cells: tuple[int, int], seed: int = 3, amount: float = 0.3, kind: str = "triangle"
) -> Mesh:
    """Rectangle whose inner nodes are moved by up to `amount` of a cell in both directions."""
    flat = grid(length, width, cells, kind)
    inner = np.setdiff1d(np.arange(len(flat.nodes)), boundary(flat))
    nodes = flat.nodes.clone()
    cell = np.array([length / cells[0], width / cells[1]])
    nodes[inner, :2] += torch.from_numpy(amount * cell * np.random.default_rng(seed).uniform(-1, 1, (len(inner), 2)))
    return moved(flat, nodes)


def turned(mesh: Mesh, R: Tensor, origin: tuple[float, float, float] = (0.3, -0.2, 0.7)) -> Mesh:
    """Move a mesh rigidly: R x + origin."""
    return moved(mesh, mesh.nodes @ R.T + torch.tensor(origin, dtype=torch.float64))


def centers(mesh: Mesh) -> Tensor:
    """Means of the corners of all cells, in the order in which they are counted [cells, 3]."""
    return torch.cat([mesh.nodes[corners].mean(1) for corners in mesh.cells.values()])


def boundary(mesh: Mesh) -> np.ndarray:
    """Nodes on the four edges of a structured mesh."""
    edges = ("left_edge", "right_edge", "bottom_edge", "top_edge")
    return np.unique(np.concatenate([mesh.node_set(name) for name in edges]))


def freedoms(nodes: Iterable[int], kinds: Iterable[int] = range(6)) -> np.ndarray:
    """Global freedom indices of nodes; kinds 0 ... 5 = u1 u2 u3 phi1 phi2 phi3."""
    return (6 * np.asarray(list(nodes))[:, None] + np.asarray(list(kinds))).ravel()


def stiffness(plate: PlateMatrices, laminate: Laminate) -> scipy.sparse.csc_array:
    """Stiffness matrix of one laminate."""
    return plate.pattern.to_scipy(plate.stiffness(laminate.entries()).values)


def solved(
    K: scipy.sparse.csc_array, load: np.ndarray, held: np.ndarray, given: np.ndarray | float = 0.0
) -> np.ndarray:
    """Displacements under a load [N, N m] with `held` freedoms at `given` values (a whole vector)."""
    u = np.zeros(len(load)) + given
    free = np.setdiff1d(np.arange(len(load)), held)
    u[free] = 0.0
    u[free] = scipy.sparse.linalg.spsolve(K[free][:, free], load[free] - (K @ u)[free])
    return u


def frequencies(
    plate: PlateMatrices, laminate: Laminate, held: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Lowest natural frequencies [Hz] and mass-normalized modes [N, count], lumped mass."""
    M = plate.lumped_mass(laminate.mass_per_area, laminate.rotary_inertia_per_area).numpy()
    free = np.setdiff1d(np.arange(len(M)), held)
    scale = scipy.sparse.diags_array(1.0 / np.sqrt(M[free]))
    K = (scale @ stiffness(plate, laminate)[free][:, free] @ scale).tocsc()
    shift = 0.0 if len(held) >= 6 else -1e-3 * K.diagonal().min()
    values, vectors = scipy.sparse.linalg.eigsh(K, k=count, sigma=shift, v0=np.ones(len(free)))
    order = np.argsort(values)
    modes = np.zeros((len(M), count))
    modes[free] = scale @ vectors[:, order]
    return np.sqrt(np.maximum(values[order], 0.0)) / (2 * math.pi), modes
