"""Wrong arguments of methods of results and of what a user has made: an error that names the argument, and no other."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
import torch

import torchmbd as mbd
from torchmbd.errors import InputError

ENERGY = mbd.StrainEnergy("arm")
WRONG = [
    None,
    "nothing",
    [],
    float("nan"),
    torch.ones(2, 2),
    np.array([1.0, 2.0, 3.0]),
    torch.tensor(0.5),
    {"a": 1},
    3 + 1j,
]


@cache
def objects() -> dict[str, Any]:
    system = mbd.examples.arm()
    problem = mbd.Problem(
        system, 0.02, mbd.Integral(ENERGY), steps=8, bounds=mbd.deg([-90, 90]), variables=["arm.laminate.angles"]
    )
    motion = mbd.simulate(system, 0.02, steps=8)
    return {
        "motion": motion,
        "flexible": motion.body("arm"),
        "rigid": motion.body("tool"),
        "equilibrium": mbd.equilibrium(system),
        "system": system,
        "arm": system.bodies[0],
        "tool": system.bodies[1],
        "mesh": system.bodies[0].mesh,
        "problem": problem,
        "simulation": mbd.Simulation(system, 0.02, steps=8),
        "result": mbd.optimize(problem, max_iterations=1),
    }


#: Object, method, argument, and what of the wrong values is right there.
DOORS: list[tuple[str, str, str, tuple[Any, ...]]] = [
    ("motion", "body", "name", ()),
    ("motion", "reaction", "joint", ()),
    ("motion", "modes", "name", ()),
    ("motion", "to_dataframe", "histories", (None, {"a": 1})),
    ("flexible", "at", "where", (None,)),
    ("rigid", "at", "where", (None, np.zeros(3))),
    ("equilibrium", "eigenvalues", "kind", ()),
    ("system", "body", "name", ()),
    ("arm", "at", "node", ()),
    ("arm", "save_reduced", "path", ()),
    ("tool", "at", "turn", ()),
    ("mesh", "node", "name", ()),
    ("mesh", "node_set", "name", ()),
    ("problem", "errors", "x", ()),
    ("problem", "at_steps", "steps", (None,)),
    ("problem", "motion", "x", ()),
    ("simulation", "with_steps", "steps", (None,)),
    ("result", "plot", "title", ("nothing",)),
]


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize(("name", "method", "argument", "right"), DOORS, ids=lambda x: x if isinstance(x, str) else "")
def test_a_wrong_value_is_refused(name, method, argument, right):
    call = getattr(objects()[name], method)
    for value in WRONG:
        if any(value is x or (type(value) is type(x) and isinstance(x, (str, dict, np.ndarray))) for x in right):
            continue
        with pytest.raises(InputError):
            call(**{argument: value})


def test_a_kind_of_eigenvalues_that_does_not_exist_is_no_natural_frequency():
    with pytest.raises(InputError, match="kind = 'natral': must be one of natural, poles"):
        objects()["equilibrium"].eigenvalues("natral")
