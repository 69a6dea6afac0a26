"""A topology with some of its constraint rows: the same bodies, attached vectors and data, fewer joints.

A phase of a simulation has such a topology: its data are those of the whole system, and its multipliers some of their rows.
Checked in tests/integrate/phases/test_phase.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from torchmbd.multibody.system.index_maps import SegmentSum
from torchmbd.multibody.system.topology import Topology


def selected(T: Topology, rows: Sequence[int]) -> Topology:
    """The topology with the constraint rows `rows` in their order in T; rows hold all or none of the rows of a primitive."""
    selection, primitives = set(rows), []
    for primitive, slice_ in T.row_slices():
        n = len(primitive.members[0])
        kept = [j for j in range(n) if slice_.start + j in selection]
        if kept:
            members = tuple(member[torch.tensor(kept)] for member in primitive.members)
            primitives.append(type(primitive)(members, tuple(primitive.data[j] for j in kept)))
    vectors = [int(i) for primitive in primitives for member in primitive.members for i in member]
    return replace(
        T,
        primitives=tuple(primitives),
        argument_vectors=torch.tensor(vectors, dtype=torch.long),
        row_names=tuple(T.row_names[i] for i in sorted(selection)),
        row_joints=tuple(T.row_joints[i] for i in sorted(selection)),
        vector_sum=SegmentSum(vectors, len(T.attached)),
    )
