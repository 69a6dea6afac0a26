"""Controllers that are refused: modules that give wrong numbers or no gradients, by name, and wrong arguments."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

import torchmbd as mbd
from tests.mechanisms import tensor
from tests.multibody.forces.test_controller import GROUND, S, hinged, linear, sliding
from tests.refused import refused
from torchmbd.errors import InputError


class Given(nn.Module):
    """A module of a function and one weight."""

    def __init__(self, function) -> None:
        super().__init__()
        self.function, self.weight = function, nn.Parameter(tensor(1.0)[0])

    def forward(self, x: Tensor) -> Tensor:
        return self.function(x, self.weight)


SECRET = torch.ones((), dtype=torch.float64, requires_grad=True)
BAD = {
    "shape": (
        lambda x, w: w * x[:, 0],
        r"module Given of the controller 'pd' gives torch.float64 \[1\].* t = 0 s.*\[1, 1\]",
    ),
    "number": (lambda x, w: 3.0, "gives 3.0"),
    "single": (lambda x, w: (w * x[:, :1]).float(), "gives torch.float32"),
    "nan": (lambda x, w: w * x[:, :1] / x[:, :1].square(), "'pd' gives .nan. at inputs .*t = 0"),
    "detached": (lambda x, w: (w * x[:, :1]).detach(), "does not depend on its parameters 'weight'"),
    "unused": (lambda x, w: x[:, :1], "does not depend on its parameters 'weight'"),
    "inputs": (lambda x, w: w * x.detach()[:, :1], "does not depend on its inputs"),
    "random": (
        lambda x, w: w * x[:, :1] + torch.rand(1, 1, dtype=torch.float64),
        "other numbers when it is called again",
    ),
    "raises": (lambda x, w: w * x[:, :7] @ x, "raises"),
    "lost": (lambda x, w: w * SECRET * x[:, :1], r"tensor\(1\., .*requires_grad=True\)"),
}


@pytest.mark.parametrize("case", BAD)
def test_modules_that_are_refused(case):
    function, said = BAD[case]
    _, joint = hinged()
    with pytest.raises(InputError, match=said):
        mbd.Controller(Given(function), [S.JointAngle(joint), S.JointRate(joint)], [S.JointTorque(joint)], "pd")


def test_a_module_that_goes_wrong_later():
    def late(x: Tensor, w: Tensor) -> Tensor:
        return w * x[:, :1] if len(seen) < 8 else (w * x[:, :1]).detach()

    seen: list[int] = []
    body, joint = hinged()
    control = mbd.Controller(Given(late), [S.JointAngle(joint)], [S.JointTorque(joint)], "pd")
    system = mbd.System([body], [joint], [control])
    seen.extend(range(9))
    with refused("module Given of the controller 'pd'"):
        mbd.simulate(system, 0.01, steps=2).q.sum().backward()


def test_arguments_that_are_refused():
    body, joint = hinged()
    _, rail = sliding()
    one = linear((1.0,))
    for make, path in (
        (lambda: mbd.Controller(torch.sin, [S.Time()], [S.JointTorque(joint)]), "module"),
        (lambda: mbd.Controller(one, [joint], [S.JointTorque(joint)]), "inputs"),
        (lambda: mbd.Controller(one, [S.Time()], []), "controller.outputs"),
        (lambda: mbd.Controller(one, [S.Time()], [S.Time()]), "outputs"),
        (
            lambda: mbd.Controller(nn.Linear(1, 1), [S.Time()], [S.JointTorque(joint)]),
            "module Linear of the controller 'controller'.weight",
        ),
        (lambda: S.JointAngle(rail), "joint"),
        (lambda: S.JointForce(joint), "joint"),
        (lambda: S.PointPosition(body), "frame"),
        (lambda: S.ForceOn(GROUND.at()), "frame"),
        (lambda: S.ForceOn(body.at(), "w"), "axis"),
        (lambda: S.ForceOn(body.at(), "x", axes="body"), "axes"),
        (lambda: S.TorqueOn(body.at(), body.at(), "x"), "b"),
        (lambda: mbd.ControlHistory(torch.ones(3), 1.0), "values"),
        (lambda: mbd.ControlHistory(torch.ones(3, 1), -1.0), "duration"),
        (lambda: mbd.ControlHistory(torch.ones(3, 1), 1.0, "cubic"), "kind"),
        (
            lambda: mbd.System([body], [joint], [mbd.Controller(one, [S.JointTravel(rail)], [S.JointTorque(joint)])]),
            "forces.controller",
        ),
    ):
        with refused(path):
            make()


def test_controllers_of_one_name_are_refused():
    body, joint = hinged()
    two = [mbd.Controller(linear((1.0,)), [S.JointRate(joint)], [S.JointTorque(joint)]) for _ in range(2)]
    with refused("controller"):
        mbd.System([body], [joint], two)
