"""Mistakes of callers in Python: each is an InputError that names the argument, its value and what is allowed.

A row: the call, the argument and its value as the message writes them, and what is allowed or meant. No motion is computed.
"""

from __future__ import annotations

from operator import attrgetter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.refused import refused, warned
from tests.study.rod_model import build
from torchmbd.api import all_names
from torchmbd.errors import InputError, argument_names, keyword_hints, meant_argument, true_or_false

NUMBERS: dict[str, Any] = {
    **{"E1": 128e9, "E2": 10.1e9, "G12": 5.36e9, "G13": 5.36e9, "G23": 5.36e9},
    **{"nu12": 0.23, "density": 1586.0},
}
PLY = mbd.Ply(**NUMBERS)
LAMINATE = mbd.Laminate(PLY, mbd.deg([45.0, -45.0]), 1e-3)
MESH = mbd.mesh.rectangle(0.3, 0.06, (4, 2))
ANGLES, ENERGY = "rod.laminate.angles", mbd.StrainEnergy("rod")
BOX: Any = SimpleNamespace(
    names=["x"], start=np.zeros(1), lower=-np.ones(1), upper=np.ones(1), evaluate=lambda X, gradients: []
)
GROUND, CRANK, SYSTEM = mbd.Ground(), mbd.RigidBody("crank", 1.0, (1.0, 1.0, 1.0)), build()


def simulate(**given: Any) -> Any:
    return mbd.simulate(SYSTEM, **({"duration": 0.01, "steps": 60} | given))


def plate(**given: Any) -> Any:
    return mbd.FlexibleBody.plate("rod", MESH, LAMINATE, **given)


def problem(**given: Any) -> Any:
    return mbd.Problem(**({"system": SYSTEM, "duration": 0.01, "minimize": mbd.Integral(ENERGY), "steps": 60} | given))


def joint(kind: Any, *given: Any, **more: Any) -> Any:
    return kind(GROUND.at(), CRANK.at(), *given, **more)


any_: Any = mbd  # calls that a type checker would refuse as well
MISTAKES = {
    # simulate
    "method": (lambda: simulate(method="generalised"), "method = 'generalised'", "Try: 'generalized_alpha'"),
    "steps 0": (lambda: simulate(steps=0), "steps = 0", "a positive integer"),
    "steps 2.5": (lambda: simulate(steps=2.5), "steps = 2.5", "a positive integer"),
    "duration": (lambda: simulate(duration=-0.01), "duration = -0.01 s", "a positive number"),
    "duration in words": (lambda: simulate(duration="1 s"), "duration = '1 s'", "a positive number"),
    "step": (lambda: simulate(step=3), "step = 3", "Try: 'steps'"),
    "option misspelt": (lambda: simulate(spectral_radus=0.3), "spectral_radus = 0.3", "Try: 'spectral_radius'"),
    "option out of range": (lambda: simulate(spectral_radius=1.5), "spectral_radius = 1.5", "0 "),
    "gradients": (lambda: simulate(gradients="backward"), "gradients = 'backward'", "auto, forward, reverse, none"),
    "backend": (lambda: simulate(backend="cuda"), "backend = 'cuda'", "auto, eager, native"),
    "design misspelt": (
        lambda: simulate(designs={"rod.laminate.angle": torch.zeros(1, 2)}),
        "'rod.laminate.angle'",
        "Try: 'rod.laminate.angles'",
    ),
    "design shape": (lambda: simulate(designs={ANGLES: torch.zeros(1, 3).double()}), "(1, 3)", "[lanes, 2]"),
    "design in degrees": (
        lambda: simulate(designs={ANGLES: torch.tensor([[45.0, -45.0]]).double()}),
        "angles[0] = 45.0 rad",
        "-2 pi to 2 pi",
    ),
    "designs": (lambda: simulate(designs=[1.0]), "designs = [1.0]", "parameter name -> tensor"),
    "variables": (lambda: simulate(variables=["rod.angles"]), "'rod.angles'", "Try: 'rod.laminate.angles'"),
    "phases": (lambda: simulate(phases=[1]), "phases = (1,)", "mbd.Phase"),
    "system": (lambda: any_.simulate("arm", 0.01), "system = 'arm'", "a System"),
    # materials
    "modulus": (lambda: mbd.Ply(**NUMBERS | {"E1": -1.0}), "E1 = -1.0", "a finite number > 0"),
    "Poisson": (lambda: mbd.Ply(**NUMBERS | {"nu12": 9.0}), "nu12 = 9.0", "below sqrt(E1 / E2)"),
    "metal": (lambda: mbd.Ply.isotropic(70e9, 0.7, 2700.0), "nu = 0.7", "above -1 and at most 0.5"),
    "strength": (lambda: mbd.Strength(Xt=0.0, Xc=1.0, Yt=1.0, Yc=1.0, S12=1.0), "Xt = 0.0 Pa", "a number > 0"),
    "angles in degrees": (lambda: mbd.Laminate(PLY, [45.0], 1e-3), "angles[0] = 45.0 rad", "-2 pi to 2 pi"),
    "thickness": (lambda: mbd.Laminate(PLY, [0.0], -1e-3), "thickness[0] = -0.001 m", "a finite number > 0"),
    "thicknesses": (lambda: mbd.Laminate(PLY, [0.0], [1e-3, 1e-3]), "2 thicknesses", "one per angle"),
    "ply by name": (lambda: any_.Laminate("carbon", [0.0], 1e-3), "ply = 'carbon'", "a Ply"),
    "shear": (lambda: mbd.Laminate(PLY, [0.0], 1e-3, shear_correction="engergy"), "'engergy'", "'energy'"),
    # meshes and sections
    "cells": (lambda: mbd.mesh.rectangle(0.3, 0.06, (0, 2)), "cells = (0, 2)", "two integers >= 1"),
    "kind of cells": (lambda: mbd.mesh.rectangle(0.3, 0.06, (1, 2), kind="quads"), "'quads'", "Try: 'quad'"),
    "length": (lambda: mbd.mesh.rectangle(-0.3, 0.06, (1, 2)), "length = -0.3 m", "a positive and finite number"),
    "corner": (lambda: any_.Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 5]]), "[0, 1, 5]", "0 to 2"),
    "radius": (lambda: mbd.sections.tube(-0.02, PLY, [0.0], 1e-3), "radius = -0.02 m", "a positive and finite number"),
    "wall": (lambda: mbd.sections.tube(0.02, PLY, [0.0], 0.03), "thickness is 0.03 m", "less than the radius"),
    "section": (lambda: mbd.GivenSection([[1.0]], [[1.0]]), "(1, 1)", "a 6 x 6 matrix"),
    "line": (lambda: mbd.BeamLine.straight(-1.0), "length = -1.0 m", "a finite number > 0"),
    "arc in degrees": (lambda: mbd.BeamLine.arc(1.0, 90.0), "angle = 90.0 rad", "0 to 2 pi"),
    # bodies
    "reduction": (lambda: plate(reduction="guyan"), "'guyan'", "vibration, craig-bampton"),
    "modes": (lambda: plate(modes=0), "rod.modes = 0", "a whole number"),
    "reference": (lambda: plate(reference="rigth"), "node = 'rigth'", "Try: 'right'"),
    "interface": (lambda: plate(reduction="craig-bampton", interface=["rihgt"]), "'rihgt'", "Try: 'right'"),
    "lumped": (lambda: plate(mass="lump"), "mass = 'lump'", "Try: 'lumped'"),
    "damping": (lambda: plate(damping=-1.0), "rod.damping = -1.0 s", "zero or positive"),
    "axes": (lambda: plate(axes=[[1, 0, 0], [0, 2, 0], [0, 0, 1]]), "rod.axes", "orthonormal columns"),
    "position": (lambda: plate(position=(1, 2)), "rod.position = (1, 2)", "three finite numbers"),
    "beam": (lambda: any_.FlexibleBody.beam("b", mbd.BeamLine.straight(1.0), "tube"), "section = 'tube'", "a Section"),
    "name": (lambda: mbd.RigidBody("a b", 1.0, (1, 1, 1)), "'a b'", "a Python identifier"),
    "mass": (lambda: mbd.RigidBody("a", -1.0, (1, 1, 1)), "a.mass = -1.0 kg", "a positive and finite number"),
    "inertia": (lambda: mbd.RigidBody("a", 1.0, (1, 1, 9)), "[1.0, 1.0, 9.0] kg m2", "the sum of the other two"),
    "node": (lambda: SYSTEM.body("rod").at("rigth"), "node = 'rigth'", "Try: 'right'"),
    "body": (lambda: SYSTEM.body("rodd"), "body = 'rodd'", "Try: 'rod'"),
    # joints, forces, systems
    "axis": (lambda: joint(mbd.Revolute, axis="w"), "axis = 'w'", "'x', 'y', 'z'"),
    "frame": (lambda: any_.Revolute("ground", CRANK.at()), "'ground'", "frames, such as body.at(...)"),
    "no law": (lambda: joint(mbd.Drive), "no law", "exactly one of speed, angle, velocity, position"),
    "two laws": (lambda: joint(mbd.Drive, speed=2.0, velocity=1.0), "{'speed': 2.0, 'velocity': 1.0}", "exactly one"),
    "cross": (lambda: joint(mbd.Universal, axes="yy"), "'yy'", "two different letters"),
    "rise": (lambda: mbd.SmoothStep(1.0, 0.0), "duration = 0.0 s", "a positive number"),
    "vector": (lambda: mbd.Force(CRANK.at(), (0, 0)), "= (0, 0)", "three finite numbers"),
    "vector of one": (lambda: any_.Torque(CRANK.at(), 2.0), "= 2.0", "three finite numbers"),
    "same body": (lambda: mbd.System([CRANK, CRANK], []), "'crank' is used 2 times", "must be unique"),
    "joints": (lambda: any_.System([CRANK], ["hinge"]), "'hinge'", "joints, such as"),
    "gravity": (lambda: any_.System([CRANK], [], gravity=9.81), "gravity = 9.81", "three finite numbers"),
    # responses and problems
    "energy of": (lambda: problem(minimize=mbd.Max(mbd.StrainEnergy("rodd"))), "'rodd'", "Try: 'rod'"),
    "component": (lambda: problem(minimize=mbd.Max(mbd.Position("rod", "w"))), "axis = 'w'", "'x', 'y', 'z'"),
    "number": (lambda: problem(minimize=mbd.Frequency("rod", 9)), "number = 9", "1 to 4"),
    "criterion": (
        lambda: problem(minimize=mbd.Max(mbd.PlyFailure("rod", criterion="tsai-wu"))),
        "'tsai-wu'",
        "Try: 'tsai_wu'",
    ),
    "window": (lambda: mbd.Max(ENERGY, window=(0.2, 0.1)), "window = (0.2, 0.1)", "0 <= t0 < t1"),
    "late": (lambda: problem(minimize=mbd.Max(ENERGY, window=(0.0, 0.1))), "t = 0.1 s", "at most at duration=0.01 s"),
    "history": (lambda: any_.Max("strain_energy"), "'strain_energy'", "a history"),
    "function": (lambda: any_.history(3), "function = 3", "a function of a motion"),
    "history of a history": (
        lambda: any_.history(any_.StrainEnergy("arm")),
        "function = StrainEnergy",
        "a function of a",
    ),
    "unit": (lambda: any_.history(abs, unit=5), "unit = 5", "the name of an SI unit"),
    "limit": (lambda: mbd.Max(ENERGY) <= "start", "limit = 'start'", "'initial'"),
    "weights": (lambda: any_.WeightedSum([(1.0,)]), "terms = [(1.0,)]", "pairs (weight, measure)"),
    "minimize a history": (lambda: problem(minimize=ENERGY), "minimize = StrainEnergy", "a measure"),
    "minimise": (
        lambda: any_.Problem(SYSTEM, 0.01, minimise=mbd.Mass("rod")),
        "minimise = ",
        "Try: 'minimize'",
    ),
    "maximize": (lambda: problem(maximize=mbd.Mass("rod")), "maximize = Mass(", "must not be given together"),
    "maximize rows": (
        lambda: problem(minimize=None, maximize=mbd.AtTimes(ENERGY, (0.001, 0.002))),
        "maximize = AtTimes(",
        "a measure of one number",
    ),
    "step of a problem": (lambda: problem(step=60), "step = 60", "Try: 'steps'"),
    "bounds": (
        lambda: problem(bounds=(1.0, -1.0)),
        "lower bound of rod.laminate.angles[0] = 1 rad (57.2958 deg)",
        "must be below upper = -1 rad",
    ),
    "bounds in degrees": (lambda: problem(bounds=(-90.0, 90.0)), "angles[0] = -90.0 rad", "-2 pi to 2 pi"),
    "bounds by name": (lambda: problem(bounds={"rod.angles": (-1, 1)}), "'rod.angles'", "Try:"),
    "three bounds": (lambda: problem(bounds=(0, 1, 2)), "bounds = (0, 1, 2)", "(lower, upper)"),
    "start": (
        lambda: problem(bounds=(-0.1, 0.1)),
        "start of rod.laminate.angles[0] = 0.785398 rad (45 deg)",
        "must lie between -0.1 rad",
    ),
    "short start": (lambda: problem(start=[0.1]), "start has 1 values", "must have 2"),
    "links": (lambda: problem(links={"x": {"y": 1.0}}), "links: x is not an entry", "rod.laminate.angles[0]"),
    "subject_to": (lambda: problem(subject_to=[1.0]), "subject_to has 1.0", "constraints"),
    # optimization
    "capitals": (lambda: mbd.optimize(BOX, "SLSQP"), "method = 'SLSQP'", "Try: 'slsqp'"),
    "strict limit": (lambda: any_.Max(ENERGY) < 0.1, "< 0.1", "<=, >="),
    "strict lower limit": (lambda: any_.Max(ENERGY) > 0.1, "> 0.1", "<=, >="),
    "optimizer": (lambda: mbd.optimize(BOX, "mmdf"), "method = 'mmdf'", "Try: 'mmfd'"),
    "start of a search": (lambda: mbd.optimization.multistart(BOX, start=2), "start = 2", "Try: 'starts'"),
    "its option": (lambda: mbd.optimize(BOX, "mmfd", kktt=1e-3), "kktt = ", "Try: 'kkt'"),
    "max_iteration": (lambda: mbd.optimize(BOX, max_iteration=3), "max_iteration = 3", "Try: 'max_iterations'"),
    "max_iterations": (lambda: mbd.optimize(BOX, max_iterations=-1), "max_iterations = -1", "[0, 1e+06]"),
    "outside": (lambda: any_.optimize(BOX, start=[5.0]), "start of x = 5", "must lie between -1 and 1"),
    "problem": (lambda: any_.optimize(3), "problem = 3", "mbd.Problem(...)"),
    "sampler": (
        lambda: any_.optimization.multistart(BOX, "mmfd", "sobel"),
        "starts = 'sobel'",
        "mbd.optimization.sobol(...)",
    ),
    "device": (lambda: simulate(device="cuda"), "device = 'cuda'", "torchmbd computes on the CPU alone"),
    "device of a problem": (lambda: problem(device="cuda"), "device = 'cuda'", "torchmbd computes on the CPU alone"),
    "device of a search": (lambda: mbd.optimize(BOX, device="cuda"), "device = ", "torchmbd computes on the CPU alone"),
    "tolerance": (lambda: mbd.optimization.RobustProblem(BOX, -0.1), "tolerance = -0.1", "not negative"),
    "robust": (lambda: mbd.optimization.RobustProblem(BOX, 0.1, "expect"), "kind = 'expect'", "Try: 'expected'"),
    # switches
    "symmetric": (lambda: any_.Laminate(PLY, [0.0], 1e-3, symmetric="no"), "symmetric = 'no'", "True or False"),
    "rigid": (lambda: any_.Interface([0], rigid=1), "rigid = 1", "True or False"),
    "scaling": (lambda: any_.optimize(BOX, scaling=None), "scaling = None", "True or False"),
    "eager": (
        lambda: any_.optimization.multistart(BOX, eager_gradients="no"),
        "eager_gradients = 'no'",
        "True or False",
    ),
    "second order": (lambda: any_.optimize(BOX, "mmfd", second_order="no"), "second_order = 'no'", "True or False"),
    "initial": (
        lambda: any_.optimization.sobol(2, 1, include_initial="no"),
        "include_initial = 'no'",
        "True or False",
    ),
    "progress": (lambda: simulate(progress="no"), "progress = 'no'", "True or False"),
    "follow": (lambda: any_.equilibrium(SYSTEM, follow="no"), "follow = 'no'", "True or False"),
    "unstable": (lambda: any_.equilibrium(SYSTEM, unstable=2), "unstable = 2", "True or False"),
    "stiffening": (lambda: plate(stiffening="no"), "rod.stiffening = 'no'", "True or False"),
    # files and pictures
    "file": (lambda: any_.problem_of(3), "file = 3", "the path of a file"),
    "store": (lambda: mbd.load("run", uri="foo"), "uri = 'foo'", "sqlite:"),
    "picture": (lambda: any_.viz.save(None, "a.gif"), "path = 'a.gif'", ".png, .pdf, .svg"),
    "no motion": (lambda: mbd.viz.animate("x", "y.html"), "motion = 'x'", "a motion"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_argument_value_and_what_is_allowed_are_named(name):
    call, given, allowed = MISTAKES[name]
    with pytest.raises(InputError) as error:
        call()
    text = str(error.value)
    assert given in text
    assert allowed in text
    assert "Try: " in text or "must" in text


# Classes that users are given, or derive from.
RESULTS = [
    "BeamState",
    "Chain",
    "Constraint",
    "CoveringTriangles",
    "Damage",
    "Dynamics",
    "Equilibrium",
    "ForceElement",
    "Frame",
    "History",
    "LinearSystem",
    "Measure",
    "NodeCloud",
    "OptimizationResult",
    "PlyHistory",
    "Section",
    "SectionHistory",
    "SectionStress",
    "Study",
    "Trajectory",
]


def public_calls() -> dict[str, Any]:
    """All functions and classes with public names, but those of RESULTS, named tuples and errors."""
    modules = {"sections.": mbd.sections, "mesh.": mbd.mesh, "forces.": mbd.forces, "viz.": mbd.viz}
    names = {f"{prefix}{name}": getattr(module, name) for prefix, module in modules.items() for name in module.__all__}
    names |= {name: attrgetter(name)(mbd) for name in all_names()}
    calls = {name: x for name, x in names.items() if callable(x) and x.__name__ not in RESULTS}
    return {name: x for name, x in calls.items() if not (isinstance(x, type) and issubclass(x, (Exception, tuple)))}


@pytest.mark.parametrize("name", public_calls())
def test_an_argument_that_does_not_exist_is_refused_by_every_public_call(name):
    with pytest.raises((TypeError, InputError)):
        public_calls()[name](no_such_argument=1)


# Misspelt keywords: the call, the keyword, the one that was meant.
MISSPELT = {
    "Ply": (lambda: any_.Ply(**NUMBERS, strenght=1), "strenght", "strength"),
    "Laminate": (lambda: any_.Laminate(PLY, angle=[0.0], thickness=1e-3), "angle", "angles"),
    "tube": (lambda: any_.sections.tube(0.02, PLY, [0.0], thicknes=1e-3), "thicknes", "thickness"),
    "RigidBody": (lambda: any_.RigidBody("a", 1.0, intertia=(1, 1, 1)), "intertia", "inertia"),
    "FlexibleBody.plate": (lambda: plate(mode=4), "mode", "modes"),
    "Drive": (lambda: joint(mbd.Drive, sped=2.0), "sped", "speed"),
    "SpringDamper": (lambda: joint(mbd.SpringDamper, stifness=1.0), "stifness", "stiffness"),
    "System": (lambda: any_.System([CRANK], [], gravty=(0, 0, 1)), "gravty", "gravity"),
    "simulate": (lambda: any_.simulate(SYSTEM, duraton=0.1), "duraton", "duration"),
    "Problem": (lambda: any_.Problem(SYSTEM, duraton=0.1, minimize=mbd.Mass("rod")), "duraton", "duration"),
}


def errors_in(word: str) -> list[str]:
    """The word with a letter too much, and without its last one; with two letters exchanged, and in capitals."""
    return [f"{word}s", word[:-1], word[:2] + word[3] + word[2] + word[4:], word.capitalize()]


# Arguments of one call that differ by a letter or number: either may be meant.
ALIKE = {"axes", "axis", "alpha1", "alpha2", "beta1", "beta2", "shear_y", "shear_z", "nu12", "nu13", "nu23", "damping"}


@pytest.mark.parametrize("name", public_calls())
def test_hints_are_arguments_of_the_call(name):
    """Every argument is found again from its misspelt names; what is far from all has no hint."""
    call = public_calls()[name]
    arguments = argument_names(call)
    for argument in {x for x in arguments if len(x) > 4} - ALIKE:
        for misspelt in set(errors_in(argument)) - set(arguments):
            assert meant_argument(misspelt, call) == argument, misspelt
    for keyword in {"rotation", "origin", "weight", "thickness", "orient", "turns"} - set(arguments):
        hint = meant_argument(keyword, call)
        assert hint is None or hint in arguments


def test_a_hint_has_the_meaning_of_the_keyword():
    """`rotation` of a beam had the hint `orientation`, the direction of the section; of a rigid body `position`."""
    for call in (mbd.RigidBody, mbd.FlexibleBody.plate, mbd.FlexibleBody.beam, mbd.FlexibleBeam, mbd.Frame):
        assert meant_argument("rotation", call) == "axes"
    assert meant_argument("rotation", mbd.ExactBeam) is None
    assert meant_argument("rotation", mbd.Drive) is None
    assert meant_argument("weight", mbd.RigidBody) == "mass"
    assert meant_argument("length_", mbd.Ply) is None  # it was `strength`
    with refused("rotation", 1) as caught:
        any_.simulate(SYSTEM, 0.1, rotation=1)  # an option of the method, if it were one
    assert "duration'" not in caught.value.hint


@pytest.mark.parametrize("name", MISSPELT)
def test_a_misspelt_keyword_of_a_much_used_call_has_a_hint(name):
    call, keyword, meant = MISSPELT[name]
    with pytest.raises(TypeError) as error:
        call()
    (note,) = error.value.__notes__
    assert note.startswith(f"Try: {meant} = ... in place of {keyword} = ")


def test_switches_that_are_none_are_named():
    assert (true_or_false("x", True), true_or_false("x", np.bool_(False))) == (True, False)
    for given in (None, "no", 0, 1.0, [], torch.tensor(True)):
        with refused("x"):
            true_or_false("x", given)


def test_there_are_many():
    assert len(MISTAKES) >= 60


def test_a_type_error_inside_a_call_stays_what_it_is():
    @keyword_hints
    def broken(*, option: int) -> None:
        raise TypeError("inside")

    with pytest.raises(TypeError) as error:
        broken(option=1)
    assert error.value.args == ("inside",)
    assert not hasattr(error.value, "__notes__")


@pytest.mark.parametrize(
    "kind",
    [
        mbd.SpringDamper,
        mbd.AxialSpringDamper,
        mbd.RotationalSpringDamper,
        mbd.AxialStop,
        mbd.RotationalStop,
        mbd.Bushing,
    ],
)
def test_a_misspelt_keyword_of_a_force_names_the_class_and_the_nearest_argument(kind):
    with pytest.raises(TypeError) as error:
        kind(GROUND.at(), CRANK.at(), stifness=3.0)
    assert str(error.value).startswith(kind.__name__)
    assert "stiffness" in error.value.__notes__[0]


def test_a_misspelt_keyword_of_a_joint_names_the_class_and_the_nearest_argument():
    with pytest.raises(TypeError) as error:
        joint(mbd.Revolute, axes="z")
    assert str(error.value).startswith("Revolute")
    assert "axis" in error.value.__notes__[0]


def test_warnings_name_the_line_of_the_caller():
    with warned("units of nodes") as caught:
        mbd.mesh.rectangle(300.0, 60.0, (1, 1))
    assert {Path(warning.filename) for warning in caught} == {Path(__file__)}
