"""Systems with more modes: as if they had been built so."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchmbd as mbd
from torchmbd.diagnosis.richer import richer_system


def arm(modes: int, **options) -> mbd.System:
    mesh = mbd.mesh.rectangle(length=0.5, width=0.05, cells=(6, 2))
    laminate = mbd.Laminate(mbd.examples.carbon(), mbd.deg([30.0, -50.0]), thickness=1e-3)
    body = mbd.FlexibleBody.plate("arm", mesh, laminate, modes=modes, reference="left", **options)
    return mbd.System([body], [mbd.Fixed(mbd.Ground().at(), body.at("left"))], gravity=(0.0, 0.0, -9.81))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("options", "modes", "more"),
    [({}, 2, 4), ({}, 6, 9), ({"reduction": "craig-bampton", "interface": ["right"]}, 0, 2)],
)
def test_more_modes_are_those_of_a_body_that_has_them(options, modes, more):
    system, names = richer_system(arm(modes, **options))
    expected = arm(more, **options)
    assert names == ["arm"]
    assert system.body("arm").modes == expected.body("arm").modes
    torch.testing.assert_close(system.body("arm").structure()["Kr"], expected.body("arm").structure()["Kr"])
    assert system.topology.n_q == expected.topology.n_q
    assert list(dict(system.named_parameters())) == list(dict(expected.named_parameters()))


def test_the_system_itself_stays():
    system = arm(3)
    before = {name: x.clone() for name, x in system.state_dict().items()}
    richer, _ = richer_system(system)
    assert system.body("arm").modes == 3
    assert all(torch.equal(x, system.state_dict()[name]) for name, x in before.items())
    assert not {id(x) for x in richer.parameters()} & {id(x) for x in system.parameters()}


@pytest.mark.thorough
def test_damping_ratios_go_on_with_the_last():
    system = arm(2)
    system.body("arm").damped([0.01, 0.02])
    richer, _ = richer_system(system)
    assert richer.body("arm").damping.of_modes(4).tolist() == [0.01, 0.02, 0.02, 0.02]


@pytest.mark.thorough
def test_bodies_of_matrices_have_more_modes_too():
    M, K = arm(2).body("arm").mass_and_stiffness()
    nodes = arm(2).body("arm").mesh
    body = mbd.FlexibleBody.from_matrices("box", M, K, nodes, modes=3, reference="left")
    joint = mbd.Fixed(mbd.Ground().at(), body.at("left"))
    system, names = richer_system(mbd.System([body], [joint]))
    assert names == ["box"]
    assert system.body("box").modes == 5
    assert body.modes == 3
    lowest = torch.linalg.eigvalsh(system.body("box").structure()["Kr"])[:3]
    torch.testing.assert_close(lowest, torch.linalg.eigvalsh(body.structure()["Kr"]))


@pytest.mark.thorough
def test_bodies_without_further_modes():
    body = arm(3).body("arm")
    structure = {name: x.detach() for name, x in body.structure().items()}
    invariants = {k: x for k, x in structure.items() if k not in ("Kr", "psi")}
    given = mbd.FlexibleBody.from_reduced("given", body.mesh, structure["psi"], structure["Kr"], invariants)
    joint = mbd.Fixed(mbd.Ground().at(), given.at("left"))
    assert richer_system(mbd.System([given], [joint]))[1] == []
    assert richer_system(mbd.examples.pendulum())[1] == []
    line = mbd.BeamLine.straight(1.0, 1)
    rod = mbd.GivenSection.isotropic(E=210e9, nu=0.3, density=7850.0, area=1e-4, Iyy=1e-9, Izz=2e-9, J=2e-9)
    whole = mbd.FlexibleBody.beam("whole", line, rod, modes=6, reference="start")
    joint = mbd.Fixed(mbd.Ground().at(), whole.at("start"))
    system, names = richer_system(mbd.System([whole], [joint]))
    assert names == []
    assert system.body("whole").modes == 6
    assert np.isfinite(system.body("whole").structure()["Kr"].detach().numpy()).all()
