"""Flexible beams in systems: mass, statics as on their own, gradients on both backends, results, refusals."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor, nn
from torch.testing import assert_close

import torchmbd as mbd
from tests.fem.exact_beam.cases import coupled, given, matrix
from tests.refused import refused, warned

GROUND = mbd.Ground()
MASS = matrix(2.0, 2.0, 2.0, 3e-3, 1e-3, 2e-3)
SECTION = given(2e5, 1e5, 1e5, 20.0, 30.0, 40.0, mass=MASS)


def total(beam: mbd.FlexibleBeam) -> tuple[Tensor, Tensor, Tensor]:
    """Mass, first and second moments about the origin of the mesh axes."""
    own, x = beam.structure(), beam.mesh.nodes
    both = own.first[:, :, None] * x[:, None]
    second = own.second + both + both.mT + own.mass[:, None, None] * x[:, :, None] * x[:, None]
    return own.mass.sum(), (own.first + own.mass[:, None] * x).sum(0), second.sum(0)


def test_rigid_inertia_is_exact():
    """A straight beam of length 3 with its section turned and off the line, at 2 m/s2 along y."""
    line = mbd.BeamLine(torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [3.0, 0, 0]]))
    m, first, second = total(mbd.FlexibleBeam("beam", line, SECTION, offset=(0.1, 0.0), twist=math.pi / 2))
    assert_close(float(m), 6.0)
    assert_close(first, torch.tensor([9.0, 0.6, 0.0], dtype=torch.float64))
    inside = torch.zeros(3, 3, dtype=torch.float64)
    inside[0, 0], inside[0, 1], inside[1, 0] = 18.0, 0.9, 0.9
    inside[1, 1], inside[2, 2] = 0.06 + 3.0 * 1e-3, 3.0 * 2e-3  # a quarter turn exchanges y and z
    assert_close(second, inside, atol=1e-12, rtol=0)


def cantilever(beam: mbd.FlexibleBeam, *forces: mbd.forces.ForceElement) -> mbd.System:
    return mbd.System([beam], [mbd.Fixed(GROUND.at(), beam.at("start"), name="wall")], list(forces))


@pytest.mark.thorough
def test_equilibrium_is_that_of_the_beam_alone():
    line = mbd.BeamLine.arc(2.0, 1.0, 6)
    beam = mbd.FlexibleBeam("beam", line, mbd.GivenSection(coupled(), MASS), twist=[[0.0, 0.2]] * 6)
    load = torch.tensor([0.3, -0.2, 0.4], dtype=torch.float64)
    rest = mbd.equilibrium(cantilever(beam, mbd.Force(beam.at("end"), load.tolist())))
    result, alone = rest.body("beam"), beam.equilibrium({"end": load})
    assert float(result.displacements[0, 0, -1].norm()) > 0.1
    assert_close(result.nodes[0, 0], alone.nodes, atol=1e-9, rtol=0)
    assert_close(result.rotations[0, 0], alone.rotations, atol=1e-9, rtol=0)
    assert_close(result.forces[0, 0], alone.forces, atol=1e-8, rtol=0)
    assert_close(result.strain_energy, rest.energies.strain)
    assert_close(rest.reaction("wall").force[0, 0].norm(), load.norm(), atol=1e-8, rtol=0)


@pytest.mark.thorough
def test_frequencies_converge_with_the_square_of_the_length():
    load = (0.0, 4.0, 2.0)
    result = []
    for n in (4, 8, 16):
        beam = mbd.FlexibleBeam("beam", mbd.BeamLine.straight(2.0, n), SECTION)
        result.append(mbd.equilibrium(cantilever(beam, mbd.Force(beam.at("end"), load))).vibrations[0].frequencies[:3])
        alone = beam.frequencies(3, {"end": load})[0]
    assert bool((((result[0] - result[1]) / (result[1] - result[2])).abs() > 3.3).all())
    assert_close(result[2], alone, rtol=1e-2, atol=0)


CARBON = mbd.Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=3.6e9, nu12=0.23, density=1586.0)
DESIGNS = ("blade.section.0.angles", "blade.section.1.angles", "blade.twist")


def spun(damping: float) -> mbd.System:
    """A blade of plies, tapered and twisted, that a motor turns fast."""
    thick, thin = (
        mbd.sections.box(0.03, height, CARBON, mbd.deg([20, -10]), thickness=0.25e-3, cells=(3, 2, 1))
        for height in (0.01, 0.008)
    )
    twist = nn.Parameter(torch.linspace(0.0, 0.4, 3, dtype=torch.float64).repeat_interleave(2)[:-2].reshape(2, 2))
    table = mbd.SectionTable([0.0, 1.0], [thick, thin])
    blade = mbd.FlexibleBeam("blade", mbd.BeamLine.straight(1.0, 2), table, twist=twist, damping=damping)
    hinge = mbd.Revolute(GROUND.at(), blade.at("start"), axis="z", name="hinge")
    motor = mbd.Drive(GROUND.at(), blade.at("start"), axis="z", angle=mbd.SmoothStep(1.0, 0.1), name="motor")
    return mbd.System([blade], [hinge, motor], gravity=(0, 0, -9.81))


def tip(damping: float, designs: dict[str, Tensor], backend: str, gradients: str) -> Tensor:
    motion = mbd.simulate(spun(damping), 0.05, steps=50, designs=designs, backend=backend, gradients=gradients)
    assert motion.status == ["ok"] * motion.lanes
    blade = motion.body("blade")
    return blade.nodes[:, -1, -1].sum(-1) + 1e-2 * blade.forces[:, -1, 0, 0].sum(-1)


@pytest.mark.extensions  # by native steps
@pytest.mark.thorough
@pytest.mark.parametrize("damping", [0.0, 5e-4])
def test_gradients_by_plies_taper_and_twist(damping):
    own = dict(spun(damping).named_parameters())
    x = {name: own[name].detach()[None] for name in DESIGNS}
    along = {name: torch.randn(y.shape, generator=torch.Generator().manual_seed(3)).double() for name, y in x.items()}
    result = {}
    ways = [("native", "forward"), ("native", "reverse")]
    for way in ways if damping else [*ways, ("eager", "reverse")]:
        leaves = {name: y.clone().requires_grad_() for name, y in x.items()}
        by = torch.autograd.grad(tip(damping, leaves, *way)[0], list(leaves.values()))
        result[way] = torch.stack([(g * d).sum() for g, d in zip(by, along.values(), strict=True)])
    h, expected = 1e-3, []
    for name in DESIGNS:
        steps = torch.tensor([-2.0, -1.0, 1.0, 2.0], dtype=torch.float64) * h
        moved = x[name] + steps.reshape(4, *[1] * (x[name].dim() - 1)) * along[name]
        wide = {other: moved if other == name else y.expand(4, *y.shape[1:]) for other, y in x.items()}
        y = tip(damping, wide, "native", "none")
        expected.append((8.0 * (y[2] - y[1]) - (y[3] - y[0])) / (12.0 * h))
    for by in result.values():
        assert_close(by, torch.stack(expected), rtol=1e-6, atol=1e-8)


@pytest.mark.thorough
def test_results_responses_and_pictures(tmp_path):
    beam = mbd.FlexibleBody.exact_beam("beam", mbd.BeamLine.straight(1.0, 3), SECTION, velocity=(1.0, 0, 0))
    system = mbd.System([beam], forces=[mbd.Force(beam.at(1), (0.0, 5.0, 0.0))], free=["beam"])
    motion = mbd.simulate(system, 0.1, steps=20, backend="eager")
    result = motion.body("beam")
    assert result.forces.shape == (1, 21, 3, 2, 6)
    assert_close(mbd.Mass("beam")(motion), torch.tensor([2.0], dtype=torch.float64))
    assert_close(mbd.Velocity("beam_2", "x")(motion)[0, 0], torch.tensor(1.0, dtype=torch.float64))
    assert_close(mbd.StrainEnergy("beam")(motion), motion.energies.strain)
    assert_close(mbd.Position("beam", "y", node="end")(motion), result.nodes[:, :, -1, 1])
    assert_close(mbd.Displacement("beam", "y", node="end")(motion), result.displacements[:, :, -1, 1])
    seen = mbd.Position("beam", "y", node="end", seen_from="beam")(motion)
    assert_close(seen, result.displacements[:, :, -1, 1])
    assert "freedoms    24" in str(system.describe())
    assert mbd.viz.animate(motion, tmp_path / "beam.html").stat().st_size > 0


def spinning(**options) -> mbd.results.Trajectory:
    """A free rod of one stiff element that turns by 0.1 rad in each of 60 steps."""
    section = given(1e6, 1e6, 1e6, 1.0, 1.0, 1.0, mass=matrix(1.0, 1.0, 1.0, 2e-3, 1e-3, 1e-3))
    state = {"velocity": (0.0, -0.5, 0.0), "angular_velocity": (0.0, 0.0, 1.0)}
    rod = mbd.FlexibleBeam("rod", mbd.BeamLine.straight(1.0, 1), section, (0, 1, 0), position=(-0.5, 0, 0), **state)
    return mbd.simulate(mbd.System([rod], free=["rod"]), 6.0, steps=60, backend="eager", **options)


@pytest.mark.thorough
def test_vibrations_that_steps_do_not_resolve():
    motion = spinning()
    assert motion.status == ["ok"]
    stored = motion.energies.stored[0]
    assert float((stored - stored[0]).abs().max()) < 0.01 * float(stored[0])
    with warned("sign"):
        wild = spinning(spectral_radius=0.9)
    assert float(wild.energies.stored.max()) > 1.5 * float(stored[0])
    assert wild.status[0].startswith("unresolved")


@pytest.mark.thorough
def test_vibrations_that_steps_do_not_resolve_in_phases():
    phases = [mbd.Phase(until=0.5), mbd.Phase()]
    assert spinning(phases=phases).status == ["ok"]
    with warned("sign"):
        wild = spinning(spectral_radius=0.9, phases=phases)
    assert float(wild.energies.stored.max()) > 1.5 * float(wild.energies.stored[0, 0])
    assert wild.status[0].startswith("unresolved")


@pytest.mark.thorough
@pytest.mark.parametrize("far", [0.0, 1000.0])
@pytest.mark.parametrize("phases", [None, [mbd.Phase(until=0.05), mbd.Phase()]])
def test_rounding_is_no_vibration(far, phases):
    """Of a stiff beam that starts at rest and stays: 1e-6 or 1e-3 m/s2 by rounded places."""
    stiff = given(2e9, 7e8, 7e8, 1e6, 1e6, 1e6, mass=matrix(10.0, 10.0, 10.0, 2e-3, 1e-3, 1e-3))
    beam = mbd.FlexibleBeam("beam", mbd.BeamLine.arc(1.0, 1.0, 4), stiff, position=(far, 0.0, 0.0))
    wall = mbd.Fixed(GROUND.at(far, 0.0, 0.0), beam.at("start"))
    system = mbd.System([beam], [wall], gravity=(0.0, 0.0, -9.81))
    motion = mbd.simulate(system, 0.1, steps=10, start="equilibrium", phases=phases, backend="eager")
    assert motion.status == ["ok"]


def test_refusals():
    line = mbd.BeamLine.straight(1.0, 3)
    bad = (matrix(1.0, 1, 1, 1, -1, 1), MASS)
    with refused("sections.0.5.stiffness.5.5", -1.0):
        mbd.SectionTable([0.0, 0.5, 1.0], [(SECTION.stiffness(), MASS), bad, (SECTION.stiffness(), MASS)])
    with refused("beam.line"):
        mbd.FlexibleBeam("beam", mbd.BeamLine(nn.Parameter(line.nodes.clone())), SECTION)
    beam = mbd.FlexibleBeam("beam", line, SECTION)
    with refused("node"):
        beam.at("middle")
    with refused("beam.node", 4):
        beam.at(4)
    other = mbd.RigidBody("other", 1.0, (1.0, 1.0, 1.0))
    with refused("bodies"):
        mbd.System([beam, other], [mbd.Fixed(GROUND.at(), other.at())])
    with refused("beam.damping"):
        mbd.FlexibleBeam("beam", line, SECTION, damping=-1.0)
