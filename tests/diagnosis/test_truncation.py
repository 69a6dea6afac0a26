"""What retained modes leave out of a body's flexibility at joints and forces, against full reductions and closed forms."""

from __future__ import annotations

import warnings

import pytest
import torch

import torchmbd as mbd
from tests.mechanisms import rigid_pendulum
from tests.refused import refused, warned
from torchmbd.diagnosis.truncation import StaticTruncation
from torchmbd.examples.two_link_arm import build

GROUND = mbd.Ground()
STEEL = mbd.GivenSection.isotropic(E=2.1e11, nu=0.3, density=7800.0, area=1e-4, Iyy=1e-9, Izz=1e-9, J=2e-9)


def beam(name: str = "beam", elements: int = 8, **options) -> mbd.FlexibleBody:
    options = {"modes": 2, "reference": "start"} | options
    return mbd.FlexibleBody.beam(name, mbd.BeamLine.straight(1.0, elements), STEEL, **options)


def cantilever(force=(0.0, 0.0, -1.0), body: mbd.FlexibleBody | None = None, **options) -> mbd.System:
    body = beam(**options) if body is None else body
    return mbd.System([body], [mbd.Fixed(GROUND.at(), body.at("start"))], [mbd.Force(body.at("end"), force)])


def arm(**options) -> mbd.System:
    """Two beams that bend in two planes and twist, a tool at the end."""
    upper, fore = beam("upper", **options), beam("fore", **options)
    tool = mbd.RigidBody("tool", 1.0, (1e-3, 1e-3, 1e-3))
    shoulder, elbow = (GROUND.at(), upper.at("start")), (upper.at("end"), fore.at("start"))
    joints = [
        mbd.Revolute(*shoulder, axis="z", name="s"),
        mbd.Drive(*shoulder, axis="z", angle=mbd.SmoothStep(1.0, 0.8), name="sd"),
        mbd.Revolute(*elbow, axis="y", name="e"),
        mbd.Drive(*elbow, axis="y", angle=mbd.SmoothStep(1.0, 0.8), name="ed"),
        mbd.Fixed(fore.at("end"), tool.at()),
    ]
    return mbd.System([upper, fore, tool], joints, gravity=(0.0, 0.0, -9.81))


def truncation(system: mbd.System) -> StaticTruncation:
    result = mbd.static_truncation(system)
    assert result is not None
    return result


def first(system: mbd.System) -> float:
    return min(f for f in system.describe().frequencies if f > 1e-3)


@pytest.mark.thorough
@pytest.mark.parametrize("options", [{"modes": 4}, {"modes": 6, "reference": None}, {"modes": 10, "reference": None}])
def test_the_frequency_without_truncation_is_that_of_craig_bampton(options):
    result = truncation(arm(**options))
    exact = first(arm(modes=4, reduction="craig-bampton", interface="end"))
    assert result.frequencies is not None
    assert result.frequencies[1] == pytest.approx(exact, rel=2e-3)
    assert result.frequencies[0] == pytest.approx(first(arm(**options)), rel=1e-6)
    assert result.share == pytest.approx(1.0 - (exact / result.frequencies[0]) ** 2, abs=5e-3)


@pytest.mark.thorough
@pytest.mark.parametrize("options", [{"modes": 0, "interface": "end"}, {"modes": 2, "interface": ["end", 4]}])
def test_nothing_is_left_out_of_interfaces(options):
    assert abs(truncation(arm(reduction="craig-bampton", **options)).share) < 1e-9
    assert abs(truncation(cantilever(reduction="craig-bampton", **options)).share) < 1e-9


@pytest.mark.parametrize(("modes", "left"), [(2, 0.0293), (4, 0.0046)])
def test_the_deflection_that_modes_of_a_cantilever_leave_out(modes, left):
    """1 - sum 12 / (b l)^4 over the modes, of a slender uniform beam under a force at its end: in both planes one mode each."""
    result = truncation(cantilever(modes=modes, elements=32))
    assert result.share == pytest.approx(left, abs=3e-4)
    assert (result.body, result.where, result.frequencies) == ("beam", "'end'", None)


def test_stretching_counts_beside_bending():
    """No mode stretches the beam: all of this deflection is left out, which is nothing beside that of bending."""
    assert truncation(cantilever((1.0, 0.0, 0.0))).share < 1e-3


@pytest.mark.thorough
def test_a_body_of_matrices_says_the_same():
    body = beam(modes=4)
    M, K = body.mass_and_stiffness()
    same = mbd.FlexibleBody.from_matrices("beam", M, K, body.mesh.nodes, 4, reference=0, node_sets=body.mesh.node_sets)
    one, other = (truncation(cantilever(body=x)) for x in (body, same))
    assert one.share == pytest.approx(other.share, rel=1e-4)


def test_nothing_is_known_of_rigid_bodies_and_of_those_reduced_elsewhere(tmp_path):
    body = mbd.FlexibleBody.from_reduced("beam", beam().save_reduced(tmp_path / "beam.npz"))
    assert mbd.static_truncation(cantilever(body=body)) is None
    assert mbd.static_truncation(rigid_pendulum()) is None


@pytest.mark.thorough
def test_the_first_motion_warns_and_says_what_is_better():
    """The measured case: 6 modes make an arm of 13.5 Hz one of 15.6 Hz."""
    system = build(modes=6)
    with warned("body 'upper' at 'left'", "13.5 Hz", "15.6 Hz") as caught:
        mbd.simulate(system, 0.01, steps=2, gradients="none")
    [said] = [str(x.message) for x in caught if "retained modes" in str(x.message)]
    assert "reduction=\"craig-bampton\" with interface=['left', 'right'], or more modes" in said
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mbd.simulate(system, 0.01, steps=2, gradients="none")


def test_a_system_warns_whatever_its_bodies_were_part_of_before():
    """And once, also with another start."""
    body = beam(modes=4)
    fixed = mbd.Fixed(GROUND.at(), body.at("start"))
    held = mbd.Fixed(GROUND.at(1.0, 0.0, 0.0), body.at("end"))

    def texts(joints: list[mbd.Fixed]) -> list[str]:
        system = mbd.System([body], joints)
        with warnings.catch_warnings(record=True) as seen:
            warnings.simplefilter("always")
            mbd.simulate(system, 1e-4, steps=2, gradients="none")
            mbd.equilibrium(system)
        return [str(x.message) for x in seen if "retained modes" in str(x.message)]

    assert texts([fixed]) == []
    assert len(texts([fixed, held])) == 1


@pytest.mark.thorough
def test_a_static_motion_warns():
    with warned("body 'beam' at 'start'", "9.09 Hz", "14.2 Hz"):
        mbd.equilibrium(cantilever(modes=1, reference=4))


@pytest.mark.thorough
@pytest.mark.filterwarnings("error:the retained modes")
@pytest.mark.parametrize("truncation", [None, 0.9])
def test_silent_on_request(truncation):
    body = beam(modes=1, reference=4)
    joint = mbd.Fixed(GROUND.at(), body.at("start"))
    system = mbd.System([body], [joint], [mbd.Force(body.at("end"), (0.0, 0.0, 1.0))], truncation=truncation)
    mbd.simulate(system, 0.001, steps=2, gradients="none")


@pytest.mark.parametrize("truncation", [0.0, -1.0, "much", float("nan")])
def test_a_wrong_limit_is_refused(truncation):
    with refused("truncation"):
        mbd.System([beam()], truncation=truncation)


@pytest.mark.thorough
def test_examples_are_silent():
    from torchmbd.examples.slider_crank import build as slider_crank

    for system in (mbd.examples.arm(), slider_crank(3, [30.0, -20.0, 50.0])):
        assert truncation(system).share < 0.05


@pytest.mark.thorough
def test_derivatives_of_a_motion_do_not_notice():
    """Inside transforms of torch.func."""
    system = mbd.examples.arm()
    angles = torch.zeros(2, dtype=torch.float64)

    def energy(x: torch.Tensor) -> torch.Tensor:
        motion = mbd.simulate(system, 0.01, steps=3, designs={"arm.laminate.angles": x})
        return mbd.Max(mbd.StrainEnergy("arm"))(motion)[0]

    assert torch.func.vmap(torch.func.grad(energy))(angles[None] + 0.3).isfinite().all()


@pytest.mark.parametrize("hung", [False, True])
def test_modes_that_the_joints_hold_leave_out_everything(hung):
    body = beam(modes=4)  # as many as the joint at the other end fixes
    joints = [mbd.Fixed(GROUND.at(), body.at("start")), mbd.Fixed(GROUND.at(1.0, 0.0, 0.0), body.at("end"))]
    bodies: list = [body]
    if hung:
        bodies.append(mbd.RigidBody("weight", 1.0, (1.0, 1.0, 1.0), position=(0.5, 0.0, -1.0)))
        joints.append(mbd.Revolute(body.at("center"), bodies[1].at(0.0, 0.0, 1.0), axis="y"))
    system = mbd.System(bodies, joints, [mbd.Force(body.at("center"), (0.0, 0.0, -1.0))])
    result = truncation(system)
    assert (result.share, result.rigid, result.body) == (1.0, True, "beam")
    with pytest.warns(UserWarning, match="all flexibility of body 'beam'"):
        mbd.simulate(system, 0.01, steps=2)
