"""Arguments of another kind are refused: the error names the argument, its value and what is allowed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.mechanisms import box, laminate, pendulum
from torchmbd.errors import InputError

SYSTEM = pendulum()
ROD, BOX, GROUND = SYSTEM.body("rod"), box("b"), mbd.Ground()
SQUARE = mbd.mesh.rectangle(length=0.3, width=0.1, cells=(2, 2))
NAMES = np.array(["a", "b"])
ORIGIN = (0.0, 0.0, 0.0)


def simulated(**options: Any) -> mbd.Trajectory:
    return mbd.simulate(SYSTEM, 0.01, **({"steps": 4} | options))


def problem(**options: Any) -> mbd.Problem:
    return mbd.Problem(SYSTEM, 0.01, mbd.Integral(mbd.StrainEnergy("rod")), steps=4, **options)


# What is wrong -> how the message begins.
CASES: dict[str, tuple[Callable[[], Any], str]] = {
    "body of a frame": (lambda: mbd.Frame("b", ORIGIN), "body of a Frame = 'b'"),
    "no body of a frame": (lambda: mbd.Frame(None, ORIGIN), "body of a Frame = None"),
    "point of a frame": (lambda: mbd.Frame(BOX, "x"), "b.point = 'x'"),
    "point of two numbers": (lambda: mbd.Frame(BOX, torch.zeros(2)), "b.point = tensor"),
    "axes of a frame": (lambda: mbd.Frame(BOX, ORIGIN, axes="x"), "b.axes = 'x'"),
    "mount of a rigid frame": (lambda: mbd.Frame(BOX, ORIGIN, interpolation=3), "interpolation of a Frame on 'b' = 3"),
    "no mount": (lambda: mbd.Frame(ROD, ORIGIN), "interpolation of a Frame on 'rod' = None"),
    "until": (lambda: mbd.Phase(until="x"), "until of a phase = 'x'"),
    "a variable until": (lambda: mbd.Phase(until=mbd.variable(0.1)), "until of a phase = Parameter"),
    "lock": (lambda: mbd.Phase(lock=None), "lock of a phase = None"),
    "release": (lambda: mbd.Phase(release=3), "release of a phase = 3"),
    "release of an array": (lambda: mbd.Phase(release=NAMES), "release of a phase = array"),
    "laws": (lambda: mbd.Phase(laws=[1]), r"laws of a phase = \[1\]"),
    "impact": (lambda: mbd.Phase(until=mbd.Event(mbd.Position("b", "z")), impact="x"), "impact of a phase = 'x'"),
    "impacts": (lambda: mbd.Phase(until=mbd.Event(mbd.Position("b", "z")), impact=[1]), r"impact of a phase = \[1\]"),
    "name of a phase": (lambda: mbd.Phase(name=NAMES), "name of a phase = array"),
    "phases": (lambda: simulated(phases=3), "phases = 3"),
    "weights": (lambda: ROD.at([0, 1], weights=3), "weights = 3"),
    "weights of letters": (lambda: ROD.at([0, 1], weights="ab"), "weights = 'ab'"),
    "a weight": (lambda: ROD.at([0, 1], weights=[None, 1]), "weights = None"),
    "node": (lambda: ROD.at(1.5), "node = 1.5"),
    "bound": (lambda: problem(bound=[None]), r"bound = \[None\]"),
    "bound of one number": (lambda: problem(bound=3), "bound = 3"),
    "constraints": (lambda: problem(subject_to=[None]), "subject_to"),
    "node sets": (lambda: mbd.Mesh(SQUARE.nodes, SQUARE.triangles, node_sets=[1]), r"node_sets of a Mesh = \[1\]"),
    "a node set": (
        lambda: mbd.Mesh(SQUARE.nodes, SQUARE.triangles, node_sets={"a": 3}),
        "node_sets of a Mesh: 'a' = 3",
    ),
    "a set of None": (
        lambda: mbd.Mesh(SQUARE.nodes, SQUARE.triangles, node_sets={"a": None}),
        "node_sets of a Mesh: 'a'",
    ),
    "nodes": (lambda: mbd.Mesh("x", SQUARE.triangles), "nodes = 'x'"),
    "uri": (lambda: mbd.load("run", 3), "uri = 3"),
    "allowed": (lambda: mbd.optimization.optimize_discrete(problem(bounds=(-1.0, 1.0)), "x"), "allowed of .* = 'x'"),
    "allowed by name": (
        lambda: mbd.optimization.optimize_discrete(problem(bounds=(-1.0, 1.0)), {"a": 1}),
        "allowed = {'a': 1}",
    ),
    "an allowed value": (
        lambda: mbd.optimization.optimize_discrete(problem(bounds=(-1.0, 1.0)), [["a"], 0.1]),
        "allowed of",
    ),
    "parts": (lambda: mbd.FlexibleBody("r", SQUARE, None, 2), "r.parts = None"),
    "a part": (lambda: mbd.FlexibleBody("r", SQUARE, {"a": 3}, 2), "r.parts = {'a': 3}"),
    "no parts": (lambda: mbd.FlexibleBody("r", SQUARE, {}, 2), "r.parts = {}"),
    "mesh": (lambda: mbd.FlexibleBody.plate("r", None, laminate(), modes=2), "mesh"),
    "modes": (lambda: mbd.FlexibleBody.plate("r", SQUARE, laminate(), modes="x"), "r.modes = 'x'"),
    "name of a body": (lambda: mbd.RigidBody(NAMES, 1.0, (1.0, 1.0, 1.0)), "name of the rigid body = array"),
    "body of a system": (lambda: SYSTEM.body(NAMES), "body = array"),
    "body of a motion": (lambda: simulated().body(["rod"]), r"body = \['rod'\]"),
    "joint of a reaction": (lambda: simulated().reaction(NAMES), "joint = array"),
    "modes of a body": (lambda: simulated().modes(NAMES), "flexible body = array"),
    "modes of a rigid body": (lambda: simulated().modes("arm"), "flexible body = 'arm'"),
    "body of a response": (lambda: mbd.StrainEnergy(NAMES).values(simulated()), "body = array"),
    "variables": (lambda: simulated(variables=[NAMES]), "parameter = array"),
    "method": (lambda: simulated(method=NAMES), "method = array"),
    "gradients": (lambda: simulated(gradients=NAMES), "gradients = array"),
    "backend": (lambda: simulated(backend=NAMES), "backend = array"),
    "name of a joint": (lambda: mbd.Revolute(GROUND.at(), BOX.at(), name=NAMES), "name of a Revolute = array"),
    "axis": (lambda: mbd.Revolute(GROUND.at(), BOX.at(), axis=NAMES), "axis = array"),
    "free bodies": (lambda: mbd.System([BOX], free=[NAMES]), "free has array"),
}


@pytest.mark.parametrize("case", CASES)
def test_it_is_refused_by_name(case):
    make, message = CASES[case]
    with pytest.raises(InputError, match=message) as error:
        make()
    assert error.value.allowed or error.value.hint


def test_what_is_right_is_taken_in_any_shape():
    frame = mbd.Frame(BOX, [0.1, 0, 0], [[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert frame.point.tolist() == [0.1, 0.0, 0.0]
    assert ROD.at(np.array([0, 1]), weights=np.array([1.0, 3.0])).interpolation.weights == (0.25, 0.75)
    assert mbd.Mesh(SQUARE.nodes, SQUARE.triangles, {"a": np.array([0, 1])}, quads=SQUARE.quads).node_sets["a"] == (
        0,
        1,
    )
