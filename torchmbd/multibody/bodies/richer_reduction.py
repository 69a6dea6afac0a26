"""A flexible body with more vibration modes, to see what its modes leave out.

    n' = max(n + 2, 3 n / 2)     and whole clusters of equal frequencies; at most as many as the mesh has

The interface of Craig-Bampton stays as it is. The span of the modes contains the one before.
Checked in tests/multibody/system/test_richer.py.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch

from torchmbd.fem.reduction import with_whole_clusters
from torchmbd.multibody.bodies.frame import set_modal_start
from torchmbd.multibody.bodies.reduced import matrices

MORE, LEAST = 1.5, 2  # times the vibration modes, and at least so many more


def has_reduction(body: Any) -> bool:
    """Whether the modes of a flexible body were chosen here: not given by the user, nor by another program."""
    return hasattr(body if body.given_structure is None else body.given_structure, "reduction")


def enrich(body: Any) -> bool:
    """Give a flexible body that has a reduction more modes; False: it has all modes of its mesh, and nothing was changed.

    Its modal start is zero afterwards. Damping ratios of the further modes are that of the last one.
    """
    structure = body.given_structure
    with torch.no_grad():
        K, M = matrices(body.assembly) if structure is None else structure.pencil()
        before = body.reduction if structure is None else structure.reduction
        n = min(max(before.n + LEAST, math.ceil(MORE * before.n)), K.size - len(before.interface))
        if n <= before.n:
            return False
        reduction = with_whole_clusters(replace(before, n=n), K, M)
    if structure is None:
        body.reduction = reduction
    else:
        structure.keep(reduction)
    body.modes = reduction.size
    set_modal_start(body, None, None)
    return True
