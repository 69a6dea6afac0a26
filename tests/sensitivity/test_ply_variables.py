"""Numbers of plies and of sections of metal as design variables."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import plate
from tests.refused import refused
from tests.sensitivity.number_cases import beam, check, check_native, hung, number, ply
from torchmbd.fem.elements import Plates

pytestmark = pytest.mark.usefixtures("compiled")

V = mbd.variable
MODULI = ("E1", "E2", "G12", "G13", "G23", "nu12", "density")


def varied() -> mbd.Ply:
    """A ply all of whose numbers vary."""
    fixed = ply()
    strength = mbd.Strength(*(V(x) for x in (2e6, 1.2e6, 5e4, 2e5, 7e4)), interaction=V(-0.4))
    return mbd.Ply(**{name: V(getattr(fixed, name)) for name in MODULI}, strength=strength)


def laminated() -> mbd.System:
    stack = mbd.Laminate([varied(), ply(strength=mbd.Strength(*[1e9] * 5))], mbd.deg([20, -50]), 2e-3)
    return hung(plate("rod", 3, made_of=stack))


def sectioned() -> mbd.System:
    section = mbd.sections.strip(0.02, varied(), mbd.deg([20, -50]), 2e-3, cells=(4, 1))
    return hung(beam(section, modes=4), "start")  # with the pair behind them E2 hardly matters


def metal() -> mbd.System:
    numbers = {"E": 7e9, "nu": 0.3, "density": 2700.0, "area": 4e-5, "Iyy": 1e-10, "Izz": 2e-10, "J": 2.5e-10}
    section = mbd.GivenSection.isotropic(**{name: V(x) for name, x in numbers.items()})
    bent = mbd.BeamLine([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.2, 0.05, 0.0], [0.25, 0.1, 0.05], [0.3, 0.1, 0.1]])
    return hung(beam(section, line=bent), "start")


def failing(system: mbd.System, designs: dict[str, Tensor], **options) -> Tensor:
    """With the failure index."""
    motion = mbd.simulate(system, 0.02, steps=6, iterations=(8, 4), designs=designs, **options)
    return sum((mbd.Mean(mbd.PlyFailure("rod", rule))(motion) for rule in ("tsai_wu", "max_stress")), torch.zeros(()))


CASES = {"laminate": laminated, "section": sectioned, "metal": metal}


def names_of(system: mbd.System, part: str) -> list[str]:
    return [name for name, x in system.named_parameters() if part in name and x.requires_grad and "angles" not in name]


def test_their_names():
    strengths = [f"strength.{x}" for x in ("Xt", "Xc", "Yt", "Yc", "S12", "interaction")]
    assert names_of(laminated(), "ply") == [f"rod.laminate.ply0.{x}" for x in (*MODULI, *strengths)]
    assert names_of(sectioned(), "ply") == [f"rod.section.ply.{x}" for x in (*MODULI, *strengths)]
    assert names_of(metal(), "section")[:2] == ["rod.section.E", "rod.section.nu"]


@pytest.mark.thorough
@pytest.mark.parametrize("case", CASES)
def test_gradients(case):
    system = CASES[case]()
    names = [name for name in names_of(system, "rod.") if "strength" not in name]
    check(system, names, steps=dict.fromkeys([name for name in names if "nu" in name], 2e-2))


@pytest.mark.thorough
@pytest.mark.parametrize("case", ["laminate", "section"])
def test_gradients_of_the_failure_index(case):
    system = CASES[case]()
    names = [name for name in names_of(system, "ply") if name.endswith(("E1", "Yt", "S12", "density"))]
    check(system, names, failing, steps=dict.fromkeys(names, 1e-4))  # the point nearest to failure stays what it is


@pytest.mark.thorough
def test_both_backends(native):
    system = laminated()
    check_native(system, [name for name in names_of(system, "ply") if "strength" not in name])


def test_closed_forms():
    """Mass grows with the density, all frequencies with the root of all moduli."""
    rod = hung(beam(mbd.GivenSection.isotropic(V(7e9), 0.3, V(2700.0), 4e-5, 1e-10, 2e-10, 2.5e-10)), "start")
    motion = mbd.simulate(rod, 0.01, steps=2)
    mass, first = mbd.Mass()(motion), mbd.Frequency("rod")(motion)
    E, density = (rod.get_parameter(f"rod.section.{x}") for x in ("E", "density"))
    (by,) = torch.autograd.grad(mass.sum(), density, retain_graph=True)
    assert_close(by * density, mass[0], rtol=1e-12, atol=0)
    by = torch.autograd.grad(first.sum(), (E, density))
    assert_close(by[0] * E, 0.5 * first[0], rtol=1e-8, atol=0)
    assert_close(by[1] * density, -0.5 * first[0], rtol=1e-8, atol=0)


@pytest.mark.thorough
def test_a_shared_ply_is_one_variable_and_zones_with_it_stay_apart():
    one = ply(E1=V(1e8))
    two = [mbd.Laminate(one, mbd.deg([angle]), 3e-3) for angle in (0, 40)]
    mesh = mbd.mesh.rectangle(length=0.3, width=0.1, cells=(4, 2))
    halves = {
        name: Plates(mesh, own, cells=list(range(4 * k, 4 * k + 4)))
        for k, (name, own) in enumerate(zip("ab", two, strict=True))
    }
    system = hung(mbd.FlexibleBody("rod", mesh, halves, 3))
    assert names_of(system, "ply") == ["rod.a.ply.E1"]
    check(system, ["rod.a.ply.E1", "rod.b.angles"])


@pytest.mark.thorough
def test_a_problem_with_bounds():
    system = laminated()
    name = "rod.laminate.ply0.E1"
    problem = mbd.Problem(
        system,
        0.02,
        mbd.Integral(mbd.StrainEnergy("rod")),
        steps=6,
        variables=[name],
        bounds={name: (5e7, 2e8)},
        subject_to=[mbd.Frequency("rod") <= 100.0],
    )
    result = mbd.optimize(problem, method="slsqp", max_iterations=3)
    assert 5e7 <= float(result.x[0]) <= 2e8
    assert result.value < problem.evaluate(problem.start[None], False)[0].objective


def test_what_is_refused():
    with refused("E1"):
        ply(E1=torch.nn.Parameter(torch.ones(2, dtype=torch.float64)))
    with refused("E1", -1.0):
        ply(E1=V(-1.0))
    with refused("E", -1.0):
        mbd.Ply.isotropic(V(-1.0), 0.3, 2700.0)
    system = laminated()
    with refused("rod.laminate.ply0.E1"):
        number(system, {"rod.laminate.ply0.E1": torch.tensor([1e8, -1.0], dtype=torch.float64)})
