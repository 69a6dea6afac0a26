"""The largest complete shell deck of others that was found, from file to Craig-Bampton body, read unedited.
`python -m experiments.peers.battery_pack`

examples/battery/battery_pack.bdf of the repository smdogroup/tacs (written by Femap): nine cells and the block around them,
10,205 grids, 9,989 shells of ten properties, in meters. TACS is the folder of that repository. Interface: the four corners of
the upper side of the block. Printed: processor seconds of reading, and seconds and memory of the body.
"""

from __future__ import annotations

import os
import resource
import time
from pathlib import Path

import torch

import torchmbd as mbd
from torchmbd.extensions.nastran.body import bulk_body

VARIABLE = "TACS"
DECK = Path("examples") / "battery" / "battery_pack.bdf"
MODES = 20


def resident_mb() -> float:
    """Largest so far, of a process that a shell began."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def corners(nodes: torch.Tensor) -> list[int]:
    """The nodes that are nearest to the four corners of the box around all nodes, at its upper side."""
    low, high = nodes.amin(0), nodes.amax(0)
    places = [torch.stack([x, y, high[2]]) for x in (low[0], high[0]) for y in (low[1], high[1])]
    return [int((nodes - place).norm(dim=1).argmin()) for place in places]


def main() -> None:
    """Read, reduce and print."""
    torch.set_num_threads(1)
    folder = os.environ.get(VARIABLE)
    if folder is None:
        print(f"{VARIABLE} is not the folder of the repository smdogroup/tacs; nothing was run")
        return
    path = Path(folder) / DECK
    start = time.process_time()
    mesh = bulk_body(path).mesh
    kept = corners(mesh.nodes)
    read, before = time.process_time(), resident_mb()
    body = mbd.io.read_bdf(
        path, "pack", modes=MODES, reduction="craig-bampton", interface=kept[1:], reference=[kept[0]]
    )
    print(f"{DECK.name}: {mesh}; interface nodes {kept}")
    print(f"read: {read - start:.1f} s of CPU")
    seconds, memory = time.process_time() - read, resident_mb() - before
    print(f"read and Craig-Bampton body of {body.modes} shapes: {seconds:.1f} s of CPU, {memory:.0f} MB")


if __name__ == "__main__":
    main()
