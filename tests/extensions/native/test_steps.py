"""Compiled steps: the same numbers as the eager route, for any mechanism."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from typing import Any

import pytest
import torch

import torchmbd as mbd
from tests.integrate.phases.test_phase import pushed
from tests.mechanisms import box, pendulum, rigid_pendulum, spoilt, sprung
from tests.multibody.start.test_initial import four_bar
from tests.sensitivity.adjoint_cases import strung
from tests.sensitivity.test_law_variables import arm
from torchmbd.examples.slider_crank import build
from torchmbd.extensions.native import steps
from torchmbd.integrate.stepper import EagerStepper

pytestmark = pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler")
ANGLES = mbd.deg([[30, -20, 50], [10, 40, -70], [-15, 80, 5]])
NAME = "rod.laminate.angles"


Both = Callable[..., tuple[mbd.Trajectory, mbd.Trajectory]]


@pytest.fixture
def both(native: None) -> Both:
    """The eager and the compiled motion of `simulate` with its arguments."""

    def motions(*arguments: Any, **options: Any) -> tuple[mbd.Trajectory, mbd.Trajectory]:
        eager, fast = (mbd.simulate(*arguments, backend=backend, **options) for backend in ("eager", "native"))
        assert (eager.stats["backend"], fast.stats["backend"]) == ("eager", "native")
        return eager, fast

    return motions


def weightless() -> mbd.System:
    """An arm that carries a point mass."""
    arm = box("arm")
    link = mbd.RigidBody("link", mass=0.1, inertia=(0.0, 0.0, 0.0), position=(0.15, 0.0, 0.0))
    joints = [mbd.Spherical(mbd.Ground().at(), arm.at()), mbd.Fixed(arm.at(0.15, 0.0, 0.0), link.at())]
    return mbd.System([arm, link], joints, gravity=(0.0, -9.81, 0.0))


def same(eager: mbd.Trajectory, fast: mbd.Trajectory, q: float = 1e-10, dq: float = 1e-8) -> None:
    assert fast.status == eager.status
    torch.testing.assert_close(fast.q, eager.q, rtol=0, atol=q)
    if eager.stats["gradients"] == "forward" and eager.dq_db is not None and eager.dq_db.numel():
        assert fast.dq_db is not None
        assert float((fast.dq_db - eager.dq_db).abs().max()) < dq * float(eager.dq_db.abs().max())


@pytest.mark.thorough
@pytest.mark.parametrize("lanes", [1, 3])
@pytest.mark.parametrize("iterations", [(3, 1), (1, 1), (2, 2)])
def test_compiled_and_eager_agree(both: Both, lanes: int, iterations: tuple[int, int]) -> None:
    system, designs = build(3, cells=(6, 2), modes=3), {NAME: ANGLES[:lanes]}
    eager, fast = both(system, 0.003, steps=60, gradients="forward", designs=designs, iterations=iterations)
    same(eager, fast)
    for name in ("iteration_error", "tangent_error"):
        torch.testing.assert_close(fast.stats[name], eager.stats[name], rtol=0.1, atol=1e-10)


@pytest.mark.thorough
def test_values_alone_and_more_lanes_than_a_block(both: Both) -> None:
    designs = {NAME: ANGLES[:1] + torch.linspace(0.0, 0.5, 11, dtype=torch.float64)[:, None]}
    same(*both(build(3, cells=(6, 2), modes=3), 0.002, steps=30, designs=designs, refresh=3))


@pytest.mark.thorough
def test_a_lane_that_fails_leaves_the_others_alone(both: Both, monkeypatch: pytest.MonkeyPatch) -> None:
    """A nan in the data of one lane."""
    system = build(3, cells=(6, 2), modes=3)
    spoilt(system, monkeypatch)
    eager, fast = both(system, 0.00075, steps=15, gradients="forward", designs={NAME: ANGLES})
    assert [x == "ok" for x in fast.status] == [x == "ok" for x in eager.status] == [True, False, True]
    torch.testing.assert_close(fast.q[[0, 2]], eager.q[[0, 2]], rtol=0, atol=1e-10)


@pytest.mark.thorough
def test_a_body_without_inertia_goes_the_eager_way(both: Both) -> None:
    """Its pivots are zero: the compiled factorization finds out and hands over."""
    same(*both(weightless(), 0.02, steps=20))


@pytest.mark.thorough
def test_forces_are_compiled(both: Both) -> None:
    system = sprung()
    angles = system.body("rod").laminate.angles.detach()
    designs = {NAME: angles + torch.tensor([[0.0], [0.2]], dtype=torch.float64)}
    same(*both(system, 0.01, steps=20, gradients="forward", designs=designs))


@pytest.mark.thorough
def test_laws_of_the_user_are_compiled(both: Both) -> None:
    """With branches and time in them, without slopes of their own."""
    stiffness = 2.0

    def law(s: torch.Tensor, rate: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        return torch.where(s > 0.05, -stiffness * torch.tanh(s), -s) - 0.01 * rate + 0.3 * torch.sin(40.0 * t)

    system = sprung(law)
    designs = {NAME: system.body("rod").laminate.angles.detach() + torch.tensor([[0.0], [0.2]], dtype=torch.float64)}
    same(*both(system, 0.01, steps=20, gradients="forward", designs=designs))


@pytest.mark.thorough
def test_redundant_rows_are_compiled(both: Both) -> None:
    system = four_bar()
    assert system.dynamics().condensed().redundant
    for refresh in (1, 0):
        same(*both(system, 0.02, steps=40, refresh=refresh), q=1e-8)


@pytest.mark.thorough
def test_phases_are_compiled(both: Both) -> None:
    phases = [mbd.Phase(until=0.0233), mbd.Phase(release=["motor"])]
    same(*both(pushed(0.7), 0.06, steps=60, phases=phases))


@pytest.mark.thorough
@pytest.mark.parametrize("gradients", [False, True])
def test_the_right_hand_side_is_compiled(both: Both, gradients: bool) -> None:
    """Methods of torchdiffeq: more lanes than a block, forces, and drives with laws."""
    system = sprung()
    designs = {NAME: system.body("rod").laminate.angles.detach() + 0.02 * torch.arange(9, dtype=torch.float64)[:, None]}
    options = {"gradients": "forward" if gradients else "none", "designs": designs}
    same(*both(system, 2e-4, "rk4", 20, **options))


@pytest.mark.thorough
def test_the_right_hand_side_of_a_driven_mechanism(both: Both) -> None:
    system = build(3, cells=(6, 2), modes=2)
    eager, fast = both(system, 5e-4, "dopri5", 4, rtol=1e-6, atol=1e-8, designs={NAME: ANGLES})
    same(eager, fast)
    assert fast.stats["evaluations"] == eager.stats["evaluations"]


@pytest.mark.thorough
def test_a_right_hand_side_without_inertia_stays_eager(both: Both) -> None:
    same(*both(weightless(), 1e-3, "rk4", 5))


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["generalized_alpha", "rk4"])
def test_rigid_systems_are_compiled(both: Both, method: str) -> None:
    same(*both(rigid_pendulum(), 0.002, method, 10))


@pytest.mark.thorough
@pytest.mark.parametrize("refresh", [1, 0])
def test_drives_with_design_variables_are_compiled(both: Both, refresh: int) -> None:
    """What they prescribe differs from lane to lane and step to step, with its tangents."""
    system = arm("step")
    designs = {"motor.size": torch.tensor([0.5, 0.3, -0.2], dtype=torch.float64)}
    variables = ["motor.size", "motor.duration", "rod.laminate.angles"]
    options = {"steps": 20, "designs": designs, "gradients": "forward", "variables": variables, "refresh": refresh}
    same(*both(system, 0.05, **options))
    same(*both(system, 0.05, steps=20, designs=designs, refresh=refresh))


@pytest.mark.thorough
def test_forces_with_design_variables_are_compiled(both: Both) -> None:
    system = strung()
    names = ["cord.stiffness", "cord.damping", "coil.factor", "push.x", "twist.factor"]
    designs = {"cord.damping": torch.tensor([0.3, 0.1], dtype=torch.float64)}
    eager, fast = both(system, 0.2, steps=20, designs=designs, gradients="forward", variables=names)
    same(eager, fast)
    assert eager.dq_db is not None
    assert float(eager.dq_db.abs().amax((0, 1, 2)).min()) > 1e-6


@pytest.mark.thorough
def test_steps_that_count_for_nothing_leave_the_same_numbers_in_every_batch(
    native: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three designs and four, which fill a block: operators of torch go on by the scale before these steps."""
    make, run, scales = steps.make_steps, EagerStepper.run, []
    monkeypatch.setattr(steps, "make_steps", lambda *arguments: make(*arguments) or 1)
    monkeypatch.setattr(
        EagerStepper, "run", lambda stepper, *arguments: scales.append(stepper.scale) or run(stepper, *arguments)
    )
    system, angles = pendulum(), torch.linspace(0.0, 1.0, 8, dtype=torch.float64).reshape(4, 2)
    for lanes in (3, 4):
        designs = {NAME: angles[:lanes]}
        mbd.simulate(system, 0.01, steps=10, backend="native", gradients="none", designs=designs)
    torch.testing.assert_close(scales[1][:3], scales[0])
