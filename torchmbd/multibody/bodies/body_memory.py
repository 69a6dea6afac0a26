"""Memory of the structure stage of a body of elements, estimated before it is taken.

    once       nodes * TABLES + MATRICES * numbers
    a design   nodes * (NODE + FILL * (log2(6 nodes) - 9) + MODE * modes + slopes * (SLOPE + MODE_SLOPE * modes))

numbers   those of the matrices of cells (fem/elements/cell_stiffness.py). Cells of equal shape share them: a plate of
          rectangles has few, and a curved shell has 6,300 for each quadrilateral
FILL      the factor of K, which has about 162 (log2(6 nodes) - 9) entries for each node of a plate, and its fronts
modes     all shapes of the basis: six for each node of a Craig-Bampton interface as well
slopes    derivatives by design variables that are propagated forward

Measured on the peak of processes: plates of 65 to 83,000 nodes, wing boxes of 555 to 9,669 nodes, curved shells of 1,700 to
19,500 nodes, 6 to 20 modes, up to 16 designs. The peak is 0.8 to 1.4 times the estimate.
Checked in tests/multibody/bodies/test_body_memory.py, tests/integrate/test_memory.py.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from torchmbd.errors import InputError
from torchmbd.fem.elements import Part, Plates
from torchmbd.math.checked_numbers import is_whole
from torchmbd.process import available_memory, bytes_text, rounded_down

_TABLES, _MATRICES = 25_000.0, 14.0  # bytes for each node, for each number of the matrices of cells
_NODE, _FILL, _MODE, _SLOPE, _MODE_SLOPE = 8600.0, 2000.0, 600.0, 1000.0, 400.0  # bytes for each node
_FEW = 6  # modes: where these fit the mesh is not too large


def table_bytes(nodes: int, parts: Iterable[Part]) -> float:
    """Estimated bytes that all designs share."""
    numbers = sum(part.matrices.numbers for part in parts if isinstance(part, Plates))
    return nodes * _TABLES + _MATRICES * numbers


def design_bytes(nodes: int, modes: int, slopes: int = 0) -> float:
    """Estimated bytes of one design."""
    fill = _FILL * max(math.log2(6 * nodes) - 9.0, 1.0)
    return nodes * (_NODE + fill + _MODE * modes + slopes * (_SLOPE + _MODE_SLOPE * modes))


def require_memory(name: str, nodes: int, parts: Iterable[Part], modes: Any, kept: int = 0) -> None:
    """Refuse a body that does not fit into memory; InputError names the argument that is too large, and what fits.

    kept   nodes of the interface: each has six shapes beside the modes
    """
    count = min(modes, 6 * nodes) if is_whole(modes) else 0
    few, free = min(count, _FEW), available_memory()
    without = table_bytes(nodes, parts) + design_bytes(nodes, 0)
    needed = without + nodes * _MODE * (count + 6 * kept)
    if needed <= free:
        return
    fitting = int((free - without) / (nodes * _MODE))
    sizes = f"take about {bytes_text(needed)} of memory, of which {bytes_text(free)} are available"
    if fitting >= 6 * kept + few:
        allowed = f"at most {rounded_down(fitting - 6 * kept)}"
        raise InputError((name, "modes"), modes, allowed, shown=str(modes), state=sizes)
    if kept and fitting >= 6 + few:
        allowed = f"must have at most {rounded_down((fitting - few) // 6)}"
        raise InputError((name, "interface"), allowed=allowed, state=f"has {kept} nodes, whose shapes {sizes}")
    raise InputError(
        (name, "mesh"),
        allowed=f"must have at most {rounded_down(int(6 * nodes * free / needed))} degrees of freedom",
        noun=f"mesh of {name!r}",
        state=f"has {6 * nodes} degrees of freedom, whose modes {sizes}",
    )
