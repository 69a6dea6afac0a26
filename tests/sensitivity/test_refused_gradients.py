"""A parameter has its gradient, or the argument that it was given for is refused by name: none is lost in silence."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import CARBON, box, laminate, plate, tensor
from tests.refused import ANY, refused

GROUND = mbd.Ground()
STEEL = mbd.Ply.isotropic(2.1e11, 0.3, 7850.0)
SQUARE = mbd.mesh.rectangle(length=0.3, width=0.1, cells=(2, 2))
K = nn.Parameter(tensor(3.0)[0])  # a global that laws below ask for


def parameter(*x: float) -> nn.Parameter:
    return nn.Parameter(tensor(*x))


class Holder:
    """A callable object with a number in an attribute, a slot, or a list."""

    __slots__ = ("__dict__", "k")

    def __init__(self, k: Any):
        self.k = k

    def __call__(self, s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
        k = self.k[0] if isinstance(self.k, list) else self.k
        return -k * s

    def force(self, s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
        return self(s, rate, t)

    def helped(self, s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
        return -of_global(s) * s


class Net(nn.Module):
    """A law as a module; `hidden` is a tensor that is none of its parameters."""

    def __init__(self, hidden: Tensor | None = None):
        super().__init__()
        self.k = parameter(2.0)
        self._hidden = [hidden]

    def forward(self, s: Tensor, *_: Tensor) -> Tensor:
        return -self.k[0] * s * (1.0 if self._hidden[0] is None else self._hidden[0])


def of_global(s: Tensor) -> Tensor:
    return K + 0.0 * s


def scaled(k: Tensor, s: Tensor, rate: Tensor, t: Tensor) -> Tensor:
    return -k * s


def branched(s: Tensor, rate: Tensor, t: Tensor, k: Any = K) -> Tensor:
    return -k * s if float(s.sum()) > 1.0 else 0.0 * s


def laws() -> dict[str, Callable[..., Tensor]]:
    k, net = parameter(3.0)[0], Net()
    leaf = nn.Parameter(k.detach().clone())
    many = {"k": [(leaf,)]}
    return {
        "closure": lambda s, rate, t: -leaf * s,
        "closure of what is computed": lambda s, rate, t: -k * s,
        "nested": lambda s, rate, t: -many["k"][0][0] * s,
        "function of a function": lambda s, rate, t: scaled(leaf, s, rate, t),
        "module in a closure": lambda s, rate, t: net(s),
        "module": Net(),
        "partial": functools.partial(scaled, leaf),
        "partial of keywords": functools.partial(lambda s, rate, t, k: -k * s, k=leaf),
        "object": Holder(leaf),
        "object with a list": Holder([leaf]),
        "method": Holder(leaf).force,
        "global": lambda s, rate, t: -K * s,
        "global of a method's function": Holder(1.0).helped,
        "default in a branch": branched,
        "scaled": mbd.forces.Scaled(1.0, lambda s, rate, t: -leaf * s),
    }


@pytest.mark.parametrize("kind", laws())
def test_a_law_of_a_force_that_holds_a_parameter_is_refused(kind):
    body, law = box("arm"), laws()[kind]
    with refused("spring.law"):
        mbd.SpringDamper(GROUND.at(), body.at(0.1, 0.0, 0.0), law=law, name="spring")


@pytest.mark.parametrize("kind", [k for k in laws() if k not in ("module", "default in a branch", "scaled")])
def test_a_law_of_time_that_holds_a_parameter_is_refused(kind):
    law = laws()[kind]

    def of_time(t: Tensor) -> Tensor:
        return law(t, t, t)

    body = box("arm")
    with refused("motor.angle"):
        mbd.Drive(GROUND, body, angle=of_time, name="motor")
    for make in (
        lambda: mbd.Force(body.at(), lambda t: torch.stack([of_time(t)] * 3), name="push"),
        lambda: mbd.Torque(body.at(), lambda t: torch.stack([of_time(t)] * 3), name="push"),
        lambda: mbd.Pressure(plate("rod"), of_time, name="push"),
    ):
        with refused("push.law"):
            make()


def test_a_module_as_the_law_of_a_drive_keeps_its_parameters_but_may_hide_none():
    body = box("arm")
    drive = mbd.Drive(GROUND, body, angle=Net(), name="motor")
    system = mbd.System([body], [mbd.Revolute(GROUND.at(), body.at()), drive])
    assert [name for name, _ in system.named_parameters()] == ["motor.k"]
    with refused("motor.angle"):
        mbd.Drive(GROUND, body, angle=Net(hidden=parameter(1.0)[0]), name="motor")


def test_what_becomes_a_parameter_later_is_refused_when_it_is_simulated():
    body, k = box("arm"), tensor(3.0)[0]
    spring = mbd.SpringDamper(GROUND.at(), body.at(0.1, 0.0, 0.0), law=lambda s, rate, t: -k * s, name="spring")
    system = mbd.System([body], forces=[spring], free=["arm"])
    mbd.simulate(system, 0.01, steps=4)
    k.requires_grad_()
    with refused("law of a force"):
        mbd.simulate(system, 0.01, steps=4)


@pytest.mark.parametrize("name", ["arm.axes", "rod.axes"])
def test_constants_of_a_system_are_refused_as_parameters(name):
    body, rod = box("arm"), plate("rod", position=(1.0, 0.0, 0.0))
    system = mbd.System([body, rod], gravity=(0.0, 0.0, -9.81), free=["arm", "rod"])
    owner: Any = system.get_submodule(name.rpartition(".")[0])
    own = name.rpartition(".")[2]
    given = getattr(owner, own)
    delattr(owner, own)
    setattr(owner, own, nn.Parameter(given))
    with refused(name, ANY, "requires a gradient", "constant"):
        mbd.simulate(system, 0.01, steps=4, gradients="forward", variables=[name])


def test_a_buffer_that_requires_a_gradient_is_refused():
    body = box("arm")
    system = mbd.System([body], free=["arm"])
    body.mass.requires_grad_()
    with refused("arm.mass"):
        mbd.simulate(system, 0.01, steps=4)


def test_a_laminate_registers_the_parameter_that_it_is_given():
    angles, thickness = parameter(0.3, -0.8), parameter(1e-3, 2e-3)
    own = mbd.Laminate(mbd.Ply(**CARBON), angles, thickness)
    assert own.angles is angles
    assert own.thickness is thickness
    assert own.thickness.requires_grad
    own.stiffness().A.sum().backward()
    assert angles.grad is not None
    assert thickness.grad is not None
    section = mbd.sections.rectangle(0.1, 0.2, STEEL)
    again = mbd.sections.Section(section.mesh, STEEL, angles=(one := parameter(0.1)))
    assert again.angles is one


def test_a_laminate_refuses_what_is_computed_and_the_advice_is_right():
    net = nn.Linear(2, 3, dtype=torch.float64)
    x = net(tensor(0.3, -0.4))
    for angles in (x, tensor(0.1, 0.2, 0.3).requires_grad_(), [x[0], 0.1, 0.2]):
        with refused("angles"):
            mbd.Laminate(mbd.Ply(**CARBON), angles, 1e-3)
    with refused("thickness"):
        mbd.Laminate(mbd.Ply(**CARBON), [0.1, 0.2, 0.3], x.exp())
    with refused("angles"):
        mbd.Laminate(mbd.Ply(**CARBON), nn.Parameter(torch.zeros(3)), 1e-3)
    own = mbd.Laminate(mbd.Ply(**CARBON), x.detach(), 1e-3)
    own.stiffness().D.sum().backward()
    x.backward(own.angles.grad)
    result = net.bias.grad
    again = mbd.Laminate(mbd.Ply(**CARBON), x.detach(), 1e-3)
    D = torch.func.functional_call(again, {"angles": net(tensor(0.3, -0.4))}).sum()  # all of A, B, D, As
    assert result is not None
    assert D.requires_grad
    assert_close(result, own.angles.grad)  # the bias has the slope one


REFUSED: dict[str, Callable[[Any], Any]] = {
    "mass": lambda v: mbd.RigidBody("b", 2.0 * v, (1.0, 1.0, 1.0)),
    "inertia": lambda v: mbd.RigidBody("b", 1.0, (v, 1.0, 1.0)),
    "center": lambda v: mbd.RigidBody("b", 1.0, (1.0, 1.0, 1.0), center=(0.0, v, 0.0)),
    "position": lambda v: mbd.RigidBody("b", 1.0, (1.0, 1.0, 1.0), position=[v, 0.0, 0.0]),
    "velocity": lambda v: mbd.RigidBody("b", 1.0, (1.0, 1.0, 1.0), velocity=(v, 0.0, 0.0)),
    "angular_velocity": lambda v: mbd.RigidBody("b", 1.0, (1.0, 1.0, 1.0), angular_velocity=(v, 0.0, 0.0)),
    "axes": lambda v: mbd.RigidBody("b", 1.0, (1.0, 1.0, 1.0), axes=[[v, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    "axes ": lambda v: box("b").at(axes=[[v, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    "a frame": lambda v: mbd.Frame(box("b"), torch.stack([v, v, v])),
    "offset": lambda v: plate("p").at("left", offset=(v, 0.0, 0.0)),
    "weights": lambda v: plate("p").at([0, 1], weights=[v, 1.0]),
    "velocity ": lambda v: plate("p").moving((v, 0.0, 0.0)),
    "p.damping.ratio": lambda v: plate("p").damped([v, v, v]),
    "length": lambda v: mbd.DistanceJoint(GROUND.at(), box("b").at(), length=v),
    "gravity": lambda v: mbd.System([box("b")], gravity=(0.0, 0.0, v), free=["b"]),
    "stabilization": lambda v: mbd.System([box("b")], stabilization=v, free=["b"]),
    "nodes": lambda v: mbd.BeamLine([[0.0, 0.0, 0.0], [v, 0.0, 0.0]]),
    "middles": lambda v: mbd.BeamLine([[0.0] * 3, [1.0, 0.0, 0.0]], middles=[[v, 0.0, 0.0]]),
    "BeamLine.arc.radius": lambda v: mbd.BeamLine.arc(v, 1.0),
    "nodes ": lambda v: mbd.Mesh(SQUARE.nodes * v, SQUARE.triangles),
    "length ": lambda v: mbd.mesh.rectangle(length=v, width=0.1, cells=(2, 2)),
    "section.stiffness": lambda v: mbd.GivenSection(v * torch.eye(6), torch.eye(6)),
    "box.angles": lambda v: mbd.sections.box(0.1, 0.1, STEEL, [v], 1e-3),
    "direction": lambda v: mbd.Pressure(plate("p"), 1.0, direction=(v, 0.0, 0.0)),
    "knots": lambda v: mbd.forces.Table(((0.0, 0.0), (1.0, v))),
    "a number of Pieces": lambda v: mbd.forces.Pieces((0.0,), (0.0, v), (1.0, 1.0), 0.1),
    "stiffness ": lambda v: mbd.forces.Gap(v),
    "time of AtTime": lambda v: mbd.AtTime(mbd.StrainEnergy("p"), time=v),
    "times of AtTimes": lambda v: mbd.AtTimes(mbd.StrainEnergy("p"), times=[0.0, v]),
    "window of Integral": lambda v: mbd.Integral(mbd.StrainEnergy("p"), window=(0.0, v)),
    "sharpness of Aggregate": lambda v: mbd.Aggregate(mbd.Max(mbd.StrainEnergy("p")), sharpness=v, scale=1.0),
    "sharpness": lambda v: mbd.SmoothMax(mbd.StrainEnergy("p"), sharpness=v, scale=1.0),
    "limit of Constraint": lambda v: mbd.Max(mbd.StrainEnergy("p")) <= v,
    "terms of Total": lambda v: v * mbd.Max(mbd.StrainEnergy("p")),
    "terms of WeightedSum": lambda v: mbd.WeightedSum([(v, mbd.Mass())]),
    "center of Angle": lambda v: mbd.Angle("p", "z", center=v),
    "point of Position": lambda v: mbd.Position("b", "x", point=(v, 0.0, 0.0)),
}


@pytest.mark.parametrize("name", REFUSED)
@pytest.mark.parametrize("kind", ["variable", "computed"])
def test_a_number_without_a_gradient_refuses_a_variable(name, kind):
    v = mbd.variable(1.0)
    with pytest.raises(mbd.InputError, match=name.strip()):
        REFUSED[name](v if kind == "variable" else 2.0 * v)


def of_motions(k: Any) -> dict[str, Callable[[], Any]]:
    """Return calls of functions of a motion that read k: a response, an event, an impact."""
    body = box("b")
    system = mbd.System([body], gravity=(0.0, 0.0, -9.81), free=["b"])
    motion = mbd.simulate(system, 0.02, steps=4)

    def falls(**options: Any) -> Callable[[], Any]:
        event = mbd.Event(options.pop("function", mbd.Position("b", "z") + 5e-4))
        phases = [mbd.Phase(until=event, **options), mbd.Phase()]
        return lambda: mbd.simulate(system, 0.02, steps=4, phases=phases)

    return {
        "response.<lambda>": lambda: mbd.history(lambda motion: k * motion.body("b").r[..., 0])(motion),
        "response.scaled": lambda: mbd.measure(functools.partial(scaled_mass, k))(motion),
        "phases.until.function": falls(function=lambda motion: motion.body("b").r[..., 2] + 5e-4 * k),
        "phases.impact": falls(impact=lambda motion: -k * motion.v),
    }


def scaled_mass(k: Any, motion: Any) -> Tensor:
    return k * motion.body("b").r[:, -1, 0]


@pytest.mark.parametrize("name", of_motions(1.0))
def test_a_function_of_a_motion_that_reads_a_parameter_is_refused_where_it_is_called(name):
    of_motions(torch.tensor(1.0, dtype=torch.float64))[name]()
    argument = name.replace("scaled", "scaled_mass")
    for k in (mbd.variable(1.0), 2.0 * mbd.variable(0.5)):
        with refused(argument):
            of_motions(k)[name]()


@pytest.mark.parametrize("gradients", ["forward", "reverse"])
def test_a_response_of_a_design_that_reads_its_parameter_itself_is_refused(gradients):
    k = mbd.variable(2.0)
    body = box("b")
    spring = mbd.SpringDamper(GROUND.at(), body.at(0.1, 0.0, 0.0), stiffness=k, name="spring")
    system = mbd.System([body], forces=[spring], free=["b"])
    motion = mbd.simulate(system, 0.01, steps=4, gradients=gradients)
    force = mbd.measure(lambda motion: k * motion.body("b").r[:, -1, 0])
    with refused("response.<lambda>"):
        force.value_and_gradient(motion)
    allowed = mbd.measure(lambda motion: motion.designs["spring.stiffness"] * motion.body("b").r[:, -1, 0])
    assert allowed.value_and_gradient(motion).gradient is not None


def test_a_law_may_take_the_number_of_a_parameter():
    body = box("arm")
    for law in (lambda s, rate, t: -K.detach() * s, lambda s, rate, t: -K.item() * s):
        mbd.SpringDamper(GROUND.at(), body.at(0.1, 0.0, 0.0), law=law)


TAKEN: dict[str, Callable[[Any], Any]] = {
    "damping": lambda v: plate("p", damping=v),
    "p.damping.rate": lambda v: plate("p").damped(rate=v),
    "b.point": lambda v: box("b").at(v, 0.0, 0.0),
    "BeamLine.straight.length": lambda v: mbd.BeamLine.straight(v),
    "point": lambda v: GROUND.at(0.0, v, 0.0),
    "GivenSection.isotropic.E": lambda v: mbd.GivenSection.isotropic(v, 0.3, 1.0, 1.0, 1.0, 1.0, 1.0),
    "E1": lambda v: mbd.Ply(v, 0.5, *[0.2] * 3, nu12=0.2, density=1e3),
    "rectangle.width": lambda v: mbd.sections.rectangle(v, 0.2, STEEL, cells=(1, 1)),
    "box.height": lambda v: mbd.sections.box(0.1, v, STEEL, [0.0], 1e-3, cells=(1, 1, 1)),
    "i_section.thickness": lambda v: mbd.sections.i_section(
        3.0, 4.0, STEEL, dict.fromkeys(("top", "web", "bottom"), (0.0,)), v, cells=(1, 1, 1)
    ),
    "tube.radius": lambda v: mbd.sections.tube(v, STEEL, [0.0], 1e-3, cells=(8, 1)),
    "circle.radius": lambda v: mbd.sections.circle(v, STEEL, cells=(1, 1)),
    "E3": lambda v: mbd.sections.Orthotropic(1.0, 1.0, v, *[1.0] * 3, *[0.1] * 3, density=1e3),
    "Xt": lambda v: mbd.Strength(Xt=v, Xc=1.0, Yt=1.0, Yc=1.0, S12=1.0),
}


@pytest.mark.parametrize("name", TAKEN)
@pytest.mark.filterwarnings("ignore:units of")
def test_a_variable_is_taken_and_what_is_computed_of_one_is_refused(name):
    v = mbd.variable(1.0)
    TAKEN[name](v)
    wrong = [2.0 * v, v.detach().clone().requires_grad_(), nn.Parameter(v.detach().float())]
    for x in wrong if name == "i_section.thickness" else [*wrong, parameter(1.0)]:  # one thickness of one ply is right
        with pytest.raises(mbd.InputError, match=rf"(?s){name}.*(mbd\.variable|dtype=torch\.float64)"):
            TAKEN[name](x)


def test_numbers_without_gradients_are_taken_as_before():
    half = torch.tensor(0.5, dtype=torch.float64)
    assert box("b").at(half, 0.0, 0.0).point[0] == 0.5
    assert mbd.AtTime(mbd.StrainEnergy("p"), time=0.5).until == 0.5
    body = box("arm")
    k, frozen = tensor(3.0)[0], Net().requires_grad_(False)
    for law in (lambda s, rate, t: -k * s, lambda s, rate, t: frozen(s), Holder(k), functools.partial(scaled, k)):
        mbd.SpringDamper(GROUND.at(), body.at(), law=law)
    assert laminate().angles.requires_grad
