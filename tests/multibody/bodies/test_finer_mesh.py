"""Bodies on finer meshes: as if they had been built with twice the cells."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch

import torchmbd as mbd
from torchmbd.fem.elements import Plates
from torchmbd.multibody.bodies.refinement import obstacle, refine

ROD = mbd.GivenSection.isotropic(E=70e9, nu=0.3, density=2700.0, area=4e-5, Iyy=4e-11, Izz=9e-11, J=1e-10)
TUBE = mbd.sections.tube(0.02, mbd.examples.carbon(), mbd.deg([40.0, -30.0]), thickness=1e-3, cells=(12, 1))


def plate(times: int = 1, kind: str = "quad", **options: Any) -> mbd.FlexibleBody:
    given: dict[str, Any] = {"modes": 5} | options
    mesh = mbd.mesh.rectangle(0.4, 0.1, cells=(4 * times, 2 * times), kind=kind)
    laminate = mbd.Laminate(mbd.examples.carbon(), mbd.deg([30.0, -50.0]), thickness=1e-3)
    return mbd.FlexibleBody.plate("body", mesh, laminate, **given)


def beam(times: int = 1, section: Any = ROD, length: Any = 0.4, **options: Any) -> mbd.FlexibleBody:
    line = mbd.BeamLine.straight(length, 4 * times)
    return mbd.FlexibleBody.beam("body", line, section, **({"modes": 5, "reference": "start"} | options))


EDGES = {"root": "left_edge", "tip": mbd.Interface("right_edge", rigid=True)}
BODIES = {
    "plate": (plate, {}),
    "clamped edge": (plate, {"reference": "left_edge"}),
    "rigid edge": (plate, {"rigid": ["right_edge"], "reference": "left"}),
    "interface of nodes": (plate, {"reduction": "craig-bampton", "interface": ["left", "right"], "modes": 3}),
    "rigid interface": (
        plate,
        {"reduction": "craig-bampton", "interface": mbd.Interface("right_edge", rigid=True), "reference": "left_edge"},
    ),
    "stiffening": (plate, {"stiffening": True, "reference": "left_edge"}),
    "beam": (beam, {}),
    "beam of composite": (beam, {"section": TUBE, "modes": 6}),
    "beam of Craig-Bampton": (beam, {"reduction": "craig-bampton", "interface": ["end"], "modes": 0}),
    "offset and twist": (beam, {"offset": (0.01, 0.02), "twist": 0.3}),
}


@pytest.mark.thorough
@pytest.mark.parametrize("name", BODIES)
def test_structure_is_that_of_twice_the_cells(name):
    make, options = BODIES[name]
    body, expected = make(**options), make(2, **options)
    refine(body)
    result, wanted = body.structure(), expected.structure()
    for key in ("mass", "P0", "mu"):
        torch.testing.assert_close(result[key], wanted[key], rtol=1e-9, atol=1e-12)
    count = min(body.modes, expected.modes)  # modes of equal frequency stay together, on either mesh
    values, true = (torch.linalg.eigvalsh(x["Kr"])[:count] for x in (result, wanted))
    torch.testing.assert_close(values, true, rtol=1e-6, atol=1e-6 * float(true[0]))
    assert list(dict(body.named_parameters())) == list(dict(expected.named_parameters()))


def test_a_length_stays_a_design_variable():
    body, expected = beam(length=mbd.variable(0.4)), beam(2, length=mbd.variable(0.4))
    refine(body)
    for one in (body, expected):
        with torch.no_grad():
            dict(one.named_parameters())["line.length"].fill_(0.5)
    values = [torch.linalg.eigvalsh(one.structure()["Kr"]) for one in (body, expected)]
    torch.testing.assert_close(values[0], values[1], rtol=1e-6, atol=0.0)


@pytest.mark.thorough
def test_zones_keep_their_plies():
    stacks = [mbd.Laminate(mbd.examples.carbon(), mbd.deg([a]), thickness=2e-3) for a in (0.0, 60.0)]
    mesh = mbd.mesh.rectangle(0.4, 0.1, cells=(4, 2))
    left = [k for k in range(8) if float(mesh.nodes[mesh.quads[k]][:, 0].mean()) < 0.0]
    right = [k for k in range(8) if k not in left]
    parts = {"left": Plates(mesh, stacks[0], cells=left), "right": Plates(mesh, stacks[1], cells=right)}
    body = mbd.FlexibleBody("body", mesh, parts, 4, reference="left_edge")
    refine(body)
    finer = mbd.mesh.rectangle(0.4, 0.1, cells=(8, 4))
    x = finer.nodes[finer.quads][:, :, 0].mean(1)
    cells = [(x < 0.0).nonzero()[:, 0], (x > 0.0).nonzero()[:, 0]]
    parts = {n: Plates(finer, s, cells=c) for n, s, c in zip(("left", "right"), stacks, cells, strict=True)}
    expected = mbd.FlexibleBody("body", finer, parts, 4, reference="left_edge")
    values = [torch.linalg.eigvalsh(one.structure()["Kr"]) for one in (body, expected)]
    torch.testing.assert_close(values[0], values[1], rtol=1e-6, atol=0.0)


def test_the_start_of_the_body_is_kept():
    body = beam(position=(1.0, 2.0, 3.0), damping=1e-4).moving((0.1, 0.2, 0.3)).damped([0.01, 0.02, 0.03, 0.04, 0.05])
    before = copy.deepcopy(body)
    refine(body)
    assert torch.equal(body.position, before.position)
    assert torch.equal(body.velocity, before.velocity)
    assert body.damping.time == before.damping.time
    torch.testing.assert_close(body.damping.of_modes(4), before.damping.of_modes(4), rtol=0, atol=0)
    assert body.velocities_given == (True, False)


@pytest.mark.thorough
def test_obstacles():
    body = plate()
    structure = {name: x.detach() for name, x in body.structure().items()}
    invariants = {k: x for k, x in structure.items() if k not in ("Kr", "psi")}
    given = mbd.FlexibleBody.from_reduced("given", body.mesh, structure["psi"], structure["Kr"], invariants)
    assert "no mesh" in obstacle(given)
    arc = mbd.FlexibleBody.beam("arc", mbd.BeamLine.arc(0.5, 1.0, 4), ROD, modes=3, reference="start")
    assert "arcs" in obstacle(arc)
    assert not obstacle(body)
    twisted = beam(twist=[[0.0, 0.1], [0.1, 0.2], [0.2, 0.3], [0.3, 0.4]])
    assert "twisted" in obstacle(twisted)
