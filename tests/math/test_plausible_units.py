"""Degrees are refused and units doubted wherever numbers enter; what some structure has passes without a word."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
import torch

import torchmbd as mbd
from tests.mechanisms import CARBON, pendulum
from torchmbd.fem.materials import Strength
from torchmbd.fem.sections import Orthotropic

ANGLES, THICKNESS = "rod.laminate.angles", "rod.laminate.thickness"
ALUMINUM = {"E": 70e9, "nu": 0.33, "density": 2700.0}


def degrees(*x: float) -> torch.Tensor:
    return torch.tensor([x], dtype=torch.float64)


def problem(**given):
    return mbd.Problem(pendulum(), 0.001, mbd.Max(mbd.StrainEnergy("rod")), steps=2, **given)


def own_angles(x: float) -> mbd.System:
    system = pendulum()
    with torch.no_grad():
        system.get_parameter(ANGLES).fill_(x)
    return system


REFUSED = {
    "designs": lambda: mbd.simulate(pendulum(), 0.001, steps=2, designs={ANGLES: degrees(45.0, -45.0)}),
    "second entry": lambda: mbd.simulate(pendulum(), 0.001, steps=2, designs={ANGLES: degrees(0.3, -45.0)}),
    "parameter itself": lambda: mbd.simulate(own_angles(45.0), 0.001, steps=2),
    "bounds": lambda: problem(bounds=(-90.0, 90.0)),
    "one bound": lambda: problem(bounds=([-1.5, -1.5], [1.5, 90.0])),
    "bounds by name": lambda: problem(bounds={ANGLES: (-1.5, 90.0)}),
    "bound beside none": lambda: problem(bounds=(-1.5, [math.inf, 90.0])),
    "start": lambda: problem(start=[45.0, -45.0]),
    "a design of the problem": lambda: problem().simulate(np.array([[45.0, -45.0]])),
    "laminate": lambda: mbd.Laminate(mbd.Ply(**CARBON), angles=[45.0], thickness=1e-3),
    "section": lambda: mbd.sections.tube(0.02, mbd.Ply(**CARBON), [45.0], 1e-3),
}


@pytest.mark.parametrize("name", REFUSED)
def test_degrees_are_refused(name):
    with pytest.raises(mbd.InputError) as error:
        REFUSED[name]()
    *path, entry = error.value.path
    assert path[-1].endswith("angles")
    assert abs(error.value.value) in (45.0, 90.0)
    assert entry in (0, 1)
    assert error.value.hint.startswith("mbd.deg(")


@pytest.mark.thorough
def test_an_optimizer_in_degrees_gets_a_warning_and_goes_on():
    """A status, not an exception: a line search without bounds may go anywhere."""
    result = problem().evaluate(np.array([[45.0, -45.0], [0.3, -0.2]]), False)
    assert "mbd.deg" in result[0].status
    assert result[1].ok


@pytest.mark.thorough
def test_whole_turns_and_bounds_that_are_none_pass():
    turn = mbd.deg([360.0, -360.0])
    assert mbd.simulate(pendulum(), 0.001, steps=2, designs={ANGLES: turn[None]}).ok
    assert problem(bounds=(-math.inf, turn.abs().numpy())).upper.tolist() == turn.abs().tolist()


def tube(**given):
    return mbd.sections.tube(**({"radius": 0.02, "ply": mbd.Ply(**CARBON), "angles": [0.3], "thickness": 1e-3} | given))


def sheet(length: float, width: float, thickness: float, cells: tuple[int, int] = (4, 2)) -> mbd.FlexibleBody:
    mesh = mbd.mesh.rectangle(length, width, cells)
    laminate = mbd.Laminate(mbd.Ply(**CARBON), mbd.deg([0, 90]), thickness / 2)
    return mbd.FlexibleBody.plate("sheet", mesh, laminate, 2)


def scaled(factor: float, *names: str) -> mbd.Ply:
    return mbd.Ply(**{name: x * (factor if name in names else 1.0) for name, x in CARBON.items()})


def turned_by(law, key: str = "angle") -> mbd.Drive:
    return mbd.Drive(mbd.Ground(), mbd.RigidBody("crank", 1.0, (0.01, 0.01, 0.01)), name="motor", **{key: law})


def test_degrees_of_a_constant_in_a_link_are_refused():
    second = f"{ANGLES}[1]"
    with pytest.raises(mbd.InputError) as error:
        problem(links={second: {f"{ANGLES}[0]": 1.0, "constant": 90.0}})
    assert error.value.path[:2] == ("links", second)
    assert error.value.value == 90.0


MODULI = ("E1", "E2", "G12", "G13", "G23")


def falling(g: float) -> mbd.System:
    return mbd.System([mbd.RigidBody("bob", 1.0, (0.01, 0.01, 0.01))], free=["bob"], gravity=(0.0, 0.6 * g, -0.8 * g))


def spring(**given) -> mbd.RotationalSpringDamper:
    arm = mbd.RigidBody("arm", 1.0, (0.01, 0.01, 0.01))
    return mbd.RotationalSpringDamper(mbd.Ground().at(), arm.at(), "z", name="spring", **given)


DOUBTED = {
    "drive in degrees": (
        lambda: turned_by(mbd.SmoothStep(90, 1.0)),
        "motor.size = 90 rad: is this angle in degrees",
    ),
    "variable drive in degrees": (
        lambda: turned_by(mbd.Sine(mbd.variable(-45.0), 1.0)),
        "motor.amplitude = -45 rad: is this angle in degrees",
    ),
    "GPa": (lambda: scaled(1e-9, *MODULI), "units of Ply: E1 = 128 Pa, usually "),
    "MPa": (lambda: scaled(1e-6, *MODULI), "Ply: E1 = 128000 Pa"),
    "G in GPa": (lambda: scaled(1e-9, "G12", "G13", "G23"), r"Ply: G12 = 5.36 Pa"),
    "too stiff": (lambda: scaled(1e3, *MODULI), r"Ply: E1 = 1.28e\+14 Pa"),
    "g/cm3": (lambda: scaled(1e-3, "density"), r"Ply: density = 1.586 kg/m3, usually 10 to 25000 kg/m3"),
    "t/mm3": (lambda: scaled(1e-12, "density"), r"density = 1.586e-09 kg/m3"),
    "strength in MPa": (lambda: Strength(Xt=1500.0, Xc=1200.0, Yt=40.0, Yc=250.0, S12=70.0), "Strength: Yt = 40 Pa"),
    "strength along the fibre": (
        lambda: mbd.Ply(**CARBON, strength=Strength(Xt=2e5, Xc=2e5, Yt=2e5, Yc=2e5, S12=2e5)),
        "strength along the fibre = 200000 Pa",
    ),
    "stiffness below zero": (lambda: spring(stiffness=-3.0), "stiffness of 'spring' = -3 N m/rad is negative"),
    "damping below zero": (
        lambda: spring(damping=mbd.variable(-1.0)),
        "damping of 'spring' = -1 N m s/rad is negative",
    ),
    "drive of 100": (lambda: turned_by(mbd.SmoothStep(100.0, 1.0)), "motor.size = 100 rad"),
    "function of 45": (lambda: turned_by(lambda t: 45.0 + 0.0 * t), "motor.angle at t = 0 = 45 rad"),
    "aluminum in GPa": (lambda: mbd.Ply.isotropic(70.0, 0.33, 2700.0), r"Ply: E1 = 70 Pa"),
    "solid in GPa": (lambda: Orthotropic.isotropic(70.0, 0.33, 2700.0), r"Orthotropic: E1 = 70 Pa"),
    "mesh in mm": (lambda: mbd.mesh.rectangle(300.0, 100.0, (4, 2)), r"nodes of a Mesh: extent = 316.* m"),
    "width in mm": (lambda: mbd.mesh.rectangle(3.0, 450.0, (4, 2)), r"nodes of a Mesh: extent = 450.* m"),
    "small mesh in mm": (lambda: sheet(100.0, 50.0, 1e-3), r"thickness of 'sheet' by its size = 8.9.*e-06"),
    "plies in mm": (lambda: sheet(0.3, 0.1, 0.4), r"thickness of 'sheet' by its size = 1.26"),
    "nodes of a mesh in mm": (
        lambda: mbd.Mesh([[0, 0, 0], [300, 0, 0], [0, 60, 0]], [[0, 1, 2]]),
        r"nodes of a Mesh: extent = 305.* m",
    ),
    "metal section in GPa": (
        lambda: mbd.GivenSection.isotropic(70.0, 0.3, 2700.0, 1e-4, 1e-9, 1e-9, 2e-9),
        r"GivenSection: E = 70 Pa",
    ),
    "metal section in mm": (
        lambda: mbd.GivenSection.isotropic(70e9, 0.3, 2700.0, 1e-4, 833.0, 833.0, 1400.0),
        r"GivenSection: area and Iyy: radius of gyration = 2886.* m",
    ),
    "area in mm2": (
        lambda: mbd.GivenSection.isotropic(70e9, 0.3, 2700.0, 1e3, 1e-9, 1e-9, 2e-9),
        r"GivenSection: area = 1000 m2",
    ),
    "layer in mm": (lambda: mbd.Laminate(mbd.Ply(**CARBON), [0.0], 2.0), r"Laminate: thickness = 2 m"),
    "wall in mm": (lambda: tube(radius=20.0, thickness=1.5), r"thickness = 1.5 m"),
    "radius in mm": (lambda: tube(radius=25.0, thickness=0.1), r"radius = 25 m"),
    "width of a box": (
        lambda: mbd.sections.box(40.0, 20.0, mbd.Ply(**CARBON), [0.0], 0.1),
        r"width = 40 m",
    ),
    "line in mm": (lambda: mbd.BeamLine.straight(300.0), r"extent of a BeamLine = 300 m"),
    "nodes in mm": (lambda: mbd.BeamLine([[0, 0, 0], [0, 250, 0]]), r"extent of a BeamLine = 250 m"),
    "inertia in kg mm2": (
        lambda: mbd.RigidBody("arm", 0.7, (3e3, 2e3, 2e3)),
        r"radius of gyration of 'arm' = 65.* m",
    ),
    "thickness as design": (
        lambda: mbd.simulate(pendulum(), 1e-6, steps=1, designs={THICKNESS: degrees(1.5, 1.5)}),
        r"design of lane 0: rod.laminate.thickness = 1.5 m",
    ),
    "thickness as bound": (
        lambda: problem(variables=[THICKNESS], bounds=(1e-3, 3.0)),
        r"upper bound of rod.laminate.thickness = 3 m",
    ),
}


@pytest.mark.parametrize("name", DOUBTED)
def test_other_units_are_doubted(name):
    make, words = DOUBTED[name]
    with pytest.warns(UserWarning, match=words if "\\" in words else words.replace("?", r"\?")):
        make()


LEGITIMATE = {
    "moon": lambda: falling(1.62),
    "ten times the earth": lambda: falling(98.1),
    "soft core": lambda: Strength(Xt=1e5, Xc=1e5, Yt=1e5, Yc=1e5, S12=1e5),
    "many turns": lambda: turned_by(mbd.SmoothStep(91.0, 1.0)),
    "travel of 90 m": lambda: turned_by(mbd.SmoothStep(90.0, 60.0), "position"),
    "MEMS plate": lambda: sheet(1e-4, 2e-5, 1e-6),
    "blade of 100 m": lambda: sheet(100.0, 4.0, 0.04, (10, 2)),
    "solar blanket": lambda: sheet(10.0, 2.0, 2.5e-4),
    "thick plate": lambda: sheet(0.3, 0.3, 0.15),
    "foam": lambda: mbd.Ply.isotropic(1e6, 0.3, 30.0),
    "heavy foam": lambda: mbd.Ply.isotropic(1e6, 0.3, 200.0),
    "rubber": lambda: mbd.Ply.isotropic(1e6, 0.49, 1100.0),
    "honeycomb": lambda: mbd.Ply(E1=1e4, E2=1e4, G12=1e3, G13=3e8, G23=1.5e8, nu12=0.3, density=48.0),
    "pitch fibre": lambda: mbd.Ply(E1=900e9, E2=6e9, G12=20e9, G13=20e9, G23=2e9, nu12=0.3, density=2200.0),
    "balsa": lambda: mbd.Ply(E1=3e9, E2=1e8, G12=1.5e8, G13=1.5e8, G23=3e7, nu12=0.3, density=120.0),
    "diamond": lambda: mbd.Ply.isotropic(1100e9, 0.07, 3500.0),
    "tungsten": lambda: mbd.Ply.isotropic(400e9, 0.28, 19300.0),
    "glass": lambda: mbd.Ply.isotropic(70e9, 0.2, 2500.0, strength=Strength(Xt=3e7, Xc=1e9, Yt=3e7, Yc=1e9, S12=3e7)),
    "tower": lambda: mbd.sections.tube(5.0, mbd.Ply.isotropic(210e9, 0.3, 7850.0), [0.0], 0.05),
    "needle": lambda: mbd.sections.circle(2.5e-5, mbd.Ply.isotropic(210e9, 0.3, 7850.0)),
    "line of 120 m": lambda: mbd.BeamLine.straight(120.0),
    "micro beam": lambda: mbd.BeamLine.straight(1e-4),
    "satellite": lambda: mbd.RigidBody("bus", 2000.0, (8e3, 9e3, 1e4)),
    "without inertia": lambda: mbd.RigidBody("dot", 1.0, (0.0, 0.0, 0.0)),
    "flywheel": lambda: mbd.RigidBody("wheel", 5000.0, (2e4, 1e4, 1e4)),
    "micro mirror": lambda: mbd.RigidBody("mirror", 1e-9, (1e-16, 1e-16, 2e-16)),
}


@pytest.mark.parametrize("name", LEGITIMATE)
def test_what_some_structure_has_is_not_doubted(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        LEGITIMATE[name]()


@pytest.mark.parametrize("direction", [(0.0, -1.0, 0.0), (0.6, 0.0, -0.8)])
@pytest.mark.parametrize(("size", "unit"), [(9810.0, "mm"), (980.665, "cm"), (386.09, "in"), (32.174, "ft")])
def test_the_gravity_of_the_earth_in_another_unit_is_doubted(direction, size, unit):
    bob = mbd.RigidBody("bob", 1.0, (1.0, 1.0, 1.0))
    with pytest.warns(UserWarning, match=f"units of gravity.*{unit}/s2"):
        mbd.System([bob], [], gravity=[size * x for x in direction])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for other in (0.0, 1.62, 9.81, 24.8, 100.0, 1000.0):  # nothing, moon, earth, Jupiter, centrifuges
            mbd.System([bob], [], gravity=[other * x for x in direction])
