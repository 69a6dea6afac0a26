"""Laws of time that jump: closed forms of held control histories, and warnings that name all other laws, times and remedies."""

from __future__ import annotations

import re
import warnings
from fractions import Fraction
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import tensor
from tests.refused import ANY, refused
from torchmbd.design.spline import Spline
from torchmbd.errors import InputError
from torchmbd.integrate.held_times import steps_at, substeps_at
from torchmbd.math.jumps import jump_times
from torchmbd.multibody.forces import OfTime

pytestmark = pytest.mark.usefixtures("compiled")
S = mbd.signals
INERTIA = 0.5


def rotor() -> tuple[mbd.RigidBody, mbd.Revolute]:
    body = mbd.RigidBody("rotor", 1.0, (INERTIA, INERTIA, INERTIA))
    return body, mbd.Revolute(mbd.Ground().at(), body.at(), axis="z", name="hinge")


def held(*values: float, duration: float = 2.0, wrap=None) -> mbd.System:
    """A rotor whose hinge has a torque that is constant on equal intervals."""
    body, hinge = rotor()
    history = mbd.ControlHistory([[u] for u in values], duration, kind="hold")
    module = history if wrap is None else nn.Sequential(history, wrap)
    control = mbd.Controller(module, [S.Time()], [S.JointTorque(hinge)], name="control")
    return mbd.System([body], [hinge], [control])


def turned(motion: mbd.Trajectory) -> Tensor:
    """Angle and rate at the end [lanes, 2]."""
    return torch.stack([mbd.Final(mbd.Angle("rotor", "z"))(motion), motion.body("rotor").omega[:, -1, 2]], 1)


def exact(values: Tensor, duration: float = 2.0, end: float = 2.0) -> Tensor:
    """The same in closed form, by the pieces of constant torque."""
    angle = rate = torch.zeros((), dtype=torch.float64)
    each = duration / len(values)
    for k, u in enumerate(values):
        span = (end - k * each) if k == len(values) - 1 else each
        angle, rate = angle + rate * span + 0.5 * u / INERTIA * span**2, rate + u / INERTIA * span
    return torch.stack([angle, rate])


def texts(run) -> list[str]:
    """Warnings of this kind."""
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        run()
    return [str(x.message) for x in seen if "jump" in str(x.message) or "change at" in str(x.message)]


@pytest.mark.parametrize(
    ("values", "steps", "options"),
    [
        ((1.0, -1.0), 20, {}),
        ((1.0, -1.0), 21, {}),  # the jump within a step
        ((1.0, -1.0, 2.0), 20, {}),
        ((0.3, -1.0, 2.0, 0.0, 5.0), 12, {"backend": "eager"}),
        ((1.0, -1.0), 20, {"spectral_radius": 0.0}),
        ((1.0, -1.0), 20, {"method": "hht_alpha"}),
        ((1.0, -1.0, 2.0), 20, {"checkpoint": 4}),
        pytest.param((1.0, -1.0), 200, {"method": "rk4"}, marks=pytest.mark.thorough),
        pytest.param((1.0, -1.0), 20, {"method": "dopri5", "rtol": 1e-9, "atol": 1e-10}, marks=pytest.mark.thorough),
        pytest.param((1.0, -1.0, 2.0), None, {}, marks=pytest.mark.thorough),
    ],
)
@pytest.mark.thorough
def test_held_values_have_their_closed_form(values, steps, options):
    """Rates are exact, angles of second order: a jump in the middle of two half steps."""
    motion = mbd.simulate(held(*values), 2.0, steps=steps, gradients="none", **options).require_ok()
    h = 2.0 / (steps or 1000)
    most = 0.3 * h * h * float(tensor(*values).diff().abs().sum()) / INERTIA
    result, expected = turned(motion)[0], exact(tensor(*values))
    assert abs(float(result[0] - expected[0])) <= most * (4.0 if "spectral_radius" in options else 1.0) + 1e-6
    assert abs(float(result[1] - expected[1])) <= (3e-4 if "spectral_radius" in options else 3e-5)


@pytest.mark.parametrize("steps", [24, 20])
def test_samples_at_a_jump_are_the_mean_of_both_sides(steps):
    """As the law that the steps take: the integral of accelerations is the change of the rate, which one side would miss."""
    motion = mbd.simulate(held(1.0, -3.0, 2.0), 2.0, steps=steps, gradients="none").require_ok()
    acceleration = motion.body("rotor").omega_rate[0, :, 2]
    at = motion.t * 3.0 / 2.0
    before, after = (tensor(1.0, -3.0, 2.0)[(at + x).floor().long().clamp(0, 2)] for x in (-1e-9, 1e-9))
    assert int((before != after).sum()) == (2 if steps == 24 else 0)
    assert_close(acceleration, 0.5 * (before + after) / INERTIA, rtol=0, atol=1e-12)


def test_peaks_beside_a_jump_are_beyond_it_as_limits_tell():
    """The cubic through samples 1, 1, 0, -1, -1: max u (1 - u) (1 + 5 u) / 12 = 0.0805 of the half jump, as limits.md tells."""
    y = tensor(1.0, 1.0, 1.0, 1.0, 0.0, -1.0, -1.0, -1.0, -1.0)
    curve = Spline.of(torch.arange(9.0, dtype=torch.float64), y, None, None)
    u = torch.linspace(0.0, 1.0, 100_001, dtype=torch.float64)
    beyond = (u * (1.0 - u) * (1.0 + 5.0 * u) / 12.0).amax()
    assert_close(curve.maximum(), 1.0 + beyond, rtol=0, atol=1e-9)


@pytest.mark.thorough
def test_the_error_of_held_values_is_of_second_order():
    values, errors = tensor(1.0, -1.0), []
    for steps in (20, 40, 80):
        motion = mbd.simulate(held(*values.tolist()), 2.0, steps=steps, gradients="none")
        errors.append(float((turned(motion)[0, 0] - exact(values)[0]).abs()))
        assert float(motion.energies.balance[0, -1].abs()) < 0.5 * (2.0 / steps) ** 2 / INERTIA
    assert errors[0] / errors[1] == pytest.approx(4.0, abs=0.2)
    assert errors[1] / errors[2] == pytest.approx(4.0, abs=0.2)


@pytest.mark.parametrize("steps", [24, 20])
@pytest.mark.parametrize("mode", ["reverse", "forward"])
def test_gradients_by_held_values(steps, mode):
    """The motion is linear in the values: slopes are the closed form's, on divided steps (20), too."""
    x = tensor(1.0, -1.0, 2.0)[:, None].requires_grad_()
    motion = mbd.simulate(held(1.0, -1.0, 2.0), 2.0, steps=steps, designs={"control.values": x[None]}, gradients=mode)
    assert motion.stats["gradients"] == mode
    for k in range(2):
        (result,) = torch.autograd.grad(turned(motion)[0, k], x, retain_graph=True)
        expected = torch.func.jacrev(exact)(tensor(1.0, -1.0, 2.0))[k]
        assert_close(result[:, 0], expected, rtol=0, atol=4e-3 if k == 0 else 1e-4)


@pytest.mark.thorough
def test_compiled_and_eager_steps_are_the_same():
    system = held(1.0, -1.0, 2.0)
    one, two = (mbd.simulate(system, 2.0, steps=20, backend=b, gradients="none") for b in ("auto", "eager"))
    assert_close(one.q, two.q, rtol=0, atol=1e-12)


@pytest.mark.thorough
def test_lanes_of_divided_steps_do_not_see_each_other():
    values = torch.stack([tensor(1.0, -1.0, 2.0), tensor(0.0, 3.0, 0.5)])[..., None]
    system = held(1.0, -1.0, 2.0)
    both = mbd.simulate(system, 2.0, steps=20, designs={"control.values": values}, gradients="none").require_ok()
    for lane in range(2):
        assert_close(turned(both)[lane], exact(values[lane, :, 0]), rtol=0, atol=5e-3)


@pytest.mark.thorough
def test_steps_are_chosen_such_that_some_end_at_the_jumps():
    motion = mbd.simulate(held(1.0, -1.0, 2.0, 1.0, 0.0, 1.0, 2.0), 2.0, gradients="none")
    assert motion.stats["steps"] % 7 == 0
    assert mbd.simulate(held(1.0, -1.0, 2.0), 2.0, checkpoint=4, gradients="none").stats["steps"] % 12 == 0


def test_the_duration_of_the_values_is_not_that_of_the_motion():
    motion = mbd.simulate(held(1.0, -1.0, duration=1.0), 2.0, steps=20, gradients="none")
    assert_close(turned(motion)[0], exact(tensor(1.0, -1.0), 1.0), rtol=0, atol=2e-2)


@pytest.mark.parametrize(
    ("system", "options"),
    [
        (held(1.0, -1.0, 2.0), {"halvings": 0}),
        (held(1.0, -1.0, 2.0), {"halvings": 0, "phases": [mbd.Phase(until=0.5), mbd.Phase()]}),
        (held(1.0, -1.0, 2.0, wrap=nn.Linear(1, 1, dtype=torch.float64)), {"halvings": 0}),
        pytest.param(held(1.0, -1.0, 2.0), {"method": "midpoint"}, marks=pytest.mark.thorough),
    ],
)
def test_steps_that_cannot_end_there_are_warned_of(system, options):
    (text,) = texts(lambda: mbd.simulate(system, 2.0, steps=20, gradients="none", **options))
    assert "values of the controller 'control' change at t = 0.666667, 1.33333 s" in text
    assert "none of 20 steps ends" in text
    assert "a multiple of 3" in text
    assert not texts(lambda: mbd.simulate(system, 2.0, steps=21, gradients="none", **options))


def test_a_duration_without_a_ratio_is_warned_of():
    (text,) = texts(lambda: mbd.simulate(held(1.0, -1.0, duration=2.0**0.5), 2.0, steps=20, gradients="none"))
    assert "change at t = 0.707107 s" in text
    assert "simple ratio" in text


def switched(t: Tensor) -> Tensor:
    return torch.where(t < 1.0, 1.0, -1.0).to(t.dtype)


def branched(t: Tensor) -> Tensor:
    return t * 0.0 + (1.0 if t < 0.77 else -1.0) + 40.0 * t


def loaded(law: Any) -> mbd.System:
    body, hinge = rotor()

    def about_z(t: Tensor) -> Tensor:
        return torch.stack([0.0 * t, 0.0 * t, law(t)])

    return mbd.System([body], [hinge], [mbd.Torque(body.at(), about_z if callable(law) else law, name="push")])


def sprung(law) -> mbd.System:
    body, hinge = rotor()
    return mbd.System([body], [hinge], [mbd.RotationalSpringDamper(hinge.a, hinge.b, axis="z", law=law, name="push")])


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("system", "time"),
    [
        (loaded(switched), "1"),
        (loaded(branched), "0.77"),
        (loaded(lambda t: torch.sin(50.0 * t) + 0.1 * torch.sign(t - 0.3)), "0.3"),
        (loaded(lambda t: torch.floor(3.0 * t)), "0.333333, 0.666667, 1 s and 2 more times"),
        (sprung(lambda s, rate, t: torch.where(t < 1.0, -s, -3.0 * s)), "1"),
        (sprung(mbd.forces.Scaled(mbd.variable(2.0), OfTime(switched))), "1"),  # pyright: ignore[reportArgumentType]
    ],
)
def test_functions_that_jump_are_found(system, time):
    for _ in range(2):
        result = texts(lambda: mbd.simulate(system, 2.0, steps=8, gradients="none", backend="eager"))
        assert len(result) == 1
        assert f"the law of 'push' jumps at t = {time}" in result[0]
        assert f"mbd.Phase(until={time.split(',')[0]}, laws={{'push': first}})" in result[0]


@pytest.mark.thorough
@pytest.mark.parametrize(
    "law",
    [
        lambda t: torch.sin(300.0 * t) + torch.tanh(1e3 * (t - 1.0)),
        lambda t: (t - 1.0).abs(),
        lambda t: torch.relu(t - 1.0) * 1e4,
        lambda t: torch.sqrt((t - 1.0).abs()),
        lambda t: torch.exp(-(((t - 1.2345) / 2e-3) ** 2)),
        lambda t: 0.0 * t,
    ],
)
def test_continuous_functions_are_passed_over(law):
    assert jump_times(lambda t: law(t)[None], 2.0) == []
    assert not texts(lambda: mbd.simulate(loaded(law), 2.0, steps=8, gradients="none", backend="eager"))


def test_jumps_are_located_to_rounding():
    result = jump_times(lambda t: torch.stack([switched(t), 3.0 * (t >= 0.1).double(), 100.0 * t]), 2.0)
    assert result == pytest.approx([0.1, 1.0], abs=1e-14)


@pytest.mark.thorough
def test_the_remedies_of_the_warning():
    """Laws of phases, a held history, an adaptive method; each is exact, and not warned of."""
    expected = exact(tensor(1.0, -1.0))
    phases = [mbd.Phase(until=1.0, laws={"push": OfTime(1.0)}), mbd.Phase(laws={"push": OfTime(-1.0)})]
    for steps in (20, 21):
        options: dict = {"steps": steps, "phases": phases, "gradients": "none", "backend": "eager"}
        system = loaded((0.0, 0.0, 5.0))
        assert not texts(lambda s=system, o=options: mbd.simulate(s, 2.0, **o))
        assert_close(turned(mbd.simulate(system, 2.0, **options))[0], expected, rtol=0, atol=1e-12)
    within = [mbd.Phase(until=1.0), mbd.Phase(laws={"push": OfTime(-1.0)})]
    (text,) = texts(
        lambda: mbd.simulate(sprung(OfTime(switched)), 2.0, steps=20, phases=within, gradients="none", backend="eager")
    )
    assert "'push' jumps at t = 1 s" in text  # the first phase ends with the value after the jump
    late = [mbd.Phase(until=0.9), mbd.Phase(laws={"push": OfTime(-1.0)})]
    assert not texts(
        lambda: mbd.simulate(sprung(OfTime(switched)), 2.0, steps=20, phases=late, gradients="none", backend="eager")
    )
    early = [mbd.Phase(until=0.9), mbd.Phase(laws={"push": OfTime(switched)})]
    assert texts(
        lambda: mbd.simulate(loaded((0.0, 0.0, 5.0)), 2.0, steps=20, phases=early, gradients="none", backend="eager")
    )


class Switch(nn.Module):
    """A controller of angle and time that has a jump in time."""

    def forward(self, x: Tensor) -> Tensor:
        return torch.where(x[:, 1:] < 1.25, 1.0, -1.0) * (1.0 + x[:, :1])


def controlled(module: nn.Module) -> mbd.System:
    body, hinge = rotor()
    control = mbd.Controller(module, [S.JointAngle(hinge), S.Time()], [S.JointTorque(hinge)], name="pd")
    return mbd.System([body], [hinge], [control])


@pytest.mark.thorough
def test_a_module_that_jumps_is_found():
    (text,) = texts(lambda: mbd.simulate(controlled(Switch()), 2.0, steps=8, gradients="none", backend="eager"))
    assert "the module of the controller 'pd' jumps at t = 1.25 s" in text


class Late(nn.Module):
    """A controller of angle and time whose jump is where a number of it says."""

    def __init__(self, when: float, kind: str):
        super().__init__()
        number = tensor(when)
        if kind == "buffer":
            self.register_buffer("when", number)
        else:
            self.when = nn.Parameter(number)

    def forward(self, x: Tensor) -> Tensor:
        return torch.where(x[:, 1:] < self.when, 1.0, -1.0) * (1.0 + 0.0 * self.when + x[:, :1])


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["parameter", "buffer"])
def test_jumps_move_with_the_numbers_of_a_module(kind):
    module = Late(1.25, kind)
    system = controlled(module)
    for when in (1.25, 0.75, 1.25):
        with torch.no_grad():
            module.when.fill_(when)
        (text,) = texts(lambda: mbd.simulate(system, 2.0, steps=8, gradients="none", backend="eager"))
        assert f"jumps at t = {when} s" in text


def _line(law) -> str:
    return rf"in {re.escape(__file__)}:{law.__code__.co_firstlineno + 2}"


def wrong_later(t: Tensor) -> Tensor:
    if float(t) > 1.5:
        return t + undefined  # pyright: ignore[reportUndefinedVariable]  # noqa: F821
    return torch.sin(t)


def wrong_away(s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
    if float(s) > 0.3:
        return torch.cat([s, rate[0]])  # torch refuses
    return -s


class WrongLater(nn.Module):
    """A controller with a branch that the check at the door does not reach."""

    def forward(self, x: Tensor) -> Tensor:
        if float(x[0, 1]) > 1.5:
            return x.no_such_method()  # pyright: ignore[reportAttributeAccessIssue]
        return x[:, :1]


@pytest.mark.parametrize(
    ("system", "words"),
    [
        (lambda: loaded(wrong_later), f"push.law raises NameError.* {_line(wrong_later)}"),
        (lambda: sprung(wrong_away), f"push.law .*dimensions.* {_line(wrong_away)}"),
        (
            lambda: driven(wrong_later),
            f"motor.angle raises NameError.* {_line(wrong_later)}",
        ),
        (lambda: controlled(WrongLater()), f"pd.module raises AttributeError.* {_line(WrongLater.forward)}"),
    ],
)
def test_a_law_that_raises_is_named_with_its_line(system, words):
    with pytest.raises(InputError, match=words):
        mbd.simulate(system(), 2.0, steps=8, gradients="none", backend="eager")


@pytest.mark.thorough
@pytest.mark.parametrize("error", [ValueError, IndexError, ZeroDivisionError, AssertionError])
def test_a_law_may_end_where_the_motion_does_not_go(error):
    """As a table does that raises beyond its last point: the motion stays within 0.1 rad."""

    def table(s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
        if float(s.detach().abs().max()) > 0.1:
            raise error("beyond the table")
        return -4.0 * s + 0.02

    motion = mbd.simulate(sprung(table), 2.0, steps=80, gradients="none", backend="eager").require_ok()
    frequency = (4.0 / INERTIA) ** 0.5
    assert_close(turned(motion)[0, 0], 5e-3 * (1.0 - torch.cos(tensor(2.0 * frequency)[0])), rtol=2e-3, atol=1e-5)


def driven(law, **options) -> mbd.System:
    body, hinge = rotor()
    return mbd.System([body], [hinge, mbd.Drive(mbd.Ground(), body, axis="z", angle=law, name="motor", **options)])


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("law", "jumps"),
    [
        (lambda t: torch.where(t < 1.0, 0.0 * t, 0.5 + 0.0 * t), True),
        (lambda t: torch.relu(t - 1.0), True),  # its rate
        (lambda t: torch.relu(t - 1.0) ** 2, False),
        (lambda t: torch.remainder(5.0 * t, 2.0 * torch.pi), False),  # whole turns
        (mbd.SmoothStep(1.0, 0.5), False),
    ],
)
def test_drives_that_no_body_follows_are_found(law, jumps):
    result = texts(lambda: mbd.simulate(driven(law), 2.0, steps=20, gradients="none", backend="eager"))
    assert len(result) == jumps
    assert all("the law of the drive 'motor', or its rate, jumps at t = 1 s" in text for text in result)


def test_a_duration_that_moves_past_jumps_has_no_gradient():
    duration = tensor(2.0)[0].requires_grad_()
    for system in (held(1.0, -1.0), loaded(switched)):
        with refused("duration"):
            mbd.simulate(system, duration, steps=20)


def test_laws_of_phases_and_drives_that_jump_have_no_gradient_by_the_duration():
    """But a law does that jumps while another one acts."""
    duration = tensor(2.0)[0].requires_grad_()
    smooth, jumping = (lambda s, v, t: 0.0 * s), (lambda s, v, t: 0.0 * s + switched(t))
    for phases in ([mbd.Phase(laws={"push": jumping})], [mbd.Phase(until=0.5), mbd.Phase(laws={"push": jumping})]):
        with refused("duration", ANY, "law of 'push'"):
            mbd.simulate(sprung(smooth), duration, steps=20, phases=phases)
    for law in (lambda t: torch.where(t < 1.0, t, 2.0 - t), lambda t: torch.where(t < 1.0, 0.0 * t, 1.0 + 0.0 * t)):
        with refused("duration", ANY, "law of 'motor'"):
            mbd.simulate(driven(law), duration, steps=20)
    motion = mbd.simulate(sprung(jumping), duration, steps=20, phases=[mbd.Phase(laws={"push": smooth})])
    assert motion.body("rotor").omega.requires_grad


@pytest.mark.parametrize("frequency", [3.0, 25.0, 26.6, 50.0, 51.2, 333.0, 2000.0])
def test_an_oscillation_does_not_jump_however_fast(frequency):
    """Its samples lie in different periods; a jump beside it is found."""

    def smooth(t: Tensor) -> Tensor:
        return torch.stack([100.0 * (2.0 * torch.pi * frequency * t + phase).sin() for phase in (0.0, 0.7, 1.9)])

    assert jump_times(smooth, 20.0) == []
    slowly = lambda t: 30.0 * (2.0 * torch.pi * 0.2 * t).sin() + 100.0 * (t > 7.3)  # noqa: E731
    [time] = jump_times(lambda t: torch.cat([smooth(t), slowly(t)[None]]), 20.0)
    assert time == pytest.approx(7.3)


def test_numbers_of_steps():
    assert steps_at([], 2.0) == 1
    assert steps_at([2.0 / 3.0, 4.0 / 3.0], 2.0) == 3
    assert steps_at([0.3, 0.25], 2.0) == 40
    assert steps_at([2.0**0.5], 2.0) is None
    assert substeps_at([2.0 / 3.0], 2.0, 20) == 3
    assert substeps_at([2.0 / 3.0], 2.0, 21) == 1
    for share in (Fraction(7, 60), Fraction(3, 11)):
        assert steps_at([float(share) * 0.37], 0.37) == share.denominator
