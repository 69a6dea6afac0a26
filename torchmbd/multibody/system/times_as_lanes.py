"""What is known at several times as one, the times in the place of lanes: a whole motion is evaluated at once.

Of systems whose only prescribed body is the ground.
Checked in tests/physics/test_energies.py, tests/results/test_reaction.py, tests/multibody/system/test_condensation.py.
"""

from __future__ import annotations

from typing import Any

import torch

from torchmbd.math.pair import Pair
from torchmbd.multibody.system.topology import Prescribed


def as_lanes(known: list[Prescribed], lanes: int = 1, lanes_first: bool = False) -> Prescribed:
    """What is known at some times for `lanes` lanes, as lanes [times x lanes], or [lanes x times]; t [times] stays."""
    laws = [
        None if kind[0] is None else tuple(_joined(part, lanes, lanes_first) for part in zip(*kind, strict=True))
        for kind in zip(*(each.laws for each in known), strict=True)
    ]
    return known[0]._replace(laws=laws, t=torch.stack([each.t for each in known]))


def _joined(parts: tuple[Any, ...], lanes: int, lanes_first: bool) -> Any:
    full = [x.full if isinstance(x, Pair) else x for x in parts]
    wide = [x.expand(*x.shape[:-1], lanes) for x in full]
    found = torch.stack(wide, -1 if lanes_first else -2).flatten(-2)
    return Pair(found) if isinstance(parts[0], Pair) else found
