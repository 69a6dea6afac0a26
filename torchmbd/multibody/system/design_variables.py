"""Design variables of a system: tangents of the structure stage by them, and refusals of other numbers with a gradient.

Tangents are one linearization, evaluated along all directions at once.
Checked in tests/multibody/system/test_system.py, tests/sensitivity/test_gradients.py,
tests/sensitivity/test_refused_gradients.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.math.forward_mode import jvp
from torchmbd.math.gradients import is_differentiated, refuse_lost_gradients
from torchmbd.math.pair import Pair
from torchmbd.multibody.bodies.frame import MODAL, VELOCITIES
from torchmbd.multibody.forces.controller import VARIABLES as OF_CONTROLLERS
from torchmbd.multibody.forces.controller import Controller
from torchmbd.multibody.forces.feedback import Port
from torchmbd.multibody.forces.laws import VARIABLES as OF_FORCES
from torchmbd.multibody.forces.parametric_law import is_library_law
from torchmbd.multibody.joints.drive import VARIABLES as OF_DRIVES

_CONSTANTS = ("axes",)  # numbers of bodies that cannot be design variables
_VARIABLES = ("gravity", "mass", "center", "inertia", "position", *VELOCITIES, *MODAL)  # those that can, as Parameters


def unit_directions(parameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Unit directions [n_b, lanes, ...], one for each entry of the parameters [lanes, ...], the same in all lanes."""
    sizes = {name: x[0].numel() for name, x in parameters.items()}
    total, start = sum(sizes.values()), 0
    directions = {}
    for name, x in parameters.items():
        unit = torch.zeros(total, sizes[name], dtype=x.dtype, device=x.device)
        unit[start : start + sizes[name]] = torch.eye(sizes[name], dtype=x.dtype, device=x.device)
        directions[name] = unit.reshape(total, 1, *x.shape[1:]).expand(total, *x.shape)
        start += sizes[name]
    return directions


def tangents_of(stage: Any, parameters: dict[str, Tensor]) -> dict[str, Any]:
    """Values and tangents of the structure stage by the `parameters` [lanes, ...], as pairs.

    A quantity whose tangents are zero in all lanes and directions becomes a plain tensor, which costs less in the steps.
    """

    def push(direction: dict[str, Tensor]) -> tuple:
        return jvp(stage, (parameters,), (direction,))

    values, tangents = torch.func.vmap(push, out_dims=(None, 0))(unit_directions(parameters))  # pyright: ignore[reportArgumentType]
    result: dict[str, Any] = {}
    for name, x in values.items():
        dx = tangents[name].movedim(0, -1).squeeze(-3).movedim(-1, -2)
        result[name] = Pair.of(x, dx) if bool(dx.any()) else x
    return result


def refuse_lost_constants(system: Any) -> None:
    """InputError for numbers of a system and its bodies that are differentiated and have no gradient."""
    for owner in (system, *system.bodies):
        for name in (*_CONSTANTS, *_VARIABLES):
            x = owner._buffers.get(name, owner._parameters.get(name) if name in _CONSTANTS else None)
            if x is not None and (name in owner._parameters or x.requires_grad or is_differentiated(x)):
                label = name if owner is system else f"{owner.name}.{name}"
                allowed = "a tensor that does not require a gradient"
                if name in _VARIABLES:
                    allowed += ", or a Parameter given to the constructor"
                raise InputError(
                    (label,),
                    allowed=allowed,
                    state="requires a gradient, but torchmbd takes it as a constant",
                    noun=f"{label!r}",
                )


def refuse_lost_laws(system: Any) -> None:
    """InputError for laws of users that read a tensor whose gradient would be lost."""
    with torch.inference_mode(False), torch.enable_grad():
        for control in (force.control for force in system.forces if isinstance(force, Controller)):
            u = control.module(torch.zeros(1, control.inputs, dtype=torch.float64))
            refuse_lost_gradients(control.label, u, OF_CONTROLLERS, control.module.parameters())
        zero = torch.zeros(1, 1, 1, dtype=torch.float64)
        for law in {id(law): law for kind in system.topology.actions for law in kind.laws}.values():
            if not isinstance(law, Port) and not is_library_law(law):
                refuse_lost_gradients("law of a force", law(zero, zero, zero[0, 0, 0]), OF_FORCES)
        for joint in system.joints:
            law = getattr(joint, "law", None)
            if callable(law):
                registered = joint.variables.module.parameters() if joint.variables else ()
                start = law(torch.zeros((), dtype=torch.float64))
                refuse_lost_gradients((joint.name, "law"), start, OF_DRIVES, registered)
