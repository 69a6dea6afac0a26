"""Controllers: any torch module from signals of the motion to forces and torques, its weights design variables.

pd = mbd.Controller(
    torch.nn.Linear(2, 1, dtype=torch.float64),
    inputs=[mbd.signals.JointAngle(hinge), mbd.signals.JointRate(hinge)],
    outputs=[mbd.signals.JointTorque(hinge)],
)
system = mbd.System(bodies, [hinge], forces=[pd])       has the parameters controller.weight, controller.bias
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torchmbd.errors import InputError, user_line
from torchmbd.math.checked_numbers import list_of
from torchmbd.math.gradients import refuse_lost_gradients
from torchmbd.math.variable import ParameterVector
from torchmbd.multibody.bodies.rigid import Ground
from torchmbd.multibody.forces.feedback import Control, Port
from torchmbd.multibody.forces.force import Applied, ForceElement
from torchmbd.multibody.forces.signals import Actuator, Coordinate, Signal
from torchmbd.multibody.joints.joint import AttachmentTable

# What of a controller may be a design variable; part of messages.
VARIABLES = "parameters of the module; constant tensors"


class Controller(ForceElement):
    """Feedback u = module(x): the module reads signals of the motion and sets forces and torques.

    module    a torch module, x [lanes, inputs] -> u [lanes, outputs], float64, a function of its inputs alone
    inputs    signals (mbd.signals): each is one number of x, a position or velocity three, in this order
    outputs   actuators (mbd.signals): each takes one number of u, a force [N] or a torque [N m]
    name      of the element; parameters of the system have it too

    The parameters of the module are parameters of the system, "controller.<name>". Native code calls the module in every step.

    >>> arm = mbd.RigidBody("arm", 1.0, (0.01, 0.02, 0.02))
    >>> hinge = mbd.Revolute(mbd.Ground().at(), arm.at(), axis="z")
    >>> gains = torch.nn.Linear(2, 1, bias=False).double()
    >>> inputs = [mbd.signals.JointAngle(hinge), mbd.signals.JointRate(hinge)]
    >>> servo = mbd.Controller(gains, inputs, [mbd.signals.JointTorque(hinge)], name="servo")
    >>> [name for name, _ in mbd.System([arm], [hinge], [servo]).named_parameters()]
    ['servo.weight']
    """

    def __init__(
        self, module: nn.Module, inputs: Sequence[Signal], outputs: Sequence[Actuator], name: str = "controller"
    ):
        if not isinstance(module, nn.Module):
            raise InputError("module", module, "a torch.nn.Module", noun="module of a Controller")
        self.inputs = list_of("inputs", inputs, Signal, "signals, such as mbd.signals.JointAngle(joint)")
        self.outputs = list_of("outputs", outputs, Actuator, "actuators, such as mbd.signals.JointTorque(joint)")
        if not self.outputs:
            raise InputError((name, "outputs"), outputs, "must contain at least one actuator", state="is empty")
        frames = tuple(frame for x in self.outputs for frame in x.frames)
        super().__init__(tuple(frame for frame in frames if not isinstance(frame.body, Ground))[:1], name)
        self.frames, self.measured = frames, tuple(frame for x in self.inputs for frame in x.frames)
        self.module = module
        self.control = Control(self.name, module, sum(x.size for x in self.inputs), len(self.outputs))
        _check(self.control)

    @property
    def variables(self) -> ParameterVector | None:
        return self.control.variables

    def actions(self, attachments: AttachmentTable) -> Iterator[Applied]:
        reads: dict[tuple, list[tuple[int, bool]]] = {}
        coordinates = [x for signal in self.inputs for x in signal.coordinates(attachments)]
        for row, x in enumerate(coordinates):
            if isinstance(x, Coordinate):
                reads.setdefault((x.kind, x.vectors, x.center), []).append((row, x.rate))
        for (kind, vectors, center), rows in reads.items():
            yield Applied(kind, vectors, Port(self.control, reads=tuple(rows), center=center))
        for k, x in enumerate(self.outputs):
            for kind, vectors, sign in x.efforts(attachments):
                yield Applied(kind, vectors, Port(self.control, writes=k, sign=sign))


def _check(control: Control) -> None:
    """InputError for a module that cannot be a controller, or whose parameters would get no gradient."""
    for name, p in control.module.named_parameters():
        if p.dtype != torch.float64:
            raise InputError(
                (control.label, name),
                allowed="torch.float64",
                noun=f"parameter {name!r}",
                state=f"of the {control.label} is {p.dtype}",
                hint=".double()",
            )
    with torch.inference_mode(False), torch.enable_grad():
        x = torch.randn(1, control.inputs, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        for at in (torch.zeros_like(x), x):
            u = _called(control, at)
            if not bool(torch.isfinite(u).all()):
                raise InputError(
                    control.label,
                    allowed="must give finite numbers",
                    state=f"gives {u.tolist()[0]} at inputs {at.tolist()[0]}, t = 0",
                )
        if not torch.equal(u, _called(control, x)):
            raise InputError(
                control.label,
                allowed="must give the same numbers",
                hint=".eval()",
                state="gives other numbers when it is called again with the same inputs",
            )
        _check_gradients(control, x)


def _check_gradients(control: Control, x: Tensor) -> None:
    x = x.requires_grad_()
    u = _called(control, x)
    parameters = {name: p for name, p in control.module.named_parameters() if p.requires_grad}
    refuse_lost_gradients(control.label, u, VARIABLES, [x, *parameters.values()])
    by: Any = [None] * (1 + len(parameters))
    if u.requires_grad:
        by = torch.autograd.grad(u.sum(), [x, *parameters.values()], allow_unused=True)
    lost = [name for name, slope in zip(parameters, by[1:], strict=True) if slope is None]
    if lost:
        raise InputError(
            control.label,
            allowed="must have an output that depends on these parameters",
            state=f"has an output that does not depend on its parameters {', '.join(map(repr, lost))} at t = 0, "
            "so they get no gradient",
            hint="requires_grad_(False)",
        )
    if by[0] is None and control.inputs and not torch.allclose(u, _called(control, x + 1e-6), rtol=1e-12, atol=0.0):
        raise InputError(
            control.label,
            allowed="must use torch operations on the inputs, without detach() or numpy()",
            state="returns an output that does not depend on its inputs through torch",
        )


def _called(control: Control, x: Tensor) -> Tensor:
    try:
        u = control.module(x)
    except Exception as error:  # a module of users may raise any error
        raise InputError(
            control.label,
            allowed="a map x [lanes, inputs] -> [lanes, outputs]",
            state=f"raises {error!r} in {user_line(error)} for x {list(x.shape)}",
        ) from error
    control.check(u, 1, 0.0)
    return u
