"""The flexible bodies of a design: what writers of files take.

    flexible_bodies(result)     of the best design of an optimization, in a copy of its system
    flexible_bodies(system)     of the present numbers of a system, or of a body

Checked in tests/design/test_flexible_bodies.py.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch

from torchmbd.design.space import DesignSpace
from torchmbd.errors import InputError
from torchmbd.multibody.bodies import FlexibleBody
from torchmbd.multibody.system import System
from torchmbd.optimization.multistart import MultistartResult

ALLOWED = "a flexible body, a System, a result of mbd.optimize or mbd.optimization.multistart, or a study of mbd.load"


def flexible_bodies(argument: str, design: Any) -> list[FlexibleBody]:
    """Return the flexible bodies; InputError names the argument where it has none."""
    if isinstance(design, FlexibleBody):
        return [design]
    system = design if isinstance(design, System) else _system_of(argument, design)
    bodies = [body for body in system.bodies if isinstance(body, FlexibleBody)]
    if not bodies:
        raise InputError(argument, design, "must have a flexible body", state="has rigid bodies alone")
    return bodies


def _system_of(argument: str, result: Any) -> System:
    """Return a copy of the system of a result, whose parameters are those of its best design."""
    if isinstance(result, MultistartResult):
        if result.best is None:
            raise InputError(argument, result, "must have a feasible design", state="is a multistart that found none")
        result = result.best
    problem, x = getattr(result, "problem", None), getattr(result, "x", None)
    while not isinstance(getattr(problem, "space", None), DesignSpace) and hasattr(problem, "problem"):
        problem = getattr(problem, "problem", None)  # of a RobustProblem
    space, system = getattr(problem, "space", None), getattr(problem, "system", None)
    if not isinstance(space, DesignSpace) or not isinstance(system, System) or not isinstance(x, np.ndarray):
        raise InputError(argument, result, ALLOWED, state=f"is a {type(result).__name__}")
    system = copy.deepcopy(system)
    with torch.no_grad():
        for name, values in space.designs(x[None, : len(space.names)]).items():
            system.get_parameter(name).copy_(values[0])
    return system
