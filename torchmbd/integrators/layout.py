"""Which numbers of a system compiled code takes, and in which order (code.py, blocks.py).

Checked in tests/integrators/test_compiled.py.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from torchmbd.system.initial import START
from torchmbd.system.topology import Topology


class Layout(NamedTuple):
    """Data of a system in the order in which compiled code takes them: names and components.

    Behind them what laws with design variables prescribe, which changes from step to step (`moving`).
    """

    names: tuple[str, ...]
    shapes: tuple[tuple[int, ...], ...]

    @classmethod
    def of(cls, data: dict[str, Any], T: Topology) -> Layout:
        names, varied = names_of(data), [T.primitives[i] for i in T.varied]
        shapes = [tuple(data[name].shape[:-2]) for name in names] + [(p.driven, len(p.data)) for p in varied]
        return cls((*names, *(moving(i) for i in T.varied)), tuple(shapes))


def names_of(data: Mapping[str, Any]) -> list[str]:
    """Data that steps take, in their order: the start of a motion is none."""
    return sorted(name for name in data if name not in START)


# Data that hold every number twice: which axes change places, and the sign. [3, 3, m, m, f], [3, m, m, f], [m, m, f].
_TWICE = {"C1": ((1, 0, 3, 2, 4), 1), "H": ((0, 2, 1, 3), -1), "Kr": ((1, 0, 2), 1)}


@cache
def distinct(name: str, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places of the numbers that are taken of a datum, flat; for each of its entries which of them it is, and the sign."""
    places = np.arange(math.prod(shape))
    if name not in _TWICE:
        return places, places, np.ones(len(places), dtype=int)
    axes, sign = _TWICE[name]
    mirrored = places.reshape(shape).transpose(axes).ravel()
    taken, index = np.unique(np.minimum(places, mirrored), return_inverse=True)
    signs = np.where(mirrored < places, sign, 1)
    return taken, index, np.where(mirrored == places, max(sign, 0), signs)


def moving(kind: int) -> str:
    """Name of what the laws of a kind of primitive prescribe among the data."""
    return f"~{kind}"
