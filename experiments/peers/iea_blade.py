"""The blade of the IEA 15 MW reference turbine. `python -m experiments.peers.iea_blade [sections] [frequencies]`

Repository IEAWindTask37/IEA-15-240-RWT: WT_Ontology/IEA-15-240-RWT.yaml (windIO: airfoils, webs, layers), and what others made
of it for OpenFAST: the 6 x 6 sections of BeamDyn (SONATA with ANBA4) and mass and bending stiffness of ElastoDyn (PreComp).
IEA15_RWT is the folder of the repository.

    sections      our sections of the windIO file beside both
    frequencies   the clamped blade at rest and at rated speed, 7.56 rpm about x, 3.97 m from the axis, without cone; by
                  exact beams of BeamDyn's table and of our sections. Published, at rest: E. Gaertner et al., Definition of the
                  IEA Wind 15-Megawatt Offshore Reference Wind Turbine, NREL/TP-5000-75698 (2020)

Checked in tests/experiments/test_iea_blade.py.
"""

from __future__ import annotations

import math
import os
import sys
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import torchmbd as mbd

VARIABLE = "IEA15_RWT"
BLADE = Path("WT_Ontology") / "IEA-15-240-RWT.yaml"
OPENFAST = Path("OpenFAST") / "IEA-15-240-RWT"
RATED, HUB = 7.56 * 2.0 * math.pi / 60.0, 3.97  # rad/s, m
PUBLISHED, PUBLISHED_MASS = (0.555, 0.642), 65250.0  # Hz: first flapwise, first edgewise; kg
SPAN = (0.0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 1.0)


def folder() -> Path | None:
    """The repository, where IEA15_RWT says so."""
    path = os.environ.get(VARIABLE)
    return Path(path) if path and (Path(path) / BLADE).is_file() else None


def beamdyn(root: Path) -> mbd.SectionTable:
    """BeamDyn's sections."""
    return mbd.io.read_beamdyn(root / OPENFAST / "IEA-15-240-RWT_BeamDyn_blade.dat")


def key_points(root: Path) -> np.ndarray:
    """Places x, y, z [m] and twist [deg] of BeamDyn's primary file."""
    rows = []
    for line in (root / OPENFAST / "IEA-15-240-RWT_BeamDyn.dat").read_text().splitlines():
        words = line.split()
        if len(words) == 4 and all(any(c.isdigit() for c in word) and word[0] in "-.0123456789" for word in words):
            rows.append([float(word) for word in words])
    return np.array(rows)


def elastodyn(root: Path, position: float) -> tuple[float, float, float]:
    """Mass per length [kg/m], flapwise and edgewise bending stiffness [N m2] of ElastoDyn."""
    rows = []
    for line in (root / OPENFAST / "IEA-15-240-RWT_ElastoDyn_blade.dat").read_text().splitlines():
        words = line.split()
        if len(words) == 6 and all(word[0] in "-.0123456789" for word in words):
            rows.append([float(word) for word in words])
    table = np.array(rows)
    mass, flap, edge = (float(np.interp(position, table[:, 0], table[:, k])) for k in (3, 4, 5))
    return mass, flap, edge


def bending(K: Tensor) -> tuple[float, float]:
    """Flapwise and edgewise bending stiffness about the tension center."""
    S = torch.linalg.inv(K)
    about = torch.linalg.inv(S[4:, 4:])
    return float(about[1, 1]), float(about[0, 0])


def sections(root: Path) -> None:
    """Print stiffness and mass along the span beside the tables."""
    blade, table = mbd.io.read_windio(root / BLADE), beamdyn(root)
    print("ours / BeamDyn - 1 [%]                                                            ours / ElastoDyn - 1 [%]")
    print(f"{'span':>5}{'E A':>8}{'G A_y':>8}{'G A_z':>8}{'G J':>8}{'edge':>8}{'flap':>8}{'mass':>8}{'J':>8}", end="")
    print(f"{'mass':>12}{'flap':>8}{'edge':>8}")
    for position in SPAN:
        section = blade.section(position)
        with torch.no_grad():
            K, M = section.stiffness(), section.mass()
        at = torch.tensor([position], dtype=torch.float64)
        other, inertia = table.stiffness(at)[0].detach(), table.mass(at)[0].detach()
        row = [*(K.diagonal() / other.diagonal()), M[0, 0] / inertia[0, 0], M[3, 3] / inertia[3, 3]]
        third = [a / b for a, b in zip((float(M[0, 0]), *bending(K)), elastodyn(root, position), strict=True)]
        print(f"{position:5.2f}" + "".join(f"{100 * (float(x) - 1):8.1f}" for x in row), end="    ")
        print("".join(f"{100 * (x - 1):8.1f}" for x in third))


def beam(root: Path, table: mbd.SectionTable, elements: int = 40) -> mbd.ExactBeam:
    """The clamped blade: z along it, x downwind, from the axis of the rotor."""
    points = key_points(root)
    s = np.linspace(0.0, 1.0, elements + 1)
    share = points[:, 2] / points[-1, 2]
    nodes = np.stack([np.interp(s, share, points[:, k]) for k in range(3)], 1)
    nodes[:, 2] += HUB
    twist = -np.deg2rad(np.interp(s, share, points[:, 3]))  # positive twist turns the nose into the wind, about -z
    line = mbd.BeamLine(
        nodes.tolist(), [[k, k + 1] for k in range(elements)], node_sets={"start": [0], "end": [elements]}
    )
    angles = torch.from_numpy(np.stack([twist[:-1], twist[1:]], 1))
    return mbd.ExactBeam("blade", line, table, orientation=(1.0, 0.0, 0.0), twist=angles)


def plain(root: Path) -> mbd.SectionTable:
    """ElastoDyn's numbers as sections: stiff in stretch, shear and torsion, as they are held there."""
    sections = []
    for position in SPAN:
        mass, flap, edge = elastodyn(root, position)
        K = torch.diag(torch.tensor([1e11, 1e11, 1e11, 1e11, edge, flap], dtype=torch.float64))
        M = torch.diag(torch.tensor([mass, mass, mass, mass, 0.5 * mass, 0.5 * mass], dtype=torch.float64) + 1e-6)
        sections.append((K, M))
    return mbd.SectionTable(list(SPAN), sections)


def mass(table: mbd.SectionTable, length: float = 117.0) -> float:
    """Mass of the blade [kg]."""
    s = torch.linspace(0.0, 1.0, 2001, dtype=torch.float64)
    return float(torch.trapezoid(table.mass(s)[:, 0, 0].detach(), s)) * length


def frequencies(root: Path) -> None:
    """Print the first frequencies at rest and at rated speed."""
    blade = mbd.io.read_windio(root / BLADE)
    sections = mbd.SectionTable(list(SPAN), [blade.section(position) for position in SPAN])
    print(f"{'[Hz]':28}{'flap 1':>9}{'edge 1':>9}{'flap 2':>9}{'edge 2':>9}{'flap 3':>9}{'mass [kg]':>12}")
    print(f"{'published, at rest':28}" + "".join(f"{x:9.3f}" for x in PUBLISHED) + f"{'':27}{PUBLISHED_MASS:12.0f}")
    for name, table in (
        ("BeamDyn's table", beamdyn(root)),
        ("our sections", sections),
        ("ElastoDyn's table", plain(root)),
    ):
        body = beam(root, table)
        for words, spin in (("at rest", 0.0), ("at 7.56 rpm", RATED)):
            with torch.no_grad():
                frequencies, state = body.frequencies(5, spin=(spin, 0.0, 0.0))
            print(
                f"{name + ', ' + words:28}" + "".join(f"{float(x):9.3f}" for x in frequencies) + f"{mass(table):12.0f}"
            )
            assert state.status == "ok"


def main(words: list[str]) -> None:
    """Print what is asked for."""
    root = folder()
    if root is None:
        print(f"{VARIABLE} is not the folder of the repository IEAWindTask37/IEA-15-240-RWT; nothing was run")
        return
    for word in words or ("sections", "frequencies"):
        {"sections": sections, "frequencies": frequencies}[word](root)


if __name__ == "__main__":
    main(sys.argv[1:])
