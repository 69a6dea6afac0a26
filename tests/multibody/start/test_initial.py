"""Assembly: Newton's method from bad guesses, compatible velocities, exact derivatives, and what cannot close."""

from __future__ import annotations

import math
import warnings
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import box, plate, tensor, turned
from tests.refused import warned
from torchmbd.errors import InputError
from torchmbd.examples.slider_crank import build
from torchmbd.math.pair import Pair, value
from torchmbd.math.rotation import rotation_matrix
from torchmbd.multibody.equations import equations
from torchmbd.multibody.joints.joint import Equation, Joint
from torchmbd.multibody.joints.primitive import Plane


def closed(system: mbd.System) -> tuple[Tensor, Tensor, float, float]:
    """Initial q, v and the largest violations of positions and velocities."""
    dynamics = system.dynamics()
    T, t = system.topology, torch.zeros((), dtype=torch.float64)
    with torch.no_grad():
        q, v = dynamics.initial.solve(dynamics)
        at = equations.placement(T, dynamics.data, q, T.prescribed(t))
        jets = equations.constraint_jets(T, at, dynamics.data, v, torch.zeros_like(v), t)
    return q[:, 0, 0], v[:, 0, 0], float(jets.value.abs().max()), float(jets.velocity.abs().max())


def crank_slider(offset: Tensor, turn: Tensor) -> mbd.System:
    """A rigid slider-crank whose rod starts away from where it belongs."""
    ground = mbd.Ground()
    crank = box("crank", center=(0, 0, 0))
    rod = box("rod", position=tensor(0.302, 0.02, 0.01) + offset, axes=turn)
    slider = box("slider", position=(0.45, -0.01, 0.02))
    return mbd.System(
        [crank, rod, slider],
        [
            mbd.Revolute(ground.at(), crank.at(), axis="z"),
            mbd.Drive(ground, crank, axis="z", speed=124.8),
            mbd.Spherical(crank.at(0.152, 0, 0), rod.at(-0.152, 0, 0)),
            mbd.Universal(rod.at(0.152, 0, 0), slider.at(), axes="zy"),
            mbd.Prismatic(ground.at(), slider.at(), axis="x"),
        ],
    )


@pytest.mark.parametrize("size", [0.0, 0.02, 0.1])
def test_a_bad_guess_closes(size):
    system = crank_slider(size * tensor(0.5, -1.0, 0.8), turned(0.0, 3.0 * size, 0.1 - 5.0 * size))
    q, v, position, velocity = closed(system)
    assert position < 1e-11
    assert velocity < 1e-10
    T = system.topology
    assert_close(q[3 * T.bodies : 7 * T.bodies].reshape(4, -1).norm(dim=0), torch.ones(3).double(), rtol=0, atol=1e-14)
    crank = T.names.index("crank")
    omega = v[3 * T.bodies : 6 * T.bodies].reshape(3, -1)
    assert_close(omega[:, crank], tensor(0.0, 0.0, 124.8), rtol=1e-12, atol=1e-10)


def test_velocities_of_the_slider_crank_are_those_of_the_rigid_mechanism():
    """In line, the slider rests and the rod turns by -(crank / rod) of the crank's speed; modes are at rest."""
    system = build(1, [30.0], cells=(6, 2), modes=2)
    q, v, position, velocity = closed(system)
    T = system.topology
    assert max(position, velocity) < 1e-11
    omega = v[3 * T.bodies : 6 * T.bodies].reshape(3, -1)[:, T.names.index("rod")]
    ground = torch.tensor([[1, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64) @ omega
    assert_close(ground, tensor(0.0, 0.0, -124.8 * 0.152 / 0.304), rtol=1e-12, atol=1e-10)
    slider = v[: 3 * T.bodies].reshape(3, -1)[:, T.names.index("slider")]
    assert_close(slider, torch.zeros(3).double(), rtol=0, atol=1e-10)
    assert not q[7 * T.bodies :].any()
    assert not v[6 * T.bodies :].any()


def test_given_velocities_are_kept_where_the_joints_allow_them():
    """The least change: what is along the free motion stays, the rest goes, with a warning that has the numbers."""
    a = box("a", center=(0, 0, 0), angular_velocity=(3.0, -2.0, 5.0), velocity=(1.0, 1.0, 1.0))
    system = mbd.System([a], [mbd.Revolute(mbd.Ground().at(), a.at(), axis="z")])
    with warned("initial velocities") as record:
        _, v, _, velocity = closed(system)
    assert velocity < 1e-14
    assert_close(v, tensor(0, 0, 0, 0, 0, 5.0), rtol=0, atol=1e-14)
    (result,) = record
    message = str(result.message).replace("-0", "0")  # the largest change first, by the radius of gyration of 0.1 m
    assert ": velocity of 'a' given (1, 1, 1), starts with (0, 0, 0) m/s" in message
    assert "; angular velocity of 'a' given (3, -2, 5), starts with (0, 0, 5) rad/s" in message


def hexapod(given: dict[str, Any], struts: dict[str, Any] | None = None) -> mbd.System:
    """A platform on six struts, each of two bodies that slide in each other, between a universal and a spherical joint."""
    ground, top = mbd.Ground(), box("platform", position=(0.0, 0.0, 1.0), center=(0.0, 0.0, 0.0), **given)
    bodies, joints = [top], []
    for k in range(6):
        turn, lean = (2.0 * torch.pi * k / 6 + side * 0.35 for side in (1.0 if k % 2 else -1.0, 0.0))
        foot = tensor(0.8 * math.cos(turn), 0.8 * math.sin(turn), 0.0)
        head = tensor(0.4 * math.cos(lean), 0.4 * math.sin(lean), 0.0)
        e = head + tensor(0.0, 0.0, 1.0) - foot
        length = float(e.norm())
        e = e / e.norm()
        x = torch.linalg.cross(tensor(0.0, 1.0, 0.0), e)
        x = x / x.norm()
        axes = torch.stack([x, torch.linalg.cross(e, x), e], 1)
        low = box(f"low_{k}", position=foot, axes=axes, **(struts or {}))
        high = box(f"high_{k}", position=foot + length * e, axes=axes, **(struts or {}))
        bodies += [low, high]
        joints += [
            mbd.Universal(ground.at(*foot.tolist(), axes=axes), low.at(), axes="xy"),
            mbd.Prismatic(low.at(), high.at(), axis="z"),
            mbd.Spherical(top.at(*head.tolist()), high.at()),
        ]
    return mbd.System(bodies, joints)


@pytest.mark.parametrize(
    "given",
    [
        {"velocity": (0.0, 0.0, 0.2)},
        {"velocity": (0.1, -0.2, 0.05), "angular_velocity": (0.3, -0.1, 0.4)},
        {"angular_velocity": (0.0, 0.0, 0.5)},
    ],
)
def test_a_platform_keeps_its_velocity_and_its_struts_follow(given):
    """Where the struts were given none: with the velocities of the joints all compatible, and nothing to warn of."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        system = hexapod(given)
        _, v, position, velocity = closed(system)
    T = system.topology
    assert position < 1e-11
    assert velocity < 1e-12
    i = T.names.index("platform")
    for k, name in enumerate(("velocity", "angular_velocity")):
        if name in given:
            result = v[3 * k * T.bodies : 3 * (k + 1) * T.bodies].reshape(3, -1)[:, i]
            assert_close(result, tensor(*given[name]), rtol=1e-13, atol=1e-14)
    assert float(v.norm()) > 1.5 * float(torch.cat([tensor(*x) for x in given.values()]).norm())


def test_velocities_that_contradict_each_other_are_named():
    """Struts that are given to rest and a platform that is given to move: the least change of all, named."""
    system = hexapod({"velocity": (0.0, 0.0, 0.2)}, {"velocity": (0.0,) * 3, "angular_velocity": (0.0,) * 3})
    with warned("velocity of 'platform'", "(0, 0, 0.2)", "more"):
        _, _, _, velocity = closed(system)
    assert velocity < 1e-12


def test_a_pendulum_turns_as_its_velocity_asks():
    """v = omega x r: the angular velocity follows where it is not given, and the velocity where that is not."""
    foot, arm = mbd.Ground().at(), {"position": (0.5, 0.0, 0.0), "center": (0.0, 0.0, 0.0)}
    for given in ({"velocity": (0.0, 1.0, 0.0)}, {"angular_velocity": (0.0, 0.0, 2.0)}):
        bob = box("bob", **arm, **given)
        _, v, _, _ = closed(mbd.System([bob], [mbd.Revolute(foot, bob.at(-0.5, 0.0, 0.0))]))
        assert_close(v, tensor(0.0, 1.0, 0.0, 0.0, 0.0, 2.0), rtol=1e-13, atol=1e-14)


def test_redundant_equations_close():
    """A planar four-bar with spatial hinges: 20 equations, 3 of them redundant."""
    system = four_bar()
    _, _, position, velocity = closed(system)
    assert max(position, velocity) < 1e-11
    assert len(system().dynamics.redundant) == 3


@pytest.mark.thorough
def test_redundant_equations_move_as_the_planar_mechanism():
    """The same four-bar with two hinges of which only the in-plane equations are kept: no redundant row."""
    spatial, planar = four_bar(), four_bar(planar=True)
    assert planar().dynamics.redundant == ()
    for method, options in (("generalized_alpha", {"iterations": (4, 4)}), ("rk4", {})):
        a, b = (mbd.simulate(s, 0.2, method=method, steps=200, **options).require_ok() for s in (spatial, planar))
        assert float((a.q - b.q).abs().max()) < 1e-8
        assert float((a.a - b.a).abs().max()) < 1e-5 * float(b.a.abs().max())


def four_bar(planar: bool = False) -> mbd.System:
    ground, z = mbd.Ground(), tensor(0.0, 0.0, 1.0)
    corners = [tensor(0, 0, 0), tensor(0.05, 0.2, 0), tensor(0.45, 0.25, 0), tensor(0.5, 0, 0)]
    bodies, ends = [], []
    for name, p, q in zip(("left", "top", "right"), corners[:-1], corners[1:], strict=True):
        x = (q - p) / (q - p).norm()
        axes = torch.stack([x, torch.linalg.cross(z, x), z], 1)
        body = mbd.RigidBody(name, 1.0, (1e-3, 2e-3, 2e-3), center=(0.05, 0, 0), position=p, axes=axes)
        bodies.append(body)
        ends.append((body.at(), body.at(float((q - p).norm()), 0, 0)))
    joints = [
        mbd.Revolute(ground.at(), ends[0][0], axis="z"),
        mbd.Revolute(ends[0][1], ends[1][0], axis="z"),
        mbd.Revolute(ends[1][1], ends[2][0], axis="z"),
        mbd.Revolute(ground.at(0.5, 0, 0), ends[2][1], axis="z"),
    ]
    if planar:  # a point that meets two planes replaces the last hinge
        joints[-1] = _InPlane(ground.at(0.5, 0, 0), ends[2][1])
    return mbd.System(bodies, joints, gravity=(0.0, -9.81, 0.0))


class _InPlane(Joint):
    """The in-plane equations of a hinge about z."""

    def equations(self, attachments):
        for axis in "xy":
            yield Equation(
                Plane, (attachments.point(self.a), attachments.point(self.b), attachments.axis(self.a, axis))
            )


@pytest.mark.thorough
def test_what_cannot_close_is_named_with_its_residual():
    ground, a = mbd.Ground(), box("a")
    joints = [
        mbd.Revolute(ground.at(), a.at(), axis="z", name="hinge"),
        mbd.DistanceJoint(ground.at(3.0, 0.0, 0.0), a.at(0.5, 0.0, 0.0), length=1.0, name="short_link"),
    ]
    with pytest.raises(InputError) as error:
        mbd.System([a], joints)().initial_state()
    message = str(error.value)
    # The ends come no nearer than 2.5 m: (2.5^2 - 1) / 2 = 2.625 at least; Newton stops between both joints.
    assert "does not close" in message
    assert "short_link: distance misses by" in message
    assert "must have positions" in message


def test_the_initial_state_carries_design_tangents():
    """Where the data of an attached vector depend on the design, q and v at the start do too (implicit function theorem)."""
    system = crank_slider(tensor(0.0, 0.0, 0.0), turned(0.0, 0.05, -0.1))
    dynamics = system.dynamics()
    x = dynamics.data["x"]
    make = torch.Generator().manual_seed(2)
    points = torch.tensor([a.is_point for a in system.topology.attached])[None, :, None, None]
    change = torch.where(points, torch.randn(x.shape, generator=make, dtype=torch.float64), 0.0)
    dynamics.data["x"] = Pair.of(x, change)
    result = dynamics.initial.solve(dynamics)
    h, moved = 1e-6, []
    for sign in (1, -1):
        dynamics.data["x"] = x + sign * h * change
        moved.append(dynamics.initial.solve(dynamics))
    for k in range(2):
        slope = (moved[0][k] - moved[1][k]) / (2 * h)
        assert_close(value(result[k]), (moved[0][k] + moved[1][k]) / 2, rtol=1e-6, atol=1e-6)
        assert_close(result[k].tangent, slope, rtol=1e-6, atol=1e-6 * float(slope.abs().max()))


def test_the_initial_state_is_differentiable_in_reverse_mode():
    """The same as tensors that require gradients: the last Newton step carries them."""
    system = crank_slider(tensor(0.0, 0.0, 0.0), turned(0.0, 0.05, -0.1))
    dynamics = system.dynamics()
    x = dynamics.data["x"].clone().requires_grad_()
    dynamics.data["x"] = x
    make = torch.Generator().manual_seed(6)
    weights = [
        torch.randn(n, 1, 1, generator=make, dtype=torch.float64) for n in (system.topology.n_q, system.topology.n_v)
    ]

    def functional() -> Tensor:
        return sum(
            (weight * part).sum() for weight, part in zip(weights, dynamics.initial.solve(dynamics), strict=True)
        )

    (gradient,) = torch.autograd.grad(functional(), x)
    points = torch.tensor([a.is_point for a in system.topology.attached])[None, :, None, None]
    change = torch.where(points, torch.randn(x.shape, generator=make, dtype=torch.float64), 0.0)
    h, moved = 1e-6, []
    for sign in (1, -1):
        dynamics.data["x"] = x.detach() + sign * h * change
        moved.append(functional())
    assert float((gradient * change).sum()) == pytest.approx(float(moved[0] - moved[1]) / (2 * h), rel=1e-6)


def test_a_flexible_body_with_velocity_moves_as_a_rigid_one():
    body = plate("free", velocity=(1.0, 2.0, 3.0), angular_velocity=(0.1, -0.2, 0.3))
    z = mbd.System([body])().initial_state()[0].detach()
    assert z.tolist()[7:] == pytest.approx([0.0] * 3 + [1.0, 2.0, 3.0, 0.1, -0.2, 0.3] + [0.0] * 3)


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_a_law_that_does_not_start_at_zero_is_where_the_assembly_goes(axis):
    """The angle is measured from the given position, in the right-handed sense about the axis of the first frame."""
    ground, disk = mbd.Ground(), mbd.RigidBody("disk", 1.0, (1.0, 1.0, 1.0), axes=turned(0.2, -0.4, 0.3))
    frame = ground.at(axes=turned(-0.5, 0.3, 0.7))
    joints = [
        mbd.Revolute(frame, disk.at(), axis=axis),
        mbd.Drive(frame, disk, axis=axis, angle=lambda t: 0.6 + 2.0 * t),
    ]
    system = mbd.System([disk], joints)
    q, v, position, _ = closed(system)
    assert position < 1e-11
    direction = frame.axis(axis)
    A = rotation_matrix(q[3:7, None])[..., 0]
    assert_close(A, turned(*(0.6 * direction).tolist()) @ disk.axes, rtol=0, atol=1e-11)
    assert_close(A @ v[3:6], 2.0 * direction, rtol=0, atol=1e-11)


class _Ramp(torch.nn.Module):
    """An angle that starts at p[0] with the speed p[1]."""

    def __init__(self):
        super().__init__()
        self.p = torch.nn.Parameter(tensor(0.4, 3.0))

    def forward(self, t: Tensor) -> Tensor:
        return self.p[0] + self.p[1] * t


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore:the joints do not allow")
@pytest.mark.parametrize(
    "given",
    [
        {"angular_velocity": (1.0, -2.0, 0.5), "velocity": (0.3, 0.2, -1.0)},
        {"angular_velocity": (1.0, -2.0, 0.5)},
        {"velocity": (0.3, 0.2, -1.0)},
        {},
    ],
)
@pytest.mark.parametrize("hub_spins", [False, True])
def test_derivatives_where_joints_leave_freedoms_and_the_start_depends_on_the_design(given, hub_spins):
    """A driven arm, moved by its law at the start, with a free bob that has a velocity of its own.

    A given velocity of the hub contradicts the drive; all but that are kept where the others can follow.
    """
    ground, tip, swing = mbd.Ground(), tensor(0.2, 0.05, 0.0), turned(-0.5, 0.2, 0.9)
    spin = {"angular_velocity": (0.5, 0.2, -1.5)} if hub_spins else {}
    hub = box("hub", position=(0.1, 0.0, 0.2), axes=turned(0.2, 0.1, -0.4), **spin)
    origin = hub.position + hub.axes @ tip - swing @ tensor(-0.15, 0.01, 0.0)
    bob = box("bob", position=origin, axes=swing, **given)
    foot = ground.at(0.1, 0.0, 0.2, axes=turned(0.3, -0.2, 0.5))
    drive = mbd.Drive(foot, hub, name="motor", angle=_Ramp())
    joints = [mbd.Revolute(foot, hub.at()), drive, mbd.Spherical(hub.at(0.2, 0.05, 0.0), bob.at(-0.15, 0.01, 0.0))]
    system = mbd.System([hub, bob], joints)
    p, h = system.get_parameter("motor.p").detach(), 1e-6
    moved = system.dynamics({"motor.p": torch.cat([p + h * torch.eye(2), p - h * torch.eye(2)])})
    slopes = [(x[:, 0, :2] - x[:, 0, 2:]) / (2.0 * h) for x in moved.initial.solve(moved)]
    paired = system.dynamics({"motor.p": p[None]}, ["motor.p"])
    for x, slope in zip(paired.initial.solve(paired), slopes, strict=True):
        assert_close(x.tangent[..., 0], slope, rtol=0, atol=1e-7 * float(slope.abs().max()))
    for weight, x, slope in zip((2.0, -3.0), system().dynamics.initial.solve(system().dynamics), slopes, strict=True):
        along = weight * torch.cos(torch.arange(len(slope), dtype=torch.float64))
        (gradient,) = torch.autograd.grad(
            (along * x[:, 0, 0]).sum(), system.get_parameter("motor.p"), retain_graph=True
        )
        assert_close(gradient, along @ slope, rtol=1e-6, atol=1e-7)


def crank_of_plates() -> mbd.System:
    return build(2, cells=(6, 2), modes=2)


@pytest.mark.thorough
def test_designs_whose_start_does_not_depend_on_the_design_share_it():
    """Found once, the same as found for each; the rank of the constraints, too."""
    system, name = crank_of_plates(), "rod.laminate.angles"
    first, second = (system.dynamics({name: torch.tensor([[a, -a], [0.3, a]]).double()}, (name,)) for a in (0.2, 1.1))
    assert first.shared_start is not None
    assert first.shared_start is second.shared_start
    assert first.condensed().shared_start is second.condensed().shared_start
    for shared, own in zip(second.start, second.initial._solve(second), strict=True):
        assert_close(shared, value(own), rtol=0, atol=1e-14)
    assert second.rank is first.rank
    assert second.condensed().rank is first.condensed().rank


def test_a_start_is_found_anew_where_points_or_drives_have_changed():
    system = crank_of_plates()
    before = system.dynamics()
    q, v = (x.clone() for x in before.start)
    with torch.no_grad():
        for attached in system.topology.attached:
            attached.vector.mul_(1.1 if attached.is_point else 1.0)
    after = system.dynamics()
    assert after.shared_start is not before.shared_start
    assert float((value(after.start[0]) - q).abs().max()) > 1e-3
    assert float((value(after.start[1]) - v).abs().max()) > 1e-3
