"""Errors of responses by modes; of motions with phases, checkpoints, other starts; of motions that agree by chance."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

import torchmbd as mbd
from tests.diagnosis.test_response_errors import oscillator
from tests.refused import refused

pytestmark = pytest.mark.usefixtures("compiled")

SECTION = mbd.GivenSection.isotropic(E=70e9, nu=0.3, density=2700.0, area=4e-5, Iyy=4e-11, Izz=9e-11, J=1e-10)
TIP = mbd.Displacement("beam", "z", node="end")


def cantilever(modes: int, force: float = 1.0, **options) -> mbd.System:
    beam = mbd.FlexibleBody.beam(
        "beam", mbd.BeamLine.straight(0.4, 12), SECTION, modes=modes, reference="start", damping=1e-3, **options
    )
    joint = mbd.Fixed(mbd.Ground().at(), beam.at("start"), name="root")
    return mbd.System([beam], [joint], [mbd.Force(beam.at("end"), (0.0, 0.0, force))], truncation=None)


def by_modes(error: Any) -> torch.Tensor:
    assert error.by_modes is not None, str(error)
    return error.by_modes


def exact(system: mbd.System, response, duration: float = 0.05, steps: int = 200, **options) -> torch.Tensor:
    return response(mbd.simulate(system, duration, steps=steps, gradients="none", **options))


@pytest.mark.thorough
@pytest.mark.parametrize("modes", [2, 4, 8])
def test_error_by_modes_of_a_cantilever(modes):
    """Against 40 modes, by the same steps."""
    response = mbd.Integral(TIP)
    motion = mbd.simulate(cantilever(modes), 0.05, steps=200, gradients="none")
    error = motion.error_of(response)
    assert not error.unknown
    share = by_modes(error) / (exact(cantilever(40), response) - error.value)
    assert 0.5 < share.item() < 2.0


@pytest.mark.thorough
def test_error_by_modes_in_closed_form():
    """Statics by two modes: one in the plane of the force, 0.971 of F l^3 / 3 E I; the next mode adds 0.025."""
    motion = mbd.simulate(cantilever(2), 1e-3, steps=2, start="equilibrium", gradients="none")
    error = motion.error_of(mbd.Final(TIP))
    sag = 1.0 * 0.4**3 / (3.0 * 70e9 * 4e-11)
    assert by_modes(error).item() / sag == pytest.approx(0.025, abs=0.003)


@pytest.mark.thorough
def test_total_and_text():
    motion = mbd.simulate(cantilever(2), 0.02, steps=100, gradients="none")
    error = motion.error_of(mbd.Integral(TIP))
    assert error.by_mesh is not None
    sizes = [x.abs() for x in (error.by_steps, by_modes(error), error.by_mesh)]
    torch.testing.assert_close(error.error, sizes[0] + sizes[1] + sizes[2])
    assert all(text in str(error) for text in ("error by steps", "by modes", "by mesh"))
    steps_only = motion.error_of(mbd.Integral(TIP), modes=False, mesh=False)
    assert steps_only.by_modes is None
    assert steps_only.by_mesh is None
    torch.testing.assert_close(steps_only.error, error.by_steps.abs())
    with refused("modes", "no"):
        motion.error_of(mbd.Integral(TIP), modes="no")  # pyright: ignore[reportArgumentType]


@pytest.mark.thorough
def test_rigid_bodies_have_no_error_by_modes():
    motion = mbd.simulate(mbd.examples.pendulum(), 0.1, steps=10, gradients="none")
    error = motion.error_of(mbd.Final(mbd.Angle("bob", "z")))
    assert error.by_modes is not None
    assert error.by_modes.tolist() == [0.0]


@pytest.mark.thorough
def test_modes_that_were_given_have_no_estimate():
    body = cantilever(4).body("beam")
    structure = {name: x.detach() for name, x in body.structure().items()}
    invariants = {k: x for k, x in structure.items() if k not in ("Kr", "psi")}
    given = mbd.FlexibleBody.from_reduced("beam", body.mesh.nodes, structure["psi"], structure["Kr"], invariants)
    system = mbd.System([given], [mbd.Fixed(mbd.Ground().at(), given.at(0))], gravity=(0.0, 0.0, -9.81))
    error = mbd.simulate(system, 0.01, steps=20, gradients="none").error_of(mbd.Integral(mbd.StrainEnergy("beam")))
    assert error.by_modes is None
    assert "modes of 'beam' were given" in error.unknown[0]
    assert "were given" in str(error)


@pytest.mark.thorough
def test_modal_coordinates_of_a_start_are_carried_over():
    """By Craig-Bampton, whose modes all change with their number: the same deflections at the start."""
    system = cantilever(2, reduction="craig-bampton", interface=["end"])
    w = [0.0] * system.body("beam").modes
    w[0], w[1] = 1e-3, -2e-4
    designs = {"beam.modal": w, "beam.modal_velocity": [0.1 * x for x in w]}
    motion = mbd.simulate(system, 0.01, steps=40, start=designs, gradients="none")
    richer = motion.require_repetition().richer(motion)
    assert richer is not None
    assert richer.body("beam").w.shape[-1] == len(w) + 2
    one, other = motion.body("beam"), richer.body("beam")
    torch.testing.assert_close(one.displacements[:, 0], other.displacements[:, 0], rtol=0.0, atol=1e-12)
    system.body("beam").bent(w)
    bent = mbd.simulate(system, 0.01, steps=40, gradients="none")
    richer = bent.require_repetition().richer(bent)
    assert richer is not None
    there = richer.body("beam").displacements[:, 0]
    torch.testing.assert_close(bent.body("beam").displacements[:, 0], there, rtol=0.0, atol=1e-12)
    assert bent.error_of(mbd.Integral(TIP)).by_modes is not None
    both = mbd.simulate(system, 0.01, steps=40, start="equilibrium", gradients="none").error_of(mbd.Final(TIP))
    assert both.by_modes is None
    assert "'beam.modal'" in both.unknown[0]


@pytest.mark.thorough
@pytest.mark.parametrize("start", ["equilibrium", "motion", "mapping"])
def test_starts(start):
    system = cantilever(3)
    first = mbd.simulate(system, 0.02, steps=100, gradients="none")
    starts = {"equilibrium": "equilibrium", "motion": first, "mapping": {"beam.modal_velocity": [0.02, 0.0, 0.01, 0.0]}}
    if start == "mapping":
        starts["mapping"]["beam.modal_velocity"] = starts["mapping"]["beam.modal_velocity"][: system.body("beam").modes]
    response = mbd.Integral(mbd.Velocity("beam", "z", node="end") ** 2) if start != "equilibrium" else mbd.Final(TIP)
    motion = mbd.simulate(system, 0.02, steps=100, start=starts[start], gradients="none")
    finer = mbd.simulate(system, 0.02, steps=800, start=starts[start], gradients="none")
    error = motion.error_of(response)
    assert error.resolved.all(), str(error)
    assert not error.unknown, str(error)
    true = response(finer) - error.value
    assert abs(error.by_steps - true).item() <= 0.5 * abs(true).item() + 1e-9 * abs(error.value).item()
    assert error.by_modes is not None
    assert error.by_modes.abs().item() < 0.1 * abs(error.value).item()


@pytest.mark.thorough
def test_phases():
    """The root is locked, then released: locks by joint and by name, a time that has a gradient."""
    beam = mbd.FlexibleBody.beam(
        "beam", mbd.BeamLine.straight(0.4, 6), SECTION, modes=3, reference="start", damping=1e-3
    )
    hinge = mbd.Revolute(mbd.Ground().at(), beam.at("start"), axis="y", name="hinge")
    system = mbd.System([beam], [hinge], gravity=(0.0, 0.0, -9.81), truncation=None)
    until = torch.tensor(0.05, dtype=torch.float64, requires_grad=True)
    phases = [mbd.Phase(until=until, lock=[hinge]), mbd.Phase()]
    response = mbd.Final(mbd.Position("beam", "z", node="end"))
    motion = mbd.simulate(system, 0.15, steps=150, phases=phases)
    error = motion.error_of(response)
    plain = [mbd.Phase(until=0.05, lock=["hinge"]), mbd.Phase()]
    finer = mbd.simulate(system, 0.15, steps=1200, phases=plain, gradients="none")
    assert error.resolved.all(), str(error)
    assert 0.5 < (error.by_steps / (response(finer) - error.value)).item() < 2.0
    assert error.by_modes is not None
    assert error.by_modes.abs().item() < 0.05 * abs(error.value).item()


@pytest.mark.thorough
def test_checkpoints_and_options_are_kept():
    system = cantilever(3)
    plain = mbd.simulate(system, 0.02, steps=80, spectral_radius=0.6, gradients="none").error_of(mbd.Final(TIP))
    options = {"spectral_radius": 0.6, "checkpoint": 10}
    sparse = mbd.simulate(system, 0.02, steps=80, **options).error_of(mbd.Final(TIP))
    more = mbd.Final(TIP)(mbd.simulate(system, 0.02, steps=190, gradients="none", **options))  # a multiple of 10
    of_more = (more - sparse.value) / (1.0 - (80 / 190) ** 2)
    torch.testing.assert_close(of_more, sparse.by_steps, rtol=1e-6, atol=0.0)
    torch.testing.assert_close(plain.by_steps, sparse.by_steps, rtol=1e-3, atol=0.0)
    torch.testing.assert_close(plain.by_modes, sparse.by_modes, rtol=1e-6, atol=0.0)


@pytest.mark.thorough
def test_motions_that_agree_by_chance_are_not_believed():
    """Places of a vibration with 1.2 to 2 steps a period at many times: x = v0 / om sin(om t)."""
    omega, by_two, believed = 2.0 * math.pi * 40.0, 0, 0
    for steps in (50, 64, 80):
        motion = mbd.simulate(oscillator(), 1.003, steps=steps, gradients="none")
        for k in range(40, 200):
            t = 0.005 * k + 3e-4
            response = mbd.AtTime(mbd.Position("bob", "x"), t)
            error = motion.error_of(response)
            value, half = error.value.item(), response(motion.require_repetition().finer(2)).item()
            size = error.size.item()
            if abs(math.sin(omega * t) / omega - value) > 0.5 * size:  # it is wrong
                by_two += abs(half - value) < 0.1 * size
                believed += error.resolved.item() and error.by_steps.abs().item() < 0.14 * size
    assert by_two > 10
    assert believed < 0.3 * by_two


def strip(times: int = 1) -> mbd.System:
    mesh = mbd.mesh.rectangle(0.4, 0.05, cells=(4 * times, 2 * times))
    laminate = mbd.Laminate(mbd.examples.carbon(), mbd.deg([30.0, -30.0]), thickness=1e-3)
    plate = mbd.FlexibleBody.plate("beam", mesh, laminate, modes=3, reference="left_edge", damping=1e-3)
    joint = mbd.Fixed(mbd.Ground().at(), plate.at("left"))
    return mbd.System([plate], [joint], [mbd.Force(plate.at("right"), (0.0, 0.0, 1.0))], truncation=None)


@pytest.mark.thorough
def test_error_by_the_mesh_of_a_plate():
    """Against a mesh of eight times the cells in each direction, by the same modes and steps."""
    response = mbd.Integral(mbd.Displacement("beam", "z", node="right"))
    motion = mbd.simulate(strip(), 0.02, steps=100, gradients="none")
    error = motion.error_of(response)
    assert not error.unknown
    assert error.by_mesh is not None
    share = error.by_mesh / (exact(strip(8), response, 0.02, 100) - error.value)
    assert 0.5 < share.item() < 2.0, share


@pytest.mark.thorough
def test_meshes_that_are_not_refined_have_no_estimate():
    arc = mbd.FlexibleBody.beam("beam", mbd.BeamLine.arc(0.5, 1.0, 4), SECTION, modes=3, reference="start")
    system = mbd.System([arc], [mbd.Fixed(mbd.Ground().at(), arc.at("start"))], gravity=(0.0, 0.0, -9.81))
    error = mbd.simulate(system, 0.01, steps=20, gradients="none").error_of(mbd.Integral(mbd.StrainEnergy("beam")))
    assert error.by_mesh is None
    assert "'beam' is not refined" in error.unknown[0]
    assert error.by_modes is not None
