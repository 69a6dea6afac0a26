"""Copies of a system whose flexible bodies have more modes or finer meshes (bodies/refinement.py).

Bodies and parameters are copies too.
Checked in tests/diagnosis/test_richer.py.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from typing import Any

from torchmbd.multibody.bodies.refinement import enrich, has_reduction, obstacle, refine


def richer_system(system: Any, modes: Mapping[str, int] | None = None) -> tuple[Any, list[str]]:
    """A copy of a system whose flexible bodies have more modes, and the names of those that do.

    Bodies whose modes were given, and those that have all modes of their mesh, are as before.
    modes   number that each body has, by name, largest of several designs; default: those of the first design
    """
    counts = modes or {}
    return _changed(system, lambda body: has_reduction(body) and enrich(body, counts.get(body.name) or body.modes))


def finer_mesh_system(system: Any) -> tuple[Any, list[str]]:
    """A copy of a system whose flexible bodies have finer meshes, and the names of those that do."""

    def change(body: Any) -> bool:
        if obstacle(body):
            return False
        refine(body)
        return True

    return _changed(system, change)


def _changed(system: Any, change: Callable[[Any], bool]) -> tuple[Any, list[str]]:
    other = copy.deepcopy(system)
    other.truncation = None  # of the modes that are in question
    other.diagnosed.clear()
    names = [name for name in other.topology.names[: other.topology.flexible] if change(other.body(name))]
    other.load_state_dict(other.state_dict())  # joins the bodies again
    return other, names
