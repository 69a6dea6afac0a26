"""Arguments of simulate: what it refuses, its defaults, lanes, and the trajectory that it returns."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import SOFT, box, laminate, pendulum, plate, rigid_pendulum, tensor, turned
from tests.refused import refused, warned
from torchmbd.errors import InputError
from torchmbd.integrate.step_count import all_modes
from torchmbd.integrate.stepper import PRECISE


@pytest.fixture(scope="module")
def system() -> mbd.System:
    return pendulum()


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"duration": 0.0}, ["duration", "0.0 s", "positive"]),
        ({"duration": -1.0}, ["duration", "-1.0 s", "positive"]),
        ({"duration": math.inf}, ["duration", "inf", "positive"]),
        ({"duration": math.nan}, ["duration", "nan", "positive"]),
        ({"duration": "1"}, ["duration", "'1'", "positive"]),
        ({"duration": True}, ["duration", "True", "positive"]),
        ({"variables": "rod.laminate.angles"}, ["variables", "'rod.laminate.angles'", "a list of names"]),
        ({"variables": 1}, ["variables", "1", "a list of names"]),
        ({"gradients": "adjoint"}, ["gradients", "'adjoint'", "auto, forward, reverse, none"]),
        ({"gradients": "reverse", "method": "rk4"}, ["gradients = 'reverse'", "method is 'rk4'", "'forward'"]),
        (
            {"gradients": "reverse", "phases": [mbd.Phase()], "method": "dopri5"},
            ["gradients = 'reverse'", "method is 'dopri5'", "'generalized_alpha'", "'forward'"],
        ),
        ({"steps": 0}, ["steps", "0", "positive integer"]),
        ({"steps": 10.0}, ["steps", "10.0", "positive integer"]),
        ({"steps": True}, ["steps", "True", "positive integer"]),
        ({"method": "dopri6"}, ["method = 'dopri6'", "Try: 'dopri"]),
        ({"method": "scipy_solver"}, ["method 'scipy_solver'", "reverse mode"]),
        (
            {"gradients": "forward", "variables": ["rod.laminate.angle"]},
            ["'rod.laminate.angle'", "Try: 'rod.laminate.angles'"],
        ),
        ({"designs": {"rod.angles": torch.zeros(1, 2)}}, ["'rod.angles'", "Try: 'rod.laminate.angles'"]),
        ({"designs": {"rod.laminate.angles": torch.zeros(1, 3)}}, ["rod.laminate.angles", "(1, 3)", "[lanes, 2]"]),
        (
            {"designs": {"rod.laminate.thickness": torch.tensor([[1e-3, 1e-3], [1e-3, 0.0]]).double()}},
            ["lane 1", "positive"],
        ),
        ({"spectral_radius": 1.1}, ["spectral_radius", "1.1", "0 (strong damping) to 1 (none)"]),
        ({"spectral_radius": math.nan}, ["spectral_radius", "nan", "0 (strong damping) to 1 (none)"]),
        ({"iterations": (3, 0)}, ["iterations", "(3, 0)", "two positive integers"]),
        ({"iterations": 3}, ["iterations", "3", "two positive integers"]),
        ({"refresh": -1}, ["refresh", "-1", "number of steps"]),
        ({"refresh": 1.5}, ["refresh", "1.5", "number of steps"]),
        ({"rtol": 1e-6}, ["rtol = 1e-06 is not an option", "spectral_radius", "iterations", "refresh"]),
        ({"method": "rk4", "refresh": 2}, ["refresh = 2 is not an option", "rtol", "atol", "options"]),
        ({"method": "dopri5", "rtol": -1e-6}, ["rtol", "-1e-06", "positive"]),
        ({"method": "dopri5", "atol": math.nan}, ["atol", "nan", "positive"]),
    ],
    ids=lambda x: "-".join(f"{k}={v}" for k, v in x.items()) if isinstance(x, dict) else "",
)
def test_bad_input_is_named_with_its_value_and_what_is_allowed(system, given, words):
    with pytest.raises(InputError) as error:
        mbd.simulate(system, **({"duration": 0.01, "steps": 2} | given))
    for word in words:
        assert word in str(error.value)
    assert error.value.allowed or error.value.hint


@pytest.mark.thorough
def test_numbers_of_numpy_are_numbers(system):
    plain, given = mbd.simulate(system, 0.25, steps=40), mbd.simulate(system, np.float32(0.25), steps=np.int64(40))
    assert_close(plain.q, given.q, rtol=0, atol=0)
    assert type(given.stats["steps"]) is int


@pytest.mark.thorough
def test_a_system_of_other_numbers_is_refused():
    with refused("rod.laminate.angles"):
        mbd.simulate(pendulum().float(), 0.01, steps=1)
    system = pendulum()
    with torch.no_grad():
        system.get_parameter("rod.laminate.angles")[1] = math.nan
    with refused("rod.laminate.angles"):
        mbd.simulate(system, 0.01, steps=1)


@pytest.mark.thorough
def test_designs_of_different_numbers_of_lanes_are_refused():
    system = mbd.System([plate("one"), plate("two", made_of=laminate((10.0, 80.0)))])
    designs = {"one.laminate.angles": mbd.deg(torch.ones(2, 3)), "two.laminate.angles": mbd.deg(torch.ones(3, 2))}
    with refused("designs"):
        mbd.simulate(system, 0.01, steps=1, designs=designs)


def test_sensitivities_of_a_system_without_parameters_are_refused():
    with refused("gradients", "forward"):
        mbd.simulate(rigid_pendulum(), 0.01, steps=1, gradients="forward")


@pytest.mark.thorough
def test_at_most_twenty_steps_in_a_period_of_the_fastest_mode():
    """Of the stiffest design; a rigid mechanism takes 1000 steps."""
    system = mbd.System([plate("rod", modes=2), plate("soft", modes=3, made_of=laminate(ply=SOFT))])
    fastest = float(torch.linalg.eigvalsh(system.body("rod").structure()["Kr"].detach()).max()) ** 0.5
    assert all_modes(system.dynamics(), 30 * 2 * math.pi / fastest) == pytest.approx(600, abs=1)
    assert all_modes(system.dynamics(), 2 * 2 * math.pi / fastest) == 200
    assert mbd.simulate(mbd.System([box("free")]), 0.1, iterations=(1, 1)).stats["steps"] == 1000


@pytest.mark.thorough
def test_steps_see_every_lane():
    """The first lane is soft, the second stiff: steps chosen by the first would be too long for the second."""
    system = mbd.System([plate("rod", modes=2)])
    thickness = torch.tensor([[1e-3] * 3, [8e-3] * 3], dtype=torch.float64)
    steps = [all_modes(system.dynamics({"rod.laminate.thickness": x}), 0.1) for x in (thickness, thickness.flip(0))]
    assert steps[0] == steps[1] > 2 * all_modes(system.dynamics({"rod.laminate.thickness": thickness[:1]}), 0.1)


@pytest.mark.thorough
def test_lanes_come_first_and_are_the_designs(system):
    angles = mbd.deg([[20.0, -50.0], [10.0, 70.0]])
    motion = mbd.simulate(system, 0.01, steps=5, designs={"rod.laminate.angles": angles}, gradients="forward")
    T = system.topology
    assert motion.q.shape == (2, 6, T.n_q)
    assert motion.v.shape == motion.a.shape == (2, 6, T.n_v)
    assert motion.lam.shape == (2, 6, T.rows)
    assert motion.dq_db.shape == (2, 6, T.n_q, 2)
    assert motion.dv_db.shape == (2, 6, T.n_v, 2)
    assert motion.parameters == ("rod.laminate.angles[0]", "rod.laminate.angles[1]")
    assert_close(motion.designs["rod.laminate.angles"], angles)
    for lane in range(2):
        alone = mbd.simulate(system, 0.01, steps=5, designs={"rod.laminate.angles": angles[lane : lane + 1]})
        arm = [
            (m.body("arm").r, m.body("arm").A, m.body("rod").nodes, m.body("rod").strain_energy)
            for m in (motion, alone)
        ]
        for both, one in zip(*arm, strict=True):
            assert_close(both[lane], one[0], rtol=1e-7, atol=1e-10)


def test_a_motion_without_sensitivities_says_so(system):
    motion = mbd.simulate(system, 0.01, steps=2, gradients="none")
    assert motion.dq_db is None
    assert motion.dv_db is None
    assert motion.body("rod").dw_db is None
    with refused("motion"):
        mbd.Integral(mbd.StrainEnergy("rod")).value_and_gradient(motion)


@pytest.fixture(scope="module")
def motion(system) -> mbd.Trajectory:
    return mbd.simulate(system, 0.02, steps=20)


def test_views_of_a_rigid_body(motion):
    arm = motion.body("arm")
    hinge = tensor(0.1, 0.05, -0.02)
    assert_close(arm.r, hinge.expand(1, 21, 3), rtol=0, atol=1e-12)
    assert_close(arm.A.mT @ arm.A, torch.eye(3, dtype=torch.float64).expand(1, 21, 3, 3), rtol=0, atol=1e-12)
    assert arm.mesh is None
    for name in ("w", "wd", "strain_energy", "displacements", "nodes", "psi", "stiffness", "dw_db"):
        with refused("body", "arm"):
            getattr(arm, name)
    with refused("body", "am", meant="arm"):
        motion.body("am")


def test_nodes_of_the_deformed_mesh_hang_together_with_the_joints(motion, system):
    """The node that carries the joint moves with the point of the other body."""
    rod, arm, body = motion.body("rod"), motion.body("arm"), system.body("rod")
    tip = arm.r + torch.einsum("ltij,j->lti", arm.A, tensor(0.2, 0.1, -0.05))
    assert_close(rod.nodes[:, :, body.mesh.node("left")], tip, rtol=0, atol=1e-9)
    assert rod.displacements[:, :, body.reference].abs().max() == 0
    assert rod.displacements[:, -1].abs().max() > 1e-5
    local = torch.einsum("ltji,ltnj->ltni", rod.A, rod.nodes - rod.r[:, :, None]) - rod.displacements
    assert_close(local, (body.mesh.nodes - body.origin).expand_as(local), rtol=0, atol=1e-12)


def test_rates_are_derivatives_of_the_coordinates(motion):
    """w' by central differences of w; a rate of another body or mode would not fit."""
    rod, h = motion.body("rod"), motion.t[1]
    slope = (rod.w[:, 2:] - rod.w[:, :-2]) / (2 * h)
    assert_close(rod.wd[:, 1:-1], slope, rtol=0, atol=2e-2 * float(rod.wd.abs().max()))


def test_strain_energy_is_that_of_the_finite_elements(motion, system):
    """1/2 u' K u of the whole mesh, without modes."""
    body = system.body("rod")
    K = body.matrices.stiffness(body.laminate.entries().detach()).dense()
    u = torch.einsum("lnim,ltm->ltni", motion.body("rod").psi, motion.body("rod").w).flatten(2)
    assert_close(motion.body("rod").strain_energy, 0.5 * torch.einsum("lti,ij,ltj->lt", u, K, u), rtol=1e-9, atol=1e-15)


@pytest.mark.thorough
def test_steps_are_corrected_until_they_are_precise_and_lanes_that_fail_are_tried_again():
    """By further corrections in a step, each with a new matrix; where these do not lead there, with half the step."""
    from torchmbd.examples.slider_crank import build

    system = build(3, cells=(6, 2), modes=4)
    designs = {"rod.laminate.angles": mbd.deg([[0, 0, 0], [90, 60, 90]])}

    def run(steps: int, **options) -> mbd.Trajectory:
        return mbd.simulate(system, 0.024, designs=designs, steps=steps, **options)

    corrected, often = run(3, halvings=0), run(3, refresh=0, iterations=(12, 2), halvings=0)
    assert not any(status.startswith("failed") for status in corrected.status)
    assert "failed_first" not in corrected.stats
    assert float(corrected.stats["further_corrections"].min()) > 0.0
    assert float(corrected.stats["iteration_error"].max()) <= PRECISE
    error = (corrected.a - often.a).abs().amax((1, 2)) / often.a.abs().amax((1, 2))
    assert float(error.max()) <= 10.0 * PRECISE
    coarse, cured, fine = run(2, halvings=0), run(2), run(4, refresh=0, iterations=(8, 2))
    assert all(status.startswith("failed") for status in coarse.status)
    assert not any(status.startswith("failed") for status in cured.status)
    assert (cured.stats["renewed"], cured.stats["halved"]) == ([], [0, 1])
    assert_close(cured.q, fine.q[:, ::2], rtol=1e-9, atol=1e-12)
    assert_close(cured.lam, fine.lam[:, ::2], rtol=1e-6, atol=1e-6 * float(fine.lam.abs().max()))


@pytest.mark.thorough
def test_a_system_at_rest_stays_there():
    """Nothing but rounding moves: that is no failure of the iteration."""
    ground, left, right = mbd.Ground(), plate("left", position=(0.15, 0, 0)), plate("right", position=(0.45, 0, 0))
    joints = [mbd.Spherical(ground.at(), left.at("left")), mbd.Spherical(left.at("right"), right.at("left"))]
    motion = mbd.simulate(mbd.System([left, right], joints), 0.01, steps=10, halvings=0)
    motion.require_ok()
    assert float(motion.v.abs().max()) < 1e-9


@pytest.mark.thorough
def test_steps_that_do_not_resolve_the_vibrations_are_reported():
    """And the number of steps that is suggested does."""
    from torchmbd.examples.slider_crank import build

    system = build(1, [0.0], cells=(6, 2), modes=4)
    with warned("vibrations"):
        coarse = mbd.simulate(system, 0.024, steps=12)
    suggested = int(coarse.stats["suggested_steps"][0])
    assert 100 < suggested < 1000
    assert coarse.status[0].startswith("unresolved: the steps do not resolve the vibrations")
    assert f"{suggested} steps" in coarse.status[0]
    assert bool(torch.isfinite(coarse.q).all())
    fine = mbd.simulate(system, 0.024, steps=suggested)
    assert float(fine.stats["step_error"][0]) < 0.02
    assert fine.ok


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore:the steps do not resolve")
@pytest.mark.usefixtures("compiled")
def test_motions_that_are_not_resolved_are_no_evaluations_of_a_problem():
    """With 5 steps the estimated error is several hundred per cent: a criterion of it is none."""
    from torchmbd.examples.slider_crank import build

    system = build(1, [0.0], cells=(6, 2), modes=4)
    energy = mbd.Integral(mbd.StrainEnergy("rod"))
    coarse, fine = (mbd.Problem(system, 0.024, energy, bounds=mbd.deg([-90, 90]), steps=steps) for steps in (8, 300))
    (bad,), (good,) = (problem.evaluate(problem.start[None], True) for problem in (coarse, fine))
    assert bad.status.startswith("unresolved")
    assert not bad.ok
    assert math.isnan(bad.objective)
    assert good.ok
    assert mbd.optimize(coarse, "slsqp", max_iterations=2).status == "failed"


@pytest.mark.thorough
@pytest.mark.parametrize("phases", [None, [mbd.Phase(until=0.018), mbd.Phase()]])
@pytest.mark.filterwarnings("ignore:the steps do not resolve")
def test_after_its_failure_a_lane_has_no_numbers(phases):
    """Every signal, view and energy is nan from there on, that of a driven crank too, and finite before."""
    from torchmbd.examples.slider_crank import build

    system = build(3, cells=(6, 2), modes=4)
    designs = {"rod.laminate.angles": mbd.deg([[0, 0, 0], [90, 60, 90]])}
    options = {"halvings": 0} if phases is None else {"halvings": 0, "refresh": 0, "phases": phases}
    motion = mbd.simulate(
        system, 0.024, designs=designs, steps=2, gradients="forward", variables=list(designs), **options
    )
    assert all(status.startswith("failed") for status in motion.status)
    signals = (motion.q, motion.v, motion.a, motion.lam, motion.dq_db, motion.dv_db, motion.da_db, motion.dlam_db)
    crank, rod = motion.body("crank"), motion.body("rod")
    views = (crank.r, crank.A, crank.omega, rod.nodes, rod.displacements, rod.w, rod.dw_db, rod.strain_energy)
    e = motion.energies
    works = (e.kinetic, e.strain, e.potential)
    for lane in range(2):
        known = torch.isfinite(motion.q[lane]).all(1)
        end = int(known.sum())
        assert 1 <= end < 3
        assert bool(known[:end].all())
        for x in (*signals, *views, *works):
            assert x is not None
            assert bool(torch.isfinite(x[lane, :end]).all())
            assert bool(x[lane, end:].isnan().all())
    if phases is None:  # each lane is cut where its own last steps fail
        assert torch.isfinite(motion.q).all(2).sum(1).tolist() == [2, 2]


@pytest.mark.thorough
def test_a_body_at_rest_on_long_arms_stays_there():
    """Nothing moves but the rounding of the joint's equations, which the arms enlarge."""
    rod = plate("rod", 3, made_of=laminate(ply=SOFT), position=(0.3, -0.4, 0.2), axes=turned(0.4, -1.1, 0.6))
    arm = tensor(0.25, -0.3, 0.4)
    place = rod.position + rod.axes @ (tensor(0.15, 0.0, 0.0) + arm)
    joint = mbd.Fixed(rod.at("right", offset=arm), mbd.Ground().at(*place.tolist()))
    motion = mbd.simulate(mbd.System([rod], [joint]), 0.04, steps=200)
    assert motion.status == ["ok"]
    assert float((motion.q - motion.q[:, :1]).abs().max()) < 1e-10


@pytest.mark.thorough
def test_a_motion_that_leaves_has_failed():
    """A damper of the wrong sign: 1e38 m with the status ok; a body at the speed of a satellite is a motion."""
    body = mbd.RigidBody("mass", 1.0, (0.01,) * 3, position=(1e-3, 0.0, 0.0))
    damper = mbd.AxialSpringDamper(mbd.Ground().at(), body.at(), axis="x", stiffness=1.0, damping=-1e3)
    system = mbd.System([body], [], [damper], free=["mass"])
    motion = mbd.simulate(system, 0.1, steps=100, gradients="none")
    assert motion.status[0].startswith("failed: from t = 0.03")
    assert "1e+13 times the size of the mechanism away" in motion.status[0]
    assert not bool(torch.isfinite(motion.q[0, -1]).any())
    assert float(motion.q[0, 25, 0].abs()) < 3e8
    orbit = mbd.System(
        [mbd.RigidBody("probe", 1.0, (0.01,) * 3, position=(1e11, 0, 0), velocity=(0, 3e4, 0))], free=["probe"]
    )
    mbd.simulate(orbit, 1e5, steps=20, gradients="none").require_ok()
    shot = mbd.System(  # 400 m/s in micrometers
        [mbd.RigidBody("shot", 1.0, (1e10,) * 3, position=(0, 0, 0), velocity=(4e8, 0, 0))], free=["shot"]
    )
    mbd.simulate(shot, 0.1, steps=20, gradients="none").require_ok()
