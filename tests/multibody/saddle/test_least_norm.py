"""Multipliers of redundant rows: of least norm whatever the iteration, the route and the phase, with their derivatives."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import GRAVITY, tensor, turned
from torchmbd.multibody.equations.equations import placement, split_q
from torchmbd.results.reaction import frame_axes

AXES = turned(0.3, 0.5, -0.2)


def place(*point: float) -> tuple[float, float, float]:
    x, y, z = (AXES @ tensor(*point)).tolist()
    return x, y, z


def doors(angle: mbd.Sine | None = None) -> mbd.System:
    """A folding door, each leaf on two hinges: ten redundant rows. With an angle the first leaf is driven, and condensed."""
    ground = mbd.Ground()
    leaf: dict[str, Any] = {"mass": 0.7, "inertia": (3e-3, 2e-3, 2.5e-3), "axes": AXES}
    a = mbd.RigidBody("a", center=(0.2, 0.1, 0.0), **leaf)
    b = mbd.RigidBody("b", center=(0.1, 0.05, 0.02), position=place(0.3, 0.0, 0.0), **leaf)
    joints: list[Any] = [
        mbd.Revolute(ground.at(*place(0, 0, z), axes=AXES), a.at(0, 0, z), axis="z", name=f"wall {i}")
        for i, z in enumerate((0.0, 0.4))
    ]
    joints += [
        mbd.Revolute(a.at(0.3, 0, z), b.at(0, 0, z), axis="z", name=f"fold {i}") for i, z in enumerate((0.0, 0.2))
    ]
    if angle is not None:
        joints.append(mbd.Drive(joints[0].a, joints[0].b, axis="z", angle=angle, name="motor"))
    hook = ground.at(*place(0.6, 0.3, 0.1))
    spring = mbd.SpringDamper(hook, b.at(0.2, 0, 0), stiffness=mbd.variable(20.0), rest=0.1, name="spring")
    return mbd.System([a, b], joints, [spring], gravity=GRAVITY)


def jacobian(motion: mbd.Trajectory, i: int) -> Tensor:
    """Phi_q [rows, n_v] at output time i of the first lane."""
    d, q = motion.dynamics, motion.q[0, i, :, None, None]
    return d.saddle.jacobian(d.data, placement(d.topology, d.data, q, d.topology.prescribed(motion.t[i], d.data)))[0]


def of_rows(motion: mbd.Trajectory, q: Tensor) -> Tensor:
    """Sizes of the rows [rows] at q [n_q]: twice the root mean square distance of points from their mean, or one."""
    T, data, q = motion.dynamics.topology, motion.dynamics.values().data, q.detach()[:, None, None]
    at = placement(T, data, q, T.prescribed(torch.zeros((), dtype=torch.float64), data))
    points = torch.cat([split_q(T, q)[0], at.g[:, [i for i, x in enumerate(T.attached) if x.is_point]]], 1)[..., 0, 0]
    size = 2.0 * float((points - points.mean(1, keepdim=True)).square().sum(0).mean().sqrt())
    return tensor(*(1.0 if "perpendicular" in name or "angle" in name else size for name in T.row_names))


@pytest.mark.thorough
@pytest.mark.parametrize("angle", [None, mbd.Sine(0.4, 5.0)])
def test_they_do_not_depend_on_the_iteration(angle):
    """Two to twenty corrections a step, and what is left of lam in combinations of rows that act on no body."""
    system = doors(angle)
    settings: tuple[dict[str, Any], ...] = ({}, {"iterations": (2, 1)}, {"iterations": (6, 1), "refresh": 0})
    result = [mbd.simulate(system, 0.2, steps=100, **given).require_ok() for given in settings]
    for motion in result:
        for i in (1, 50, 100):
            J = jacobian(motion, i)
            U, s, _ = torch.linalg.svd(J)
            rank = int((s > 1e-6).sum())
            assert rank == len(J) - 10
            assert float((U[:, rank:].T @ (of_rows(motion, motion.q[0, i]) ** 2 * motion.lam[0, i])).abs().max()) < 1e-8
    for other in result[1:]:
        assert_close(other.lam, result[0].lam, rtol=0, atol=1e-5 * float(result[0].lam.abs().max()))


@pytest.mark.thorough
def test_both_routes_have_the_same():
    """Towards the end: multipliers of the structural integrator are of first order in the first steps."""
    system = doors(mbd.Sine(0.4, 5.0))
    fast = mbd.simulate(system, 0.1, steps=400).require_ok().lam[:, 200::8]
    reference = mbd.simulate(system, 0.1, steps=100, method="rk4").require_ok().lam[:, 50::2]
    assert_close(fast, reference, rtol=0, atol=1e-3 * float(reference.abs().max()))


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["generalized_alpha", "rk4"])
def test_gradients_are_those_of_the_reactions(method):
    system = doors(mbd.Sine(mbd.variable(0.4), 5.0))
    options: dict[str, Any] = {"iterations": (5, 4)} if method == "generalized_alpha" else {}
    responses = [mbd.Integral(mbd.Reaction(name, (0.3, 0.5, -0.7))) for name in ("wall 1", "fold 0", "fold 1")]
    motion = mbd.simulate(system, 0.1, method, 30, gradients="forward", **options).require_ok()
    sizes = {"motor.amplitude": 1e-4, "spring.stiffness": 1e-2}
    designs = {
        name: torch.stack([p.detach() + sign * sizes[name] * (name == moved) for moved in sizes for sign in (1, -1)])
        for name, p in system.named_parameters()
    }
    near = mbd.simulate(system, 0.1, method, 30, designs=designs, **options).require_ok()
    for response in responses:
        gradient = response.value_and_gradient(motion)[1]
        assert gradient is not None
        plus, minus = response.value(near).unflatten(0, (-1, 2)).unbind(1)
        slope = dict(zip(sizes, (plus - minus) / (2.0 * tensor(*sizes.values())), strict=True))
        expected = torch.stack([slope[name.partition("[")[0]] for name in motion.parameters])
        assert_close(gradient[0], expected, rtol=1e-6, atol=1e-6 * float(expected.abs().max()))


@pytest.mark.thorough
def test_a_lock_that_repeats_a_hinge_shares_with_it():
    """Phases: a hinge and a lock on the same joint, which repeats four of its rows; before it, the hinge alone."""
    ground, arm = mbd.Ground(), mbd.RigidBody("arm", 0.7, (3e-3, 2e-3, 2.5e-3), center=(0.2, 0.1, 0.03), axes=AXES)
    hinge = mbd.Revolute(ground.at(axes=AXES), arm.at(), axis="z", name="hinge")
    twin = mbd.Revolute(ground.at(*place(0, 0, 0.3), axes=AXES), arm.at(0, 0, 0.3), axis="z", name="twin")
    system = mbd.System([arm], [hinge, twin], gravity=GRAVITY)
    phases = [mbd.Phase(until=0.1), mbd.Phase(lock=["hinge"])]
    settings: tuple[dict[str, Any], ...] = ({}, {"iterations": (6, 1)})
    one, other = (mbd.simulate(system, 0.2, steps=100, phases=phases, **x) for x in settings)
    for joint in ("hinge", "twin"):
        for kind in ("force", "torque"):
            a, b = (getattr(motion.require_ok().reaction(joint), kind) for motion in (one, other))
            assert_close(a, b, rtol=0, atol=1e-6 * float(a.abs().max()))
    axes = frame_axes(one, hinge.a)[0, 0].T
    weight = sum(one.reaction(name).force[0, -1] for name in ("hinge", "twin"))
    assert_close(weight, -0.7 * (axes @ tensor(*GRAVITY)), rtol=0, atol=1e-2)  # at rest, locked


@pytest.mark.thorough
def test_both_sides_of_a_switch_share_what_they_carry():
    """A driven door whose second leaf stops at an angle: the time of the switch, and with it the motor's law, moves
    with the design. Total derivatives beside those of neighbors with switches of their own."""
    system = doors(mbd.Sine(mbd.variable(0.4), 5.0))
    until = mbd.Event(lambda motion: motion.body("a").A[..., :, 0] @ AXES[:, 1] - 0.3, "rising")
    phases = [mbd.Phase(until=until, name="turn"), mbd.Phase(lock=["fold 0"])]

    def run(**given) -> mbd.Trajectory:
        return mbd.simulate(system, 0.05, steps=15, phases=phases, iterations=(6, 4), **given).require_ok()

    motion = run(gradients="forward", variables=["motor.amplitude"])
    size = 1e-5
    near = run(designs={"motor.amplitude": tensor(0.4 + size, 0.4 - size)})
    (switch,), (other,) = motion.switches, near.switches
    t = float(switch.t)
    assert 0.01 < t < 0.04
    for side, sides in ((switch.before, other.before), (switch.after, other.after)):
        d, q = motion.dynamics.values(), side.q[0, :, None, None]
        acting = (side.lam[0] != 0.0).double()
        J = d.saddle.jacobian(d.data, placement(d.topology, d.data, q, d.topology.prescribed(switch.t[0], d.data)))[0]
        U, s, _ = torch.linalg.svd(acting[:, None] * J)
        loose = U[:, int((s > 1e-6).sum()) :] * acting[:, None]
        assert float((loose.T @ (of_rows(motion, side.q[0]) ** 2 * side.lam[0])).abs().max()) < 1e-8 * float(
            side.lam.abs().max()
        )
        assert side.dlam_db is not None
        expected = (sides.lam[0] - sides.lam[1]) / (2.0 * size)
        assert_close(side.dlam_db[0, :, 0], expected, rtol=0, atol=1e-5 * float(expected.abs().max()))


def test_a_lane_that_failed_gets_nan_and_the_others_their_own():
    motion = mbd.simulate(doors(), 0.02, steps=4).require_ok()
    dynamics, q, lam = motion.dynamics, motion.q[0].T[:, None, :2], motion.lam[0].T[:, None, :2]
    least = dynamics.least_norm
    assert least is not None
    broken = q.clone()
    broken[..., 1] = torch.nan
    given = dynamics.topology.prescribed(torch.zeros((), dtype=torch.float64), dynamics.data)
    result = least(dynamics.data, given, broken, lam)  # finite multipliers all the same
    assert bool(result[..., 1].isnan().all())
    assert_close(result[..., 0], least(dynamics.data, given, q, lam)[..., 0], rtol=0, atol=1e-12)
