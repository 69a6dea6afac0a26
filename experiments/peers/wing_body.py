"""A hybrid wing-body as a stranger made it, read unedited.
`python -m experiments.peers.wing_body [mass] [frequencies] [gradient]`

The half model models/bwb/bwb_saero.bdf of the repository SteveDoyle2/pyNastran: 10,135 grids, 9,372 shells of 63 sandwich
stacks of ten plies, bars, rigid elements, inches, pounds. PYNASTRAN_MODELS is the folder `models` of that repository.

    mass          mass, center and inertia, next to those that Simcenter Nastran printed (bwb_saero_trim.f06 beside it)
    frequencies   the ten lowest of the half model with its symmetry supports, free in the plane of symmetry, next to MYSTRAN's
    gradient      deflection of the tip under 2.5 g, held in the plane of symmetry, and its derivatives by all ply angles in
                  one reverse pass; two of them against differences

Checked in tests/experiments/test_wing_body.py.
"""

from __future__ import annotations

import math
import os
import sys
import time
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.sparse.linalg
import torch
from torch import Tensor, nn

from torchmbd.extensions.nastran.body import BulkBody, bulk_body
from torchmbd.extensions.nastran.cards import read_cards
from torchmbd.extensions.nastran.data import BulkData
from torchmbd.fem.elements import Assembly, Combination
from torchmbd.fem.materials import Laminate
from torchmbd.fem.reduction.static import StaticLoads
from torchmbd.math.sparse import SparseMatrix
from torchmbd.math.units import GRAVITY as STANDARD_GRAVITY
from torchmbd.math.units import INCH, POUND

VARIABLE = "PYNASTRAN_MODELS"
DECK = Path("bwb") / "bwb_saero.bdf"
WTMASS, GRAVITY = 0.00259, 1 / 0.00259 * INCH  # of the file: pounds to lbf s2/in, and the gravity that this is [m/s2]
TIP, LOAD_FACTOR = 2356, 2.5
#: Grid point weight generator of bwb_saero_trim.f06 (Simcenter Nastran, 2025-03-10): pounds, inches, about the center.
PRINTED_MASS = 1.126151e5
PRINTED_CENTER = (8.661351e2, 1.506179e2, 2.396737e1)
PRINTED_INERTIA = (3.351835e9, 1.296721e10, 1.507034e10)
#: MYSTRAN 17.0.0 (MYSTRANsolver/MYSTRAN at 77d970d) on the same cards without aerodynamics, G1Z = G2Z = G12, and the mass of
#: the stacks as NSM (its own mass of a PCOMP is another): name of a mode, frequency [Hz], in the order of ours.
MYSTRAN = (
    ("wing, first bending", 5.1997),
    ("aft body (drilling)", 2.9343),
    ("upper panels", 11.7612),
    ("wing", 15.8595),
    ("", 21.8815),
    ("", 22.9953),
    ("", 23.3816),
    ("", 30.8637),
    ("", 32.1118),
    ("", 34.1150),
)
MYSTRAN_TIP = -1.874451  # in: GRID 2356 under the load of `Manoeuvre`, SOL 101
#: Two CONM2 at grids of no element count there; the reader leaves them out, with a warning. Pounds, inches.
LOOSE = ((77.78, (950.0, 0.0, 0.0)), (77.78, (930.477, 0.0, 0.0)))


@dataclass(eq=False)
class Wing:
    """The model as read, and what the reader said."""

    body: BulkBody
    data: BulkData
    messages: list[str]

    @property
    def laminates(self) -> dict[str, Laminate]:
        """Stacks of the PCOMP cards by property."""
        laminates: dict[str, Laminate] = {}
        for name, part in self.body.parts.items():
            module: nn.Module | None = part.modules().get("laminate")
            if isinstance(module, Laminate) and module.angles.requires_grad:
                laminates[name] = module
        return laminates

    def node(self, grid: int) -> int:
        return self.body.mesh.node(f"grid_{grid}")

    def assembly(self, more: str = "") -> Assembly:
        """With its supports of single freedoms, and more components at the same grids."""
        supports = [support for support in self.data.supports if support.set]
        held = {(grid, c) for support in supports for grid in support.grids for c in (*support.components, *more)}
        sets = self.body.mesh.node_sets
        links = [Combination(self.node(grid), int(c) - 1, ()) for grid, c in sorted(held) if f"grid_{grid}" in sets]
        return Assembly(self.body.mesh, self.body.parts, (), [*self.body.links, *links])


def deck() -> Path | None:
    """The file, where PYNASTRAN_MODELS says so."""
    folder = os.environ.get(VARIABLE)
    return Path(folder) / DECK if folder and (Path(folder) / DECK).is_file() else None


def read(path: Path) -> Wing:
    """Read the model in inches."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        body, data = bulk_body(path, "in"), BulkData.of(read_cards(path))
    return Wing(body, data, list(dict.fromkeys(str(w.message) for w in caught)))


def mass_properties(wing: Wing) -> tuple[float, Tensor, Tensor]:
    """Mass [lb], center [in], moments of inertia about it [lb in2], with the loose masses."""
    x, m = [], []
    for part in wing.body.parts.values():
        points = part.masses()
        place = wing.body.mesh.nodes[points.ends].mean(1)
        x.append(place if points.arm is None else place + points.arm.detach())
        m.append(points.mass.detach())
    place = torch.cat([torch.cat(x) / INCH, torch.tensor([at for _, at in LOOSE], dtype=torch.float64)])
    pounds = torch.cat(m) / POUND / (WTMASS * STANDARD_GRAVITY / INCH)
    mass = torch.cat([pounds, torch.tensor([pound for pound, _ in LOOSE], dtype=torch.float64)])
    center = (mass[:, None] * place).sum(0) / mass.sum()
    d = place - center
    squares = (mass[:, None] * d**2).sum(0)
    return float(mass.sum()), center, squares.sum() - squares


def frequencies(wing: Wing, number: int = 10) -> list[float]:
    """The lowest elastic frequencies of the supported half model [Hz]."""
    assembly = wing.assembly()
    with torch.no_grad():
        K, M = assembly.stiffness(), assembly.mass()
    assert isinstance(M, SparseMatrix)
    k, m = (A.pattern.to_scipy(A.values) for A in (K, M))
    shift = -((2 * math.pi * 0.1) ** 2)
    start = np.ones(K.size)
    eigenvalues = scipy.sparse.linalg.eigsh(k, number + 6, m, shift, return_eigenvectors=False, v0=start)
    hertz = np.sqrt(np.clip(np.sort(eigenvalues), 0.0, None)) / (2 * math.pi)
    return hertz[hertz > 0.01].tolist()[:number]


class Manoeuvre:
    """Deflection of the tip upwards [m] under LOAD_FACTOR g, static."""

    def __init__(self, wing: Wing) -> None:
        self.assembly = wing.assembly("3")
        self.static = StaticLoads(self.assembly.pattern)
        self.tip = wing.node(TIP)
        points = self.assembly.masses()
        force = torch.zeros(len(points.ends), 6, 1, dtype=torch.float64)
        force[:, 2, 0] = -LOAD_FACTOR * GRAVITY * points.mass.detach()
        self.force = self.assembly.freedoms.gathered(self.assembly.forces_on_nodes(force, points.arm)).detach()

    def __call__(self) -> Tensor:
        moved = self.static(self.assembly.stiffness(), self.force)
        return self.assembly.freedoms.expand(moved)[self.tip, 2, 0]


def difference(load: Manoeuvre, angles: Tensor, k: int, step: float = 0.02) -> float:
    """Richardson's derivative of the deflection by one angle [m/rad]."""
    value = {}
    with torch.no_grad():
        before = angles.detach().clone()
        for part in (-1.0, -0.5, 0.5, 1.0):
            angles[k] = before[k] + part * step
            value[part] = float(load())
        angles.copy_(before)
    wide, narrow = (value[1.0] - value[-1.0]) / (2 * step), (value[0.5] - value[-0.5]) / step
    return (4 * narrow - wide) / 3


def gradient(wing: Wing) -> None:
    """Print the deflection and its derivatives."""
    load, laminates = Manoeuvre(wing), wing.laminates
    angles = {name: laminate.angles for name, laminate in laminates.items()}
    began = time.process_time()
    tip = load()
    forward = time.process_time() - began
    slopes = dict(zip(angles, torch.autograd.grad(tip, list(angles.values())), strict=True))
    back = time.process_time() - began - forward
    count = sum(len(angle) for angle in angles.values())
    print(f"deflection of GRID {TIP} under {LOAD_FACTOR} g: {tip.item() / INCH:.4f} in; MYSTRAN {MYSTRAN_TIP:.4f} in")
    print(f"{count} angles of {len(angles)} stacks; forward {forward:.1f} s, one reverse pass {back:.1f} s of CPU")
    largest = sorted(slopes, key=lambda name: -float(slopes[name].abs().max()))
    print(f"{'largest derivatives':22}{'ply':>5}{'reverse [in/rad]':>20}{'differences':>16}{'relative':>12}")
    for name in (largest[0], largest[len(largest) // 4]):
        k = int(slopes[name].abs().argmax())
        ours, other = float(slopes[name][k]), difference(load, angles[name], k)
        print(f"{name:22}{k:5}{ours / INCH:20.8f}{other / INCH:16.8f}{abs(ours / other - 1):12.1e}")


def mass(wing: Wing) -> None:
    """Print mass, center and inertia next to the printed ones."""
    mass, center, inertia = mass_properties(wing)
    rows = [("mass [lb]", mass, PRINTED_MASS)]
    rows += [(f"center {axis} [in]", float(center[k]), PRINTED_CENTER[k]) for k, axis in enumerate("xyz")]
    rows += [(f"inertia {axis * 2} [lb in2]", float(inertia[k]), PRINTED_INERTIA[k]) for k, axis in enumerate("xyz")]
    print(f"{'':20}{'printed':>16}{'ours':>16}{'ours / printed - 1':>20}")
    for name, ours, printed in rows:
        print(f"{name:20}{printed:16.7g}{ours:16.7g}{ours / printed - 1:20.1e}")


def main(words: list[str]) -> None:
    """Read, and print what is asked for."""
    path = deck()
    if path is None:
        print(f"{VARIABLE} is not the folder models of the repository SteveDoyle2/pyNastran; nothing was run")
        return
    began = time.process_time()
    wing = read(path)
    mesh = wing.body.mesh
    print(f"{DECK.name}: {mesh!r}, {len(wing.body.parts)} parts, read in {time.process_time() - began:.1f} s of CPU")
    for message in wing.messages:
        print(f"  {message}")
    for word in words or ("mass", "frequencies", "gradient"):
        if word == "frequencies":
            print(f"{'mode':20}{'MYSTRAN [Hz]':>16}{'ours [Hz]':>16}{'ours / MYSTRAN - 1':>20}")
            for (name, other), ours in zip(MYSTRAN, frequencies(wing), strict=True):
                print(f"{name:20}{other:16.4f}{ours:16.4f}{ours / other - 1:20.1e}")
        else:
            {"mass": mass, "gradient": gradient}[word](wing)


if __name__ == "__main__":
    main(sys.argv[1:])
