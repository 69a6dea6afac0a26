"""The motion is an operation of torch: everything that torch does with operations works on it, or is refused by name."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import pendulum, spoilt
from tests.refused import ANY, refused
from tests.sensitivity.test_law_variables import arm
from torchmbd.errors import InputError

pytestmark = pytest.mark.usefixtures("compiled")

ANGLES = "rod.laminate.angles"
OPTIONS = {"steps": 8, "iterations": (6, 4)}
WAYS = ("reverse", "forward")


@pytest.fixture(scope="module")
def system() -> mbd.System:
    return pendulum()


@pytest.fixture(scope="module")
def angles(system) -> Tensor:
    return system.get_parameter(ANGLES).detach().clone()


def energy(system: mbd.System, x: Tensor, **options) -> Tensor:
    """A number that everything goes into [lanes]."""
    motion = mbd.simulate(system, 0.01, designs={ANGLES: x}, **OPTIONS, **options)
    reaction = motion.reaction(system.joints[0].name)
    parts = (motion.q, 0.1 * motion.v, 1e-3 * motion.a, 1e-3 * motion.lam, motion.body("rod").nodes)
    total = sum((y * (1.0 + y)).flatten(1).sum(1) for y in parts)
    return total + 1e-3 * reaction.force.square().sum((1, 2)) + motion.energies.stored.sum(1)


def differences(f, x: Tensor, step: float = 1e-3) -> Tensor:
    """Richardson differences [..., n] of f by x [n]."""

    def slope(h: float) -> Tensor:
        sides = [torch.stack([f(x + s * h * e) for e in torch.eye(len(x), dtype=x.dtype)], -1) for s in (1.0, -1.0)]
        return (sides[0] - sides[1]) / (2.0 * h)

    with torch.no_grad():
        return (4.0 * slope(step) - slope(2.0 * step)) / 3.0


@pytest.fixture(scope="module")
def wanted(system, angles) -> Tensor:
    return differences(lambda x: energy(system, x), angles)[0]


@pytest.mark.thorough
@pytest.mark.parametrize("way", WAYS)
def test_backward(system, angles, wanted, way):
    x = angles.clone().requires_grad_()
    energy(system, x, gradients=way).sum().backward()
    assert_close(x.grad, wanted, rtol=0, atol=1e-6 * float(wanted.abs().max()))


@pytest.mark.thorough
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("transform", ["grad", "jacrev", "jacfwd", "jvp", "vjp"])
def test_transforms_of_torch_func(system, angles, wanted, transform, way):
    def f(x: Tensor) -> Tensor:
        return energy(system, x, gradients=way)[0]

    if transform == "jvp":
        result = torch.stack([torch.func.jvp(f, (angles,), (e,))[1] for e in torch.eye(2, dtype=angles.dtype)])
    elif transform == "vjp":
        result = torch.func.vjp(f, angles)[1](torch.ones((), dtype=angles.dtype))[0]
    else:
        result = getattr(torch.func, transform)(f)(angles)
    assert_close(result, wanted, rtol=0, atol=1e-6 * float(wanted.abs().max()))


@pytest.mark.thorough
@pytest.mark.parametrize("way", WAYS)
def test_vmap_over_designs(system, angles, way):
    """More lanes, alone and with gradients inside; a batch of batches too."""
    many = angles + torch.tensor([[0.0], [0.3], [-0.2]], dtype=angles.dtype)
    alone = torch.cat([energy(system, x) for x in many])

    def f(x: Tensor) -> Tensor:
        return energy(system, x, gradients=way)[0]

    assert_close(torch.vmap(f)(many), alone, rtol=1e-9, atol=0)
    batches = torch.stack([many, many.flip(0)])
    result = torch.vmap(lambda some: energy(system, some, gradients=way))(batches)
    assert_close(result, torch.stack([alone, alone.flip(0)]), rtol=1e-9, atol=0)
    slopes = torch.stack([torch.func.jacrev(f)(x) for x in many])
    size = float(slopes.abs().max())
    for inside in (torch.func.jacrev, torch.func.jacfwd):
        assert_close(torch.vmap(inside(f))(many), slopes, rtol=0, atol=1e-8 * size)


@pytest.mark.thorough
def test_vmap_over_directions(system, angles):
    """One integration for all directions."""
    directions = torch.randn(5, 2, dtype=angles.dtype, generator=torch.Generator().manual_seed(3))

    def f(x: Tensor) -> Tensor:
        return energy(system, x)[0]

    result = torch.vmap(lambda d: torch.func.jvp(f, (angles,), (d,))[1])(directions)
    expected = torch.stack([torch.func.jvp(f, (angles,), (d,))[1] for d in directions])
    assert_close(result, expected, rtol=1e-7, atol=0)


@pytest.mark.thorough
@pytest.mark.parametrize("way", WAYS)
def test_gradcheck(system, angles, way):
    """Reverse and forward mode; the rounding of a motion bears steps of 1e-5 only."""

    def f(x: Tensor) -> Tensor:
        motion = mbd.simulate(system, 0.01, designs={ANGLES: x}, gradients=way, **OPTIONS)
        return motion.body("rod").nodes[:, -1, -1]

    x = angles.clone().requires_grad_()
    forward = way == "reverse"  # the other way nests dual numbers
    assert torch.autograd.gradcheck(f, (x,), eps=1e-5, atol=1e-9, rtol=1e-5, nondet_tol=1e-12, check_forward_ad=forward)


@pytest.mark.thorough
def test_several_outputs_at_once(system, angles):
    x = angles.clone().requires_grad_()
    motion = mbd.simulate(system, 0.01, designs={ANGLES: x}, **OPTIONS)
    outputs = [motion.q, motion.lam, motion.body("rod").strain_energy]
    (both,) = torch.autograd.grad(outputs, x, [torch.ones_like(y) for y in outputs], retain_graph=True)
    parts = [torch.autograd.grad(y, x, torch.ones_like(y), retain_graph=True)[0] for y in outputs]
    assert_close(both, sum(parts), rtol=1e-8, atol=1e-12)


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["rk4", "dopri5"])
def test_methods_of_torchdiffeq(system, angles, method):
    def f(x: Tensor) -> Tensor:
        motion = mbd.simulate(system, 0.002, method, steps=4, designs={ANGLES: x})
        return (motion.q * (1.0 + motion.q)).sum((1, 2))[0] + motion.body("rod").strain_energy[0, -1]

    expected = differences(f, angles)
    for result in (torch.func.grad(f)(angles), torch.func.jacfwd(f)(angles)):
        assert_close(result, expected, rtol=0, atol=1e-5 * float(expected.abs().max()))


@pytest.mark.thorough
def test_second_derivatives_are_refused_by_name(system, angles):
    def loss(x: Tensor) -> Tensor:
        return energy(system, x)[0]

    x = angles.clone().requires_grad_()
    (slope,) = torch.autograd.grad(loss(x), x, create_graph=True)
    for ask in (lambda: torch.func.hessian(loss)(angles), lambda: torch.autograd.grad(slope.sum(), x)):
        with pytest.raises((InputError, NotImplementedError), match=r"second derivatives? of|differentiated twice"):
            ask()


def test_no_grad_integrates_values_only(system, angles):
    x = angles.clone().requires_grad_()
    with torch.no_grad():
        motion = mbd.simulate(system, 0.01, designs={ANGLES: x}, **OPTIONS)
    assert not motion.q.requires_grad
    assert motion.stats["gradients"] == "none"
    assert motion.dq_db is None
    assert_close(motion.q, mbd.simulate(system, 0.01, designs={ANGLES: x}, **OPTIONS).q.detach(), rtol=0, atol=1e-11)


@pytest.mark.thorough
def test_it_can_be_said_which_way_gradients_come(system):
    assert mbd.simulate(system, 0.01, **OPTIONS).stats["gradients"] == "reverse"
    assert mbd.simulate(system, 0.01, "rk4", steps=4).stats["gradients"] == "forward"
    motion = mbd.simulate(system, 0.01, gradients="none", **OPTIONS)
    assert (motion.stats["gradients"], motion.q.requires_grad) == ("none", False)
    with refused("gradients", "reverse", "dq_db", "gradients='forward'"):
        _ = mbd.simulate(system, 0.01, **OPTIONS).dq_db


@pytest.mark.thorough
@pytest.mark.parametrize("optimizer", ["Adam", "LBFGS"])
def test_optimizers_of_torch_descend(optimizer):
    system = pendulum()
    options = {"lr": 0.05} if optimizer == "Adam" else {"lr": 0.5, "max_iter": 3}
    stepper = getattr(torch.optim, optimizer)([system.get_parameter(ANGLES)], **options)
    measure, seen = mbd.Integral(mbd.StrainEnergy("rod")), []

    def closure() -> Tensor:
        stepper.zero_grad()
        loss = 1e6 * measure(mbd.simulate(system, 0.01, steps=8)).sum()
        loss.backward()
        seen.append(float(loss.detach()))
        return loss

    for _ in range(3):
        stepper.step(closure)
    assert seen[-1] < 0.99 * seen[0]


@pytest.mark.thorough
def test_parameters_of_laws_and_thicknesses_have_gradients():
    """The amplitude of a drive, a thickness: whatever requires a gradient has one after `backward()`."""
    system = arm()
    for _, x in system.named_parameters():
        x.requires_grad_()

    def loss() -> Tensor:
        motion = mbd.simulate(system, 0.02, steps=10, iterations=(6, 4))
        return motion.body(motion.dynamics.topology.names[0]).strain_energy.sum() + motion.q.square().sum()

    loss().backward()
    for name, x in system.named_parameters():
        flat = x.detach().clone().flatten()
        step = 1e-5 * float(flat.abs().max().clamp_min(1e-3))

        def shifted(y: Tensor, x: Tensor = x) -> Tensor:
            before = x.detach().clone()
            with torch.no_grad():
                x.copy_(y.reshape(x.shape))
                result = loss()
                x.copy_(before)
            return result

        expected = differences(shifted, flat, step).reshape(x.shape)
        assert x.grad is not None, name
        assert_close(x.grad, expected, rtol=0, atol=2e-6 * float(expected.abs().max()), msg=name)


@pytest.mark.thorough
def test_functional_call(system, angles):
    class Loss(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.system = system

        def forward(self) -> Tensor:
            return mbd.Integral(mbd.StrainEnergy("rod"))(mbd.simulate(self.system, 0.01, **OPTIONS)).sum()

    module = Loss()

    def f(x: Tensor) -> Tensor:
        return torch.func.functional_call(module, {f"system.{ANGLES}": x}, ())

    expected = differences(f, angles)
    for result in (torch.func.grad(f)(angles), torch.func.jacfwd(f)(angles)):
        assert_close(result, expected, rtol=0, atol=1e-6 * float(expected.abs().max()))


@pytest.mark.thorough
def test_a_motion_can_be_copied_pickled_and_detached(system):
    motion = mbd.simulate(system, 0.01, **OPTIONS)
    for again in (copy.deepcopy(motion), pickle.loads(pickle.dumps(motion)), motion.detach()):
        assert not again.q.requires_grad
        assert torch.equal(again.q, motion.q.detach())
        assert torch.equal(again.lam, motion.lam.detach())
        assert torch.equal(again.body("rod").nodes, motion.body("rod").nodes.detach())
    other = copy.deepcopy(system)
    other.load_state_dict(system.state_dict())
    assert torch.equal(mbd.simulate(other, 0.01, **OPTIONS).q, motion.q)


@pytest.mark.thorough
@pytest.mark.parametrize("way", WAYS)
def test_a_lane_that_fails_adds_nothing(monkeypatch, way):
    system = pendulum()
    designs = mbd.deg([[20.0, -50.0], [10.0, 70.0], [-30.0, 5.0]])

    def slopes(some: Tensor) -> tuple[Tensor, list[str], Tensor]:
        x = some.clone().requires_grad_()
        motion = mbd.simulate(system, 0.01, designs={ANGLES: x}, gradients=way, **OPTIONS)
        loss = motion.body("rod").nodes[:, -1].square().sum((1, 2)) + motion.body("rod").strain_energy.sum(1)
        loss.sum().backward()
        return x.grad, motion.status, loss

    wanted, _, _ = slopes(designs)
    spoilt(system, monkeypatch)
    result, status, loss = slopes(designs)
    assert [x == "ok" for x in status] == [True, False, True]
    assert loss.isnan().tolist() == [False, True, False]
    assert result[1].tolist() == [0.0, 0.0]
    assert_close(result[[0, 2]], wanted[[0, 2]], rtol=1e-8, atol=0)


def test_a_number_that_depends_on_no_parameter(system, angles):
    x = angles.clone().requires_grad_()
    motion = mbd.simulate(system, 0.01, designs={ANGLES: x}, **OPTIONS)
    (slope,) = torch.autograd.grad(motion.q.sum() + motion.t.sum(), x, retain_graph=True)
    assert bool(torch.isfinite(slope).all())
    (nothing,) = torch.autograd.grad(motion.t.sum() + 0.0 * motion.q.sum(), x)
    assert nothing.tolist() == [0.0, 0.0]


@pytest.mark.thorough
@pytest.mark.parametrize("way", WAYS)
def test_a_look_without_gradients_takes_none_away(system, angles, way):
    """What was asked for under `no_grad` is asked for again with a gradient."""
    looks = {
        "q": lambda motion: motion.q,
        "lam": lambda motion: motion.lam,
        "energies": lambda motion: motion.energies.stored,
        "modes": lambda motion: motion.modes("rod"),
        "reaction": lambda motion: motion.reaction(system.joints[0].name).force,
    }
    x = angles.clone().requires_grad_()
    motion = mbd.simulate(system, 0.01, designs={ANGLES: x}, gradients=way, **OPTIONS)
    for name, look in looks.items():
        with torch.no_grad():
            before = look(motion)
        result = look(motion)
        assert (before.requires_grad, result.requires_grad) == (False, True), name
        assert torch.equal(before, result.detach()), name


@pytest.mark.thorough
@pytest.mark.parametrize("gradients", ["auto", "forward", "reverse"])
def test_a_design_that_is_no_variable_is_refused_where_it_is_differentiated(system, angles, gradients):
    name = "rod.laminate.thickness"
    designs = {ANGLES: angles, name: system.get_parameter(name).detach().clone().requires_grad_()}
    with refused("rod.laminate.thickness"):
        mbd.simulate(system, 0.01, designs=designs, gradients=gradients, variables=[ANGLES], **OPTIONS)
    designs[name] = designs[name].detach()
    motion = mbd.simulate(system, 0.01, designs=designs, gradients=gradients, variables=[ANGLES], **OPTIONS)
    assert motion.ok


@pytest.mark.thorough
def test_vmap_without_gradients(system, angles):
    """Also of what has the design in its data."""
    many = torch.stack([angles, angles + 0.3])

    def f(x: Tensor) -> Tensor:
        motion = mbd.simulate(system, 0.002, "rk4", steps=4, designs={ANGLES: x}, gradients="none")
        return motion.body("rod").strain_energy[0]

    assert_close(torch.vmap(f)(many), torch.stack([f(x) for x in many]), rtol=1e-12, atol=0)
    with refused("gradients", "none"):
        torch.func.jvp(f, (angles,), (torch.ones_like(angles),))


@pytest.mark.thorough
@pytest.mark.parametrize("way", WAYS)
def test_a_batch_of_vmap_whose_lanes_fail_has_gradients_of_its_shape(system, angles, way):
    many = torch.stack([angles, angles + 0.1, angles - 0.2])

    def f(x: Tensor) -> Tensor:  # one step over a swing: its iteration does not converge
        motion = mbd.simulate(system, 0.3, steps=1, designs={ANGLES: x}, gradients=way)
        return mbd.Integral(mbd.StrainEnergy("rod"))(motion).sum()

    for inside in (torch.func.jacrev, torch.func.jacfwd):
        result = torch.vmap(inside(f))(many)
        assert result.shape == many.shape
        assert not bool(result.any())


@pytest.mark.thorough
def test_vmap_over_phases(system, angles):
    """What lanes have in common with vmap is the same; energies, whose times are those of each lane, are refused."""
    many = torch.stack([angles, angles + 0.2])
    phases = [mbd.Phase(until=0.004), mbd.Phase(lock=[system.joints[0]])]

    def motion(x: Tensor) -> mbd.Trajectory:
        return mbd.simulate(system, 0.01, designs={ANGLES: x}, phases=phases, **OPTIONS)

    def f(x: Tensor) -> Tensor:
        result = motion(x)
        return result.lam.square().sum() + result.switches[0].after.v.sum() + result.body("rod").strain_energy.sum()

    assert_close(torch.vmap(f)(many), torch.stack([f(x) for x in many]), rtol=1e-9, atol=0)
    slopes = torch.stack([torch.func.jacrev(f)(x) for x in many])
    for inside in (torch.func.jacrev, torch.func.jacfwd):
        result = torch.vmap(inside(f))(many)
        assert_close(result, slopes, rtol=0, atol=1e-8 * float(slopes.abs().max()))
    with refused("motion", ANY, "vmap"):
        torch.vmap(lambda x: motion(x).energies.stored)(many)


@pytest.mark.thorough
def test_vmap_over_an_event_of_a_flexible_body():
    """Its drive has variables with gradients, and no part in vmap."""
    system = mbd.examples.two_link_arm.build(cells=(4, 2), modes=1)
    phases = [mbd.Phase(until=mbd.Event(mbd.StrainEnergy("upper") - 1e-4, "rising")), mbd.Phase()]
    angles = system.get_parameter("upper.laminate.angles").detach()
    many = torch.stack([angles, angles + 0.2])

    def f(x: Tensor) -> Tensor:
        motion = mbd.simulate(system, 0.1, steps=20, designs={"upper.laminate.angles": x}, phases=phases)
        return motion.switches[0].t.sum() + motion.body("upper").strain_energy.sum()

    assert_close(torch.vmap(f)(many), torch.stack([f(x) for x in many]), rtol=1e-9, atol=0)
    slopes = torch.stack([torch.func.grad(f)(x) for x in many])
    assert bool(slopes.abs().sum() > 0.0)
    assert_close(torch.vmap(torch.func.grad(f))(many), slopes, rtol=0, atol=1e-8 * float(slopes.abs().max()))


@pytest.mark.thorough
@pytest.mark.parametrize("way", WAYS)
def test_batches_of_cotangents(system, angles, way):
    """By torch.vmap; torch.autograd's own way, which knows no rules of operations, is refused by name."""
    x = angles.clone().requires_grad_()
    y = mbd.simulate(system, 0.01, designs={ANGLES: x}, gradients=way, **OPTIONS).q[0, -1, :3]
    rows = torch.eye(3, dtype=torch.float64)
    expected = torch.stack([torch.autograd.grad(y, x, row, retain_graph=True)[0] for row in rows])
    result = torch.vmap(lambda row: torch.autograd.grad(y, x, row, retain_graph=True)[0])(rows)
    assert_close(result, expected, rtol=1e-9, atol=0)
    with refused("is_grads_batched", True, "torch.vmap"):
        torch.autograd.grad(y, x, rows, is_grads_batched=True)


@pytest.mark.thorough
def test_dual_levels_of_autograd(system, angles):
    """Tangents through the steps; where they are integrated with the motion, a dual level is refused by name."""
    direction = torch.tensor([1.0, 0.5], dtype=torch.float64)
    expected = torch.func.jvp(lambda x: energy(system, x), (angles,), (direction,))[1]
    with forward_ad.dual_level():
        x = forward_ad.make_dual(angles, direction)
        result = forward_ad.unpack_dual(energy(system, x)).tangent
        assert_close(result, expected, rtol=1e-9, atol=0)
        for options in ({"gradients": "forward"}, {"method": "rk4"}):
            with refused(ANGLES):
                mbd.simulate(system, 0.01, steps=8, designs={ANGLES: x}, **options)
