"""Blades of two reference turbines in windIO 1 and 2. `python -m experiments.peers.windio_versions [15] [22]`

    version 1   repository IEAWindTask37/IEA-15-240-RWT, WT_Ontology; IEAWindTask37/IEA-22-280-RWT, windIO
    version 2   examples of the package windIO 2.1.1, which must be installed
    tables      6 x 6 sections: elastic_properties of version 2, and BeamDyn's beside version 1, in OpenFAST
IEA15_RWT and IEA22_RWT are the folders of the repositories.

For each turbine: sections of both versions at points of the files' grids, mass of the blade, and frequencies of the clamped
blade at rest.
Checked in tests/experiments/test_windio_versions.py.
"""

from __future__ import annotations

import importlib.util
import os
import sys
import warnings
from pathlib import Path

import numpy as np
import torch
import yaml
from torch import Tensor

import torchmbd as mbd

NAMES = {"15": "IEA-15-240-RWT", "22": "IEA-22-280-RWT"}
FIRST = {"15": "WT_Ontology/IEA-15-240-RWT.yaml", "22": "windIO/IEA-22-280-RWT.yaml"}
BEAMDYN = {"15": "IEA-15-240-RWT_BeamDyn_blade.dat", "22": "IEA-22-280-RWT_BeamDyn_Blade.dat"}
GRID = {"15": 49, "22": 100}  # intervals of the files' grids: stations lie on their points
SPAN = (0.0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.96, 1.0)
ROWS = ["K11", "K12", "K13", "K14", "K15", "K16", "K22", "K23", "K24", "K25", "K26", "K33", "K34", "K35", "K36", "K44"]
ROWS += ["K45", "K46", "K55", "K56", "K66"]


def files(turbine: str) -> tuple[Path, Path, Path] | None:
    """File of version 1, of version 2, and BeamDyn's table, if they are on this machine."""
    folder, package = os.environ.get(f"IEA{turbine}_RWT"), importlib.util.find_spec("windIO")
    if not folder or package is None or package.origin is None:
        return None
    examples = Path(package.origin).parent / "examples" / "turbine"
    table = Path(folder) / "OpenFAST" / NAMES[turbine] / BEAMDYN[turbine]
    paths = Path(folder) / FIRST[turbine], examples / f"{NAMES[turbine]}.yaml", table
    return paths if all(path.is_file() for path in paths) else None


def quiet_section(path: Path, position: float) -> tuple[Tensor, Tensor]:
    """Stiffness and mass of a blade's section; its warnings are of places without room, equal in both versions."""
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")
        section = mbd.io.read_windio(path).section(position)
        return section.stiffness(), section.mass()


def axis(path: Path, elements: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Nodes [n, 3] (z along the blade, x to the suction side) and twist [n] along the span."""
    blade = mbd.io.read_windio(path)
    stations = [blade.station(float(s)) for s in np.linspace(0.0, 1.0, elements + 1)]
    return np.array([[at[k] for k in "xyz"] for at in stations]), np.array([at["twist"] for at in stations])


def frequencies(path: Path, table: mbd.SectionTable) -> Tensor:
    """The first five frequencies [Hz] of the clamped blade."""
    nodes, twist = axis(path)
    n = len(nodes) - 1
    line = mbd.BeamLine(nodes.tolist(), [[k, k + 1] for k in range(n)], node_sets={"start": [0], "end": [n]})
    angles = torch.from_numpy(-np.stack([twist[:-1], twist[1:]], 1))  # a positive twist turns about -z
    with torch.no_grad():
        result, state = mbd.ExactBeam("blade", line, table, orientation=(1.0, 0.0, 0.0), twist=angles).frequencies(5)
    assert state.status == "ok", state.status
    return result


def mass(path: Path, table: mbd.SectionTable) -> float:
    """Mass of the blade [kg]."""
    nodes, _ = axis(path, 2000)
    length = float(np.linalg.norm(np.diff(nodes, axis=0), axis=1).sum())
    s = torch.linspace(0.0, 1.0, 2001, dtype=torch.float64)
    return float(torch.trapezoid(table.mass(s)[:, 0, 0].detach(), s)) * length


def elastic_properties(path: Path) -> mbd.SectionTable:
    """Sections of elastic_properties in version 2; its axes are BeamDyn's (z along the blade), ours have x along it."""
    data = yaml.load(path.read_text(encoding="utf-8"), getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    table = data["components"]["blade"]["structure"]["elastic_properties"]
    stiffness, inertia = table["stiffness_matrix"], table["inertia_matrix"]
    m, x, y = (np.array(inertia[key], dtype=float) for key in ("mass", "cm_x", "cm_y"))
    K, M = np.zeros((len(m), 6, 6)), np.zeros((len(m), 6, 6))
    for key in ROWS:
        i, j = int(key[1]) - 1, int(key[2]) - 1
        K[:, i, j] = K[:, j, i] = stiffness.get(key, 0.0)
    M[:, [0, 1, 2], [0, 1, 2]] = m[:, None]
    M[:, 3, 3], M[:, 4, 4], M[:, 5, 5] = inertia["i_edge"], inertia["i_flap"], inertia["i_plr"]
    for i, j, values in (
        (0, 5, -m * y),
        (1, 5, m * x),
        (2, 3, m * y),
        (2, 4, -m * x),
        (3, 4, -np.array(inertia["i_cp"])),
    ):
        M[:, i, j] = M[:, j, i] = values
    order = [2, 0, 1, 5, 3, 4]
    pairs = [(k[order][:, order], n[order][:, order]) for k, n in zip(K, M, strict=True)]
    return mbd.SectionTable(stiffness["grid"], pairs)


def apart(table: mbd.SectionTable, other: mbd.SectionTable) -> tuple[float, float]:
    """Largest differences of stiffness and mass at the stations of the other, by the largest number of each matrix."""
    at = other.positions
    pairs = ((table.stiffness(at), other.stiffness(at)), (table.mass(at), other.mass(at)))
    stiffness, mass_ = (float(((a - b).abs().amax((1, 2)) / b.abs().amax((1, 2))).detach().max()) for a, b in pairs)
    return stiffness, mass_


def compared(turbine: str, first: Path, second: Path, path: Path) -> None:
    """Print sections, mass and frequencies."""
    beamdyn, elastic = mbd.io.read_beamdyn(path), elastic_properties(second)
    print(f"{NAMES[turbine]}: version 2 / version 1 - 1 [1e-4]{'':32}version 2 / its elastic_properties - 1 [%]")
    print(f"{'span':>5}{'E A':>8}{'G A_y':>8}{'G A_z':>8}{'G J':>8}{'edge':>8}{'flap':>8}{'mass':>8}", end="   ")
    print(f"{'E A':>8}{'G A_y':>8}{'G A_z':>8}{'G J':>8}{'edge':>8}{'flap':>8}{'mass':>8}")
    tables: dict[Path, list[tuple[Tensor, Tensor]]] = {first: [], second: []}
    span = [round(GRID[turbine] * position) / GRID[turbine] for position in SPAN]
    for position in span:
        for file, rows in tables.items():
            rows.append(quiet_section(file, position))
        (K1, M1), (K2, M2) = (rows[-1] for rows in tables.values())
        at = torch.tensor([position], dtype=torch.float64)
        K3, M3 = elastic.stiffness(at)[0].detach(), elastic.mass(at)[0].detach()
        pairs = [[*(K2.diagonal() / K.diagonal() - 1.0), M2[0, 0] / M[0, 0] - 1.0] for K, M in ((K1, M1), (K3, M3))]
        print(f"{position:5.2f}" + "".join(f"{1e4 * float(x):8.1f}" for x in pairs[0]), end="   ")
        print("".join(f"{100 * float(x):8.1f}" for x in pairs[1]))
    print(f"{'[Hz]':28}{'flap 1':>9}{'edge 1':>9}{'flap 2':>9}{'edge 2':>9}{'flap 3':>9}{'mass [kg]':>12}")
    ours = {file: mbd.SectionTable(span, rows) for file, rows in tables.items()}
    for name, file, table in (
        ("version 1", first, ours[first]),
        ("version 2", second, ours[second]),
        ("elastic_properties", second, elastic),
        ("BeamDyn's table", second, beamdyn),
    ):
        numbers = "".join(f"{float(x):9.4f}" for x in frequencies(file, table))
        print(f"{name:28}{numbers}{mass(file, table):12.1f}")
    stiffness, inertia = apart(elastic, beamdyn)
    print(
        f"elastic_properties beside BeamDyn at its {len(beamdyn.positions)} stations: {stiffness:.1e}, mass {inertia:.1e}"
    )


def main(words: list[str]) -> None:
    """Compare the turbines that are asked for."""
    for turbine in words or list(NAMES):
        paths = files(turbine)
        if paths is None:
            print(
                f"{NAMES[turbine]}: IEA{turbine}_RWT is not its repository, or windIO is not installed; nothing was run"
            )
        else:
            compared(turbine, *paths)


if __name__ == "__main__":
    main(sys.argv[1:])
