"""Pieces of a beam together are the beam: mass, frequencies, nodes, parameters; other bodies are refused."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

import torchmbd as mbd
from tests.refused import refused

CARBON = mbd.Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=5.36e9, nu12=0.23, density=1586.0)
TUBE = mbd.sections.tube(0.02, CARBON, mbd.deg([30, -30]), 5e-4)
STEEL = mbd.sections.tube(0.03, mbd.Ply.isotropic(E=210e9, nu=0.3, density=7850.0), [0.0], 1e-3)


def arm(line: mbd.BeamLine | None = None, section: Any = TUBE, **options: Any) -> mbd.FlexibleBody:
    line = mbd.BeamLine.straight(2.0, 9) if line is None else line
    return mbd.FlexibleBody.beam("arm", line, section, **{"modes": 6, "reference": "start"} | options)


def frequencies(bodies: Any, joints: Any, start: mbd.Frame) -> torch.Tensor:
    system = mbd.System(bodies, [mbd.Fixed(mbd.Ground().at(), start), *joints], truncation=None)
    return mbd.equilibrium(system).vibrations[0].frequencies.detach()


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["straight", "arc of two sections"])
def test_frequencies_are_those_of_the_beam(kind: str):
    arc = kind != "straight"
    line = mbd.BeamLine.arc(1.0, math.pi / 3, 9) if arc else None
    turn = torch.linspace(0.0, 0.6, 9, dtype=torch.float64) if arc else 0.0
    body = arm(line, [TUBE] * 4 + [STEEL] * 5 if arc else TUBE, twist=turn)
    chain = mbd.split(body, 3, modes=4)
    one, several = frequencies([body], [], body.at("start")), frequencies(chain.bodies, chain.joints, chain.at("start"))
    torch.testing.assert_close(several[:4], one[:4], rtol=5e-3, atol=0.0)
    mass = sum(piece.structure()["mass"] for piece in chain.bodies)
    torch.testing.assert_close(mass, body.structure()["mass"])


@pytest.mark.thorough
def test_nodes_and_parameters():
    body = arm(position=(0.1, 0.2, 0.3), axes=[[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    chain = mbd.split(body, 4, interface=[3])
    assert [len(piece.mesh.elements) for piece in chain.bodies] == [2, 2, 3, 2]
    for k in range(10):
        frame = chain.at(k)
        result = frame.body.position + frame.body.axes @ frame.point
        torch.testing.assert_close(result, body.position + body.axes @ body.places()[k])
    assert chain.bodies[1].modes == 12
    system = mbd.System(chain.bodies, [mbd.Fixed(mbd.Ground().at(0.1, 0.2, 0.3), chain.at("start")), *chain.joints])
    assert [name for name, _ in system.named_parameters()] == ["arm_0.section.angles"]


@pytest.mark.parametrize(
    ("change", "path"),
    [
        ({"body": 3.0}, "body"),
        ({"body": arm().moving(velocity=(1.0, 0.0, 0.0))}, "arm"),
        ({"body": arm().damped(0.1)}, "arm"),
        ({"n": 10}, "n"),
        ({"modes": -1}, "modes"),
    ],
)
def test_wrong_arguments_are_named(change: dict, path: str):
    with refused(path):
        mbd.split(**{"body": arm(), "n": 3} | change)


@pytest.mark.thorough
def test_other_bodies_are_refused():
    laminate = mbd.Laminate(CARBON, [0.0], [1e-3])
    plate = mbd.FlexibleBody.plate("panel", mbd.mesh.rectangle(0.5, 0.1, (4, 2)), laminate, modes=2)
    with refused("panel"):
        mbd.split(plate, 2)
    fork = mbd.BeamLine([[0.0, 0, 0], [1.0, 0, 0], [2.0, 1, 0], [2.0, -1, 0]], [[0, 1], [1, 2], [1, 3]])
    with refused("arm.line"):
        mbd.split(arm(fork, reference=0), 2)
    with refused("node"):
        mbd.split(arm(), 2, interface=None)
    with refused("node", [0, 1]):
        mbd.split(arm(), 3).at([0, 1])  # pyright: ignore[reportArgumentType]
