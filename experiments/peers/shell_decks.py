"""The largest complete shell decks of others that were found, from file to Craig-Bampton body, read unedited.
`python -m experiments.peers.shell_decks`

    battery_pack.bdf            of the repository smdogroup/tacs (TACS is its folder), written by Femap: nine cells in a block,
                                10,205 grids, 9,989 shells of ten properties, in meters
    nastran_input_geometry.inp  of mid2SUPAERO/StaticAeroelasticity-MDO-IACONO (CRM_WING is its folder), in free fields: the
                                wing of NASA's Common Research Model, 10,824 grids, 12,475 shells of 12 properties, 14,134 bars
                                with offsets of 6 properties, 20 masses, 120 equations

Interface: the nodes of shells that are nearest to the four corners of the box around all, at its upper side. Each deck is read
in a process of its own. Printed: processor seconds of reading, and seconds and memory of the body.
"""

from __future__ import annotations

import multiprocessing
import os
import resource
import time
import warnings
from pathlib import Path

import torch

import torchmbd as mbd
from torchmbd.extensions.nastran.body import bulk_body

DECKS = {
    "TACS": Path("examples") / "battery" / "battery_pack.bdf",
    "CRM_WING": Path("Codes") / "test cases" / "Input Files" / "nastran_input_geometry.inp",
}
MODES = 20


def resident_mb() -> float:
    """Largest so far, of a process that a small one began."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def corners(mesh: mbd.Mesh) -> list[int]:
    """The nodes of shells that are nearest to the four corners of the box around all of these, at its upper side."""
    used = torch.cat([mesh.triangles.flatten(), mesh.quads.flatten()]).unique()
    nodes = mesh.nodes[used]
    low, high = nodes.amin(0), nodes.amax(0)
    places = [torch.stack([x, y, high[2]]) for x in (low[0], high[0]) for y in (low[1], high[1])]
    return [int(used[(nodes - place).norm(dim=1).argmin()]) for place in places]


def report(path: Path) -> str:
    """Read and reduce a deck; return the lines about it."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")  # of cards that are left out
    start = time.process_time()
    mesh = bulk_body(path).mesh
    kept = corners(mesh)
    read, before = time.process_time(), resident_mb()
    body = mbd.io.read_bdf(
        path, "body", modes=MODES, reduction="craig-bampton", interface=kept[1:], reference=[kept[0]]
    )
    seconds, memory = time.process_time() - read, resident_mb() - before
    return (
        f"{path.name}: {mesh}; interface nodes {kept}\nread: {read - start:.1f} s of CPU\n"
        f"read and Craig-Bampton body of {body.modes} shapes: {seconds:.1f} s of CPU, {memory:.0f} MB"
    )


def main() -> None:
    """Print the lines of each deck whose folder is known."""
    for variable, path in DECKS.items():
        folder = os.environ.get(variable)
        if folder is None:
            print(f"{variable} is not the folder of its repository; {path.name} was not read")
            continue
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            print(pool.apply(report, [Path(folder) / path]))


if __name__ == "__main__":
    main()
