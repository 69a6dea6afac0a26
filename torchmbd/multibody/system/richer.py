"""A copy of a system whose flexible bodies have more modes (multibody/bodies/richer_reduction.py).

Checked in tests/multibody/system/test_richer.py.
"""

from __future__ import annotations

import copy
from typing import Any

from torchmbd.multibody.bodies.richer_reduction import enrich, has_reduction


def richer_system(system: Any) -> tuple[Any, list[str]]:
    """A copy of a system whose flexible bodies have more modes, and the names of those that do; parameters are copies too.

    Bodies whose modes were given, and those that have all modes of their mesh, are as before.
    """
    other = copy.deepcopy(system)
    other.truncation = None  # of the modes that are in question
    richer = []
    for name in other.topology.names[: other.topology.flexible]:
        body = other.body(name)
        if has_reduction(body) and enrich(body):
            richer.append(name)
    other.load_state_dict(other.state_dict())  # joins the bodies again
    return other, richer
