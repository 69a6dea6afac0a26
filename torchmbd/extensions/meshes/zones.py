"""Laminates for the named zones of a mesh: every cell gets exactly one.

Checked in tests/extensions/meshes/test_read_mesh.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from torchmbd.errors import InputError, unknown
from torchmbd.extensions.meshes.mesh_file import MeshFile
from torchmbd.fem.elements import Part, Plates
from torchmbd.fem.materials import Laminate


def zone_parts(
    file: MeshFile, laminate: Laminate | Mapping[str, Laminate], direction: Sequence[float] | Tensor, mass: str
) -> dict[str, Part]:
    """Make a part of each laminate. InputError if a zone does not exist, or a cell has no laminate or two."""
    mesh, zones = file
    if isinstance(laminate, Laminate):
        return {"plate": Plates(mesh, laminate, direction, mass=mass)}
    if not isinstance(laminate, Mapping):
        raise InputError("laminate", laminate, "a Laminate, or one for each zone by its name")
    count = torch.zeros(mesh.cell_count, dtype=torch.long)
    parts: dict[str, Part] = {}
    for name, layup in laminate.items():
        if name not in zones:
            raise unknown("zone", name, zones)
        if not name.isidentifier():
            raise InputError(
                ("zones", name),
                name,
                "a Python identifier",
                noun=f"zone {name!r}",
                state="becomes part of parameter names",
            )
        count[zones[name]] += 1
        parts[name] = Plates(mesh, layup, direction, zones[name], mass)
    wrong = torch.nonzero(count != 1)[:, 0]
    if len(wrong):
        k = int(wrong[0])
        raise InputError(
            "laminate",
            list(laminate),
            f"must lie in one zone each (the mesh has {', '.join(zones)})",
            noun=f"{mesh.cell_name(k)} and {len(wrong) - 1} others",
            state=f"lie in {int(count[k])} of the zones {', '.join(laminate)}",
        )
    return parts
