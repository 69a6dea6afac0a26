"""A topology with some of its constraint rows: the same bodies, attached vectors and data, fewer joints.

What a phase of a simulation is to the whole: its data are those of the whole, and its multipliers are rows of the whole's.
Checked in tests/integrate/phases/test_phase.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from torchmbd.multibody.system.index_maps import SegmentSum
from torchmbd.multibody.system.topology import Topology


def selected(T: Topology, rows: Sequence[int]) -> Topology:
    """The topology with the constraint rows `rows` (all those of a primitive or none), in their order."""
    wanted, primitives = set(rows), []
    for primitive, own in T.row_slices():
        n = len(primitive.members[0])
        kept = [j for j in range(n) if own.start + j in wanted]
        if kept:
            members = tuple(member[torch.tensor(kept)] for member in primitive.members)
            primitives.append(type(primitive)(members, tuple(primitive.data[j] for j in kept)))
    vectors = [int(i) for primitive in primitives for member in primitive.members for i in member]
    return replace(
        T,
        primitives=tuple(primitives),
        argument_vectors=torch.tensor(vectors, dtype=torch.long),
        row_names=tuple(T.row_names[i] for i in sorted(wanted)),
        row_joints=tuple(T.row_joints[i] for i in sorted(wanted)),
        vector_sum=SegmentSum(vectors, len(T.attached)),
    )
