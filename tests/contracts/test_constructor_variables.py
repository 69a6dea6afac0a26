"""A constructor takes a number as a variable as well, or refuses it at once with the path of the argument; so it does words,
lists, objects, mappings, nan and infinity.

Taken: the variable is a parameter of what was made, or a field of a law or material that systems make parameters of.
Gradients by those that are taken: tests/sensitivity.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from typing import Any

import pytest
from torch import nn

import torchmbd as mbd

PLY = mbd.examples.carbon()
GROUND = mbd.Ground()
MESH = mbd.mesh.rectangle(0.2, 0.05, cells=(4, 1))
MODULI = {"E1": 1e11, "E2": 1e10, "G12": 5e9, "G13": 5e9, "G23": 3e9, "nu12": 0.3, "density": 1500.0}
STRENGTHS = {"Xt": 1e9, "Xc": 1e9, "Yt": 5e7, "Yc": 1e8, "S12": 6e7}
AREAS = {"E": 2e11, "nu": 0.3, "density": 7850.0, "area": 1e-4, "Iyy": 1e-9, "Izz": 1e-9, "J": 1e-9}
WALL = {"ply": PLY, "angles": [0.0]}


def body() -> mbd.RigidBody:
    return mbd.RigidBody("arm", 1.0, (0.01, 0.01, 0.01))


def between(kind: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    return lambda **k: kind(GROUND.at(), body().at(1.0, 0, 0), **{**options, **k})


def plate(**k: Any) -> mbd.FlexibleBody:
    laminate = mbd.Laminate(PLY, [0.0], 1e-3)
    return mbd.FlexibleBody.plate("plate", MESH, laminate, modes=1, reference="left_edge", **k)


#: constructor, its numbers, and others that it needs
CASES: dict[str, tuple[Callable[..., Any], Mapping[str, Any], Mapping[str, Any]]] = {
    "RigidBody": (lambda mass: mbd.RigidBody("a", mass, (0.1, 0.1, 0.1)), {"mass": 1.0}, {}),
    "position of a RigidBody": (
        lambda **k: mbd.RigidBody("a", 1.0, (0.1, 0.1, 0.1), **{key: (x, 0.0, 0.0) for key, x in k.items()}),
        {"position": 0.1, "velocity": 0.1},
        {},
    ),
    "SpringDamper": (between(mbd.SpringDamper, stiffness=10.0), {"stiffness": 10.0, "damping": 1.0}, {}),
    "AxialSpringDamper": (
        between(mbd.AxialSpringDamper, axis="x"),
        {"stiffness": 10.0, "damping": 1.0},
        {"stiffness": 1.0},
    ),
    "RotationalSpringDamper": (
        between(mbd.RotationalSpringDamper, axis="x"),
        {"stiffness": 10.0, "damping": 1.0},
        {"stiffness": 1.0},
    ),
    "DistanceJoint": (between(mbd.DistanceJoint), {"length": 1.0}, {}),
    "Drive": (lambda speed: mbd.Drive(GROUND, body(), axis="z", speed=speed), {"speed": 1.0}, {}),
    "Force": (lambda vector: mbd.Force(body().at(), (vector, 0.0, 0.0)), {"vector": 1.0}, {}),
    "Frame": (lambda x: body().at(x, 0, 0), {"x": 0.1}, {}),
    "Spring": (mbd.forces.Spring, {"stiffness": 1.0, "damping": 1.0}, {"stiffness": 1.0}),
    "Gap": (
        mbd.forces.Gap,
        {"limit": 0.1, "stiffness": 1e3, "damping": 1.0, "smooth": 0.1},
        {"limit": 0.1, "stiffness": 1e3},
    ),
    "Friction": (mbd.forces.Friction, {"force": 1.0, "speed": 0.1}, {"force": 1.0, "speed": 0.1}),
    "Sine": (mbd.Sine, {"amplitude": 1.0, "frequency": 1.0}, {"amplitude": 1.0, "frequency": 1.0}),
    "SmoothStep": (mbd.SmoothStep, {"size": 1.0, "duration": 1.0}, {"size": 1.0, "duration": 1.0}),
    "ConstantSpeed": (mbd.ConstantSpeed, {"speed": 1.0}, {}),
    "Ply": (mbd.Ply, MODULI, MODULI),
    "Ply.isotropic": (
        mbd.Ply.isotropic,
        {"E": 1e11, "nu": 0.3, "density": 1500.0},
        {"E": 1e11, "nu": 0.3, "density": 1e3},
    ),
    "Strength": (mbd.Strength, STRENGTHS, STRENGTHS),
    "Laminate": (mbd.Laminate, {"thickness": 1e-3, "shear_correction": 0.8}, {**WALL, "thickness": 1e-3}),
    "tube": (mbd.sections.tube, {"radius": 0.02, "thickness": 1e-3}, {**WALL, "radius": 0.02, "thickness": 1e-3}),
    "box": (
        mbd.sections.box,
        {"width": 0.05, "height": 0.02, "thickness": 1e-3},
        {**WALL, "width": 0.05, "height": 0.02, "thickness": 1e-3},
    ),
    "strip": (mbd.sections.strip, {"width": 0.05, "thickness": 1e-3}, {**WALL, "width": 0.05, "thickness": 1e-3}),
    "rectangle": (mbd.sections.rectangle, {"width": 0.05, "height": 0.02}, {"width": 0.05, "height": 0.02, "ply": PLY}),
    "circle": (mbd.sections.circle, {"radius": 0.02}, {"ply": PLY}),
    "GivenSection": (mbd.GivenSection.isotropic, AREAS, AREAS),
    "mesh.rectangle": (
        mbd.mesh.rectangle,
        {"length": 0.05, "width": 0.02},
        {"length": 0.05, "width": 0.02, "cells": (2, 2)},
    ),
    "BeamLine": (mbd.BeamLine.straight, {"length": 1.0}, {"elements": 2}),
    "FlexibleBody": (plate, {"damping": 0.1}, {}),
    "damped": (lambda **k: plate().damped(**k), {"ratio": 0.1, "rate": 1.0}, {}),
    "turn of a Frame": (lambda turn: body().at(turn=(turn, 0.0, 0.0)), {"turn": 0.1}, {}),
    "System": (
        lambda gravity: mbd.System([body()], [], gravity=(0.0, gravity, 0.0)),
        {"gravity": -9.81},
        {},
    ),
}
if "fibers" in mbd.__all__:  # the extensions fibers and lamination are there
    CASES |= {
        "LaminationParameters": (
            mbd.lamination.LaminationParameters,
            {"thickness": 1e-3, "shear_correction": 0.8},
            {"ply": PLY, "thickness": 1e-3, "membrane": [0.0] * 4},
        ),
        "FiberField": (mbd.fibers.FiberField, {"radius": 0.3}, {"mesh": MESH, "controls": [[0.0, 0.0, 0.0]]}),
    }
if "fatigue" in mbd.__all__:  # the extension fatigue is there
    CASES["SNCurve"] = mbd.fatigue.SNCurve, {"tension": 5e8}, {"points": [(1e3, 4e8), (1e6, 2e8)]}


def holds(x: Any, wanted: nn.Parameter, seen: set[int]) -> bool:
    """Whether a variable is a parameter of x or of what it is made of."""
    if x is wanted:
        return True
    if id(x) in seen:
        return False
    seen.add(id(x))
    if isinstance(x, nn.Module) and any(p is wanted for p in x.parameters()):
        return True
    parts = list(x) if isinstance(x, (list, tuple)) else list(getattr(x, "__dict__", {}).values())
    parts += x.values() if isinstance(x, dict) else []
    parts += [cell.cell_contents for cell in getattr(x, "__closure__", None) or ()]
    return any(holds(part, wanted, seen) for part in parts)


@pytest.mark.parametrize("name", CASES)
def test_a_variable_is_taken_or_refused_by_name(name):
    make, numbers, others = CASES[name]
    for argument, number in numbers.items():
        x, said, result = mbd.variable(number), None, None
        try:
            result = make(**{**others, argument: x})
        except mbd.InputError as error:
            said = str(error)
        assert argument in said if said is not None else holds(result, x, set()), (
            f"{name}, {argument}: {said or 'lost'}"
        )


WRONG = {"word": "x", "list": [1.0, 2.0], "object": object(), "mapping": {}, "nan": math.nan, "infinity": math.inf}
#: names of arguments in errors, where an argument is part of a vector
VECTORS = {"Frame": {"x": "point"}}


@pytest.mark.parametrize("kind", WRONG)
@pytest.mark.parametrize("name", CASES)
def test_a_wrong_number_is_refused_with_the_path_of_its_argument(name, kind):
    make, numbers, others = CASES[name]
    for argument in numbers:
        if (name, kind) == ("Strength", "infinity"):  # a strength may be infinite
            continue
        with pytest.raises(mbd.InputError) as error:
            make(**{**others, argument: WRONG[kind]})
        words = re.split(r"\W+", error.value.argument)
        assert VECTORS.get(name, {}).get(argument, argument) in words, f"{name}, {argument}: {error.value}"
        assert error.value.allowed or error.value.hint, f"{name}, {argument}: {error.value}"
