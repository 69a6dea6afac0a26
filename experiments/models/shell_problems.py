"""Published problems of plates and shells, with cells of either kind: found over reference.

    PROBLEMS: name -> function (kind, n) -> {quantity: found / reference},    n: refinement, 1 is the usual mesh

Sources: R. H. MacNeal and R. L. Harder, A proposed standard set of problems to test finite element accuracy, Finite Elem.
Anal. Des. 1 (1985) 3-20 (beams, roof, hemisphere, plates; meshes are theirs); T. Belytschko et al., Int. J. Numer. Methods
Eng. 28 (1989) 385-414 (thin twisted beam), Comput. Methods Appl. Mech. Engrg. 51 (1985) 221-258 (pinched cylinder, thin
shell theory); R. D. Cook, J. Struct. Div. ASCE 100 (1974), reference 23.96 (C. A. Felippa, 2003); L. S. D. Morley, Skew Plates
and Structures (1963): 0.408e-3, with shear 0.423e-3 (I. Babuska and T. Scapolla, 1989); S. P. Timoshenko, Theory of Plates
and Shells, article 44 (clamped plates); A. Razzaque, Int. J. Numer. Methods Eng. 6 (1973) 333-343 (0.7945 q L^4 / 100 D). More:
tests/validation/test_twisted_strip.py, test_nafems_r0031.py, test_reddy_laminated_plates.py, test_pagano_sandwich.py.
Checked in tests/validation/test_shells_of_both_kinds.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import scipy.sparse.linalg
import torch

import torchmbd as mbd
from torchmbd.fem.elements import PlateMatrices

Place = Callable[[float, float], Sequence[float]]
Ratios = dict[str, float]
Law = tuple[float, float, float] | mbd.Laminate
U, V, W, PHI1, PHI2, PHI3 = range(6)
LEFT, RIGHT, BOTTOM, TOP = "left_edge", "right_edge", "bottom_edge", "top_edge"


class Model:
    """A mapped unit square of a laminate, or E, nu and thickness; `place` takes (s, t) in [0, 1] to (x, y, z)."""

    def __init__(self, place: Place, cells: tuple[int, int], kind: str, law: Law, direction=(1.0, 0, 0)) -> None:
        flat = mbd.mesh.rectangle(1.0, 1.0, cells, kind)
        nodes = [list(place(x + 0.5, y + 0.5)) for x, y, _ in flat.nodes.tolist()]
        self.mesh = mbd.Mesh(torch.tensor(nodes, dtype=torch.float64), flat.triangles, flat.node_sets, quads=flat.quads)
        laminate = (
            law if isinstance(law, mbd.Laminate) else mbd.Laminate(mbd.Ply.isotropic(*law[:2], 1.0), [0.0], law[2])
        )
        self.plate = PlateMatrices(self.mesh, laminate, direction)
        self.K: Any = self.plate.pattern.to_scipy(self.plate.stiffness(laminate.entries().detach()).values)
        self.load = np.zeros(6 * len(nodes))

    def at(self, nodes: str | Sequence[int], freedoms: Sequence[int] = range(6)) -> np.ndarray:
        """Freedoms of a node set."""
        numbers = self.mesh.node_set(nodes) if isinstance(nodes, str) else nodes
        return (6 * np.asarray(list(numbers))[:, None] + np.asarray(list(freedoms))).ravel()

    def uniform(self, force: float) -> None:
        """Load the area with a force along z [N/m2]."""
        self.load[W::6] = force * self.plate.area.numpy()

    def solved(self, held: Mapping[str, Sequence[int]], *more: int) -> np.ndarray:
        """Displacements with the freedoms of node sets held."""
        fixed = np.concatenate(
            [np.asarray(more, dtype=int), *(self.at(name, numbers) for name, numbers in held.items())]
        )
        free = np.setdiff1d(np.arange(len(self.load)), fixed)
        u, inner = np.zeros(len(self.load)), self.K[free][:, free].tocsc()
        u[free] = scipy.sparse.linalg.splu(inner).solve(self.load[free])
        return u


def _share(count: int) -> np.ndarray:
    share = np.ones(count)
    share[[0, -1]] = 0.5
    return share / share.sum()


def cantilever(place: Place, cells: tuple[int, int], kind: str, law: Law, references: Mapping[int, float]) -> Ratios:
    """Mean end displacements under unit end forces."""
    ratios = {}
    for way, reference in references.items():
        model = Model(place, cells, kind, law)
        tip = model.at(RIGHT, [way])
        model.load[tip] = share = _share(len(tip))
        ratios["uvw"[way]] = float(share @ model.solved({LEFT: range(6)})[tip]) / reference
    return ratios


def straight(kind: str, n: int, lean: tuple[float, float] = (0.0, 0.0)) -> Ratios:
    """6 x 0.2 x 0.1; cell ends lean by 45 degrees times these, by turns."""

    def place(s: float, t: float) -> tuple[float, float, float]:
        k = round(s * 6 * n)
        shift = 0.0 if k in (0, 6 * n) else lean[k % 2] * 0.1 / n * (2 * t - 1)
        return 6 * s + shift, 0.2 * t, 0.0

    return cantilever(place, (6 * n, n), kind, (1e7, 0.3, 0.1), {U: 3e-5, V: 0.1081, W: 0.4321})


def curved(kind: str, n: int) -> Ratios:
    """A quarter ring, inner radius 4.12, 0.2 x 0.1. Out of plane first-order plate theory ends at 0.993."""

    def place(s: float, t: float) -> tuple[float, float, float]:
        r, angle = 4.32 - 0.2 * t, math.pi / 2 * s
        return -r * math.cos(angle), r * math.sin(angle), 0.0

    return cantilever(place, (6 * n, n), kind, (1e7, 0.25, 0.1), {V: 0.08734, W: 0.5022})


def twisted(kind: str, n: int, thickness: float = 0.32) -> Ratios:
    """12 x 1.1, twisted by 90 degrees."""

    def place(s: float, t: float) -> tuple[float, float, float]:
        y, angle = 1.1 * (t - 0.5), math.pi / 2 * s
        return 12 * s, y * math.cos(angle), y * math.sin(angle)

    references = {W: 0.005424, V: 0.001754} if thickness == 0.32 else {W: 5256.0, V: 1294.0}
    return cantilever(place, (12 * n, 2 * n), kind, (29e6, 0.22, thickness), references)


def cook(kind: str, n: int) -> Ratios:
    """The skew membrane, 4 x 4 cells: middle of the loaded end."""
    model = Model(lambda s, t: (48 * s, 44 * s + t * (44 - 28 * s), 0.0), (4 * n, 4 * n), kind, (1.0, 1 / 3, 1.0))
    end = model.at(RIGHT, [V])
    model.load[end] = _share(len(end))
    rest = model.at(range(len(model.mesh.nodes)), [W, PHI1, PHI2])
    return {"tip": float(model.solved({LEFT: [U, V]}, *rest)[end[2 * n]]) / 23.96}


def roof(kind: str, n: int) -> Ratios:
    """Scordelis-Lo: a quarter with 8 x 8 cells, down at the middle of the free edge."""

    def place(s: float, t: float) -> tuple[float, float, float]:
        angle = math.radians(40) * t
        return 25 * s, 25 * math.sin(angle), 25 * math.cos(angle)

    model = Model(place, (8 * n, 8 * n), kind, (4.32e8, 0.0, 0.25))
    model.uniform(-90.0)
    u = model.solved({LEFT: [U, PHI2, PHI3], BOTTOM: [V, PHI1, PHI3], RIGHT: [V, W]})
    return {"edge": -float(u[model.at("corner_left_top", [W])[0]]) / 0.3024}


def hemisphere(kind: str, n: int) -> Ratios:
    """A quarter with a hole of 18 degrees, 8 x 8 cells, under pinching forces of 2."""

    def place(s: float, t: float) -> tuple[float, float, float]:
        polar, around = math.radians(18 + 72 * t), math.pi / 2 * s
        return 10 * math.sin(polar) * math.cos(around), 10 * math.sin(polar) * math.sin(around), 10 * math.cos(polar)

    model = Model(place, (8 * n, 8 * n), kind, (6.825e7, 0.3, 0.04), (0.3, 0.2, 1.0))
    first, second = model.at("corner_left_top")[0], model.at("corner_right_top")[0]
    model.load[first], model.load[second + V] = 1.0, -1.0
    u = model.solved({LEFT: [V, PHI1, PHI3], RIGHT: [U, PHI2, PHI3]}, int(first + W))
    return {"load": float(u[first]) / 0.0940}


def cylinder(kind: str, n: int) -> Ratios:
    """An octant of the pinched cylinder, 8 x 8 cells; the shear of the thick theory adds 1 %."""

    def place(s: float, t: float) -> tuple[float, float, float]:
        return 300 * s, 300 * math.sin(math.pi / 2 * t), 300 * math.cos(math.pi / 2 * t)

    model = Model(place, (8 * n, 8 * n), kind, (3e6, 0.3, 3.0))
    under = model.at("corner_left_bottom", [W])[0]
    model.load[under] = -0.25
    held = {LEFT: [U, PHI2, PHI3], RIGHT: [V, W], BOTTOM: [V, PHI1, PHI3], TOP: [W, PHI1, PHI2]}
    return {"load": -float(model.solved(held)[under]) / 1.8248e-5}


#: Aspect ratio, clamped, central load: deflection at the center of a plate 2 m wide [m].
_PLATES = {
    (1, False, False): 4.062, (1, False, True): 11.60, (1, True, False): 1.2653, (1, True, True): 5.60,
    (5, False, False): 12.97, (5, False, True): 16.96, (5, True, False): 2.604, (5, True, True): 7.23,
}  # fmt: skip


def plates(kind: str, n: int, aspect: int = 1) -> Ratios:
    """Quarters of the 2 x (2 aspect) plate with 4 x 4 cells: simply supported and clamped, uniform and central load."""
    ratios = {}
    for (shape, clamped, central), reference in _PLATES.items():
        if shape != aspect:
            continue
        model = Model(lambda s, t: (s, aspect * t, 0.0), (4 * n, 4 * n), kind, (1.7472e7, 0.3, 1e-4))
        center = model.at("corner_left_bottom", [W])[0]
        if central:
            model.load[center] = 1e-4
        else:
            model.uniform(1e-4)
        edge = [W, PHI1, PHI2]
        held = {
            LEFT: [PHI2],
            BOTTOM: [PHI1],
            RIGHT: edge if clamped else [W, PHI1],
            TOP: edge if clamped else [W, PHI2],
        }
        plane = model.at(range(len(model.mesh.nodes)), [U, V, PHI3])
        name = f"{'clamped' if clamped else 'supported'}, {'central' if central else 'uniform'}"
        ratios[name] = float(model.solved(held, *plane)[center]) / reference
    return ratios


def morley(kind: str, n: int, thickness: float = 0.01) -> Ratios:
    """The 30 degree rhombus on soft supports, 8 x 8 cells, L / h = 100: with the layers of shear at the edges.

    Triangles larger than h cannot see these layers: they tend to 0.408 / 0.423 = 0.965 first. Thinner plates: over 0.408e-3.
    """
    cos, sin = math.cos(math.pi / 6), math.sin(math.pi / 6)
    model = Model(lambda s, t: (s + t * cos, t * sin, 0.0), (8 * n, 8 * n), kind, (10.92, 0.3, thickness))
    model.uniform(1.0)
    plane = model.at(range(len(model.mesh.nodes)), [U, V, PHI3])
    w = model.solved({edge: [W] for edge in (LEFT, RIGHT, BOTTOM, TOP)}, *plane)[model.at("center", [W])[0]]
    reference = 0.423e-3 if thickness == 0.01 else 0.408e-3
    return {"center": float(w) * 10.92 * thickness**3 / 12 / 0.91 / reference}


def razzaque(kind: str, n: int) -> Ratios:
    """The 60 degree rhombus, L / h = 1000, two opposite sides supported, two free, 4 x 4 cells: center."""
    model = Model(
        lambda s, t: (100 * (s + t / 2), 50 * math.sqrt(3) * t, 0.0), (4 * n, 4 * n), kind, (1092.0, 0.3, 0.1)
    )
    model.uniform(1.0)
    plane = model.at(range(len(model.mesh.nodes)), [U, V, PHI3])
    w = model.solved({BOTTOM: [W], TOP: [W]}, *plane)[model.at("center", [W])[0]]
    return {"center": float(w) * 1092e-3 / 12 / 0.91 / 1e8 / 0.7945e-2}


PROBLEMS: dict[str, Callable[[str, int], Ratios]] = {
    "straight beam": straight,
    "with parallelograms": lambda kind, n: straight(kind, n, (1.0, 1.0)),
    "with trapezoids": lambda kind, n: straight(kind, n, (1.0, -1.0)),
    "curved beam": curved,
    "twisted beam": twisted,
    "the same, 1/100 as thick": lambda kind, n: twisted(kind, n, 0.0032),
    "Cook's membrane": cook,
    "roof": roof,
    "hemisphere": hemisphere,
    "pinched cylinder": cylinder,
    "square plates": plates,
    "plates 5 : 1": lambda kind, n: plates(kind, n, 5),
    "Morley's skew plate": morley,
    "the same, 1/10 as thick": lambda kind, n: morley(kind, n, 0.001),
    "Razzaque's skew plate": razzaque,
}
