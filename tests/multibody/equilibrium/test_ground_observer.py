"""Rotors in bearings of two stiffnesses, seen from the ground: published frequencies, and closed forms of a mass."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

import torchmbd as mbd
from tests.refused import ANY, refused

GROUND = mbd.Ground()
E, G, DENSITY = 211e9, 81.2e9, 7810.0  # of the rotors below


def rotor(
    length: float, disks: dict[float, float], bearings: tuple[float, ...], k: tuple[Any, Any], elements: int
) -> mbd.System:
    """A round steel shaft, 50 mm thick, with disks 70 mm wide (place -> diameter) in bearings of stiffness k across."""
    d = 0.05
    I = math.pi * d**4 / 64.0
    section = mbd.GivenSection.isotropic(E, E / (2.0 * G) - 1.0, DENSITY, math.pi * d**2 / 4.0, Iyy=I, Izz=I, J=2.0 * I)
    shaft = mbd.FlexibleBeam("shaft", mbd.BeamLine.straight(length, elements=elements), section)
    bodies, joints, forces = [shaft], [], []
    for i, (x, outer) in enumerate(disks.items()):
        mass = DENSITY * math.pi * 0.07 * (outer**2 - d**2) / 4.0
        polar = DENSITY * math.pi * 0.07 * (outer**4 - d**4) / 32.0
        across = 0.5 * polar + mass * 0.07**2 / 12.0
        bodies.append(mbd.RigidBody(f"disk{i}", mass, (polar, across, across), position=(x, 0.0, 0.0)))
        joints.append(mbd.Fixed(shaft.at(round(x / length * elements)), bodies[-1].at(), name=f"shrink_fit{i}"))
    for i, x in enumerate(bearings):
        node = shaft.at(round(x / length * elements))
        along = 1e3 if i == 0 else 0.0  # a thrust bearing, so that the rotor has one free motion and not two
        forces.append(mbd.Bushing(GROUND.at(x, 0.0, 0.0), node, stiffness=(along, *k), name=f"bearing{i}"))
    return mbd.System(bodies, joints, forces)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("speed", "wanted"),
    [
        (0.0, [82.65303734, 86.65811435, 254.52047828, 274.31285391]),
        (300.0, [82.48132723, 86.76734307, 245.49092844, 282.33294699]),
        (2000.0, [77.37957042, 88.98733512]),
    ],
)
def test_rotor3_of_ross(speed, wanted):
    """petrobras/ross, tests/test_rotor_assembly.py [rad/s]; ours of second order in the length of elements.

    Extrapolated to elements of no length they differ by 1e-4: the printed numbers are of six elements.
    """
    errors = []
    for elements in (12, 24):
        system = rotor(1.5, {0.5: 0.28, 1.0: 0.35}, (0.0, 1.5), (1e6, 0.8e6), elements)
        turning = {"spin": (speed, 0.0, 0.0), "observer": "ground", "unstable": True} if speed else {}
        w = 2.0 * math.pi * mbd.equilibrium(system, **turning).vibrations[0].frequencies[2 : 2 + len(wanted)]
        errors.append(w / torch.tensor(wanted, dtype=torch.float64) - 1.0)
    assert float(errors[1].abs().max()) < 1.2e-3
    assert float(((4.0 * errors[1] - errors[0]) / 3.0).abs().max()) < 2e-4
    # The printed numbers err by 1e-4.
    assert (errors[0] / errors[1]).tolist() == pytest.approx([4.0] * len(wanted), rel=0.15)


def test_a_mass_in_unequal_bearings():
    """The frequencies of the ground are those at rest; a turning observer has none, and says who has."""
    body = mbd.RigidBody("disk", 2.0, (0.02, 0.01, 0.01))
    k = (1e4, 8e3, 5e3)
    hold = mbd.Bushing(GROUND.at(), body.at(), stiffness=k, turning_stiffness=(0.0, 1e3, 1e3), name="bearing")
    system = mbd.System([body], forces=[hold])
    turning: dict[str, Any] = {"spin": (30.0, 0.0, 0.0), "unstable": True}
    with refused("system", ANY, "observer='ground'"):
        mbd.equilibrium(system, **turning)
    w = 2.0 * math.pi * mbd.equilibrium(system, observer="ground", **turning).vibrations[0].frequencies
    assert w[1:4].tolist() == pytest.approx([math.sqrt(x / 2.0) for x in sorted(k)], rel=1e-10)
    # Nutation and precession of the disk: J s^2 -+ i Jp speed s + k = 0.
    g = 0.02 * 30.0 / 0.01
    pair = [(math.sqrt(g**2 + 4e5) - g) / 2.0, (math.sqrt(g**2 + 4e5) + g) / 2.0]
    assert w[4:].tolist() == pytest.approx(pair, rel=1e-9)


def test_both_observers_agree_where_both_can_look():
    """In the plane of equal bearings: w of the ground is w + speed or w - speed of the rotor."""
    body = mbd.RigidBody("disk", 2.0, (0.02, 0.01, 0.01))
    hold = mbd.Bushing(GROUND.at(), body.at(), stiffness=(1e4, 8e3, 8e3), turning_stiffness=(0.0, 1e3, 1e3))
    system, speed = mbd.System([body], forces=[hold]), 30.0
    ground, turning = (
        2.0 * math.pi * mbd.equilibrium(system, spin=(speed, 0.0, 0.0), observer=observer).vibrations[0].frequencies
        for observer in ("ground", "turning")
    )
    for w in ground[[1, 2]]:
        assert min(float((turning - x).abs().min()) for x in (w + speed, (w - speed).abs())) < 1e-7 * float(w)


def test_bad_observers_are_named():
    section = mbd.GivenSection.isotropic(E, 0.3, DENSITY, 1e-3, Iyy=1e-6, Izz=1e-6, J=2e-6)
    body = mbd.FlexibleBody.beam("shaft", mbd.BeamLine.straight(1.0, 4), section, modes=4)
    system = mbd.System([body], forces=[mbd.Bushing(GROUND.at(), body.at("start"), stiffness=(1e4, 1e4, 1e4))])
    with refused("observer", "moon"):
        mbd.equilibrium(system, spin=(1.0, 0.0, 0.0), observer="moon")
    with refused("observer", "ground"):
        mbd.equilibrium(system, observer="ground")
    with refused("observer"):
        mbd.equilibrium(system, spin=(1.0, 0.0, 0.0), observer="ground")
    with refused("spin", [[1.0, 0.0], [2.0, 0.0]]):
        mbd.equilibrium(system, spin=[[1.0, 0.0], [2.0, 0.0]])
