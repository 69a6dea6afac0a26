"""Numbers of a system that are being differentiated, but are no design variables: refused by name.

Checked in tests/sensitivity/test_refused_gradients.py.
"""

from __future__ import annotations

from typing import Any

from torchmbd.errors import InputError
from torchmbd.math.gradients import is_differentiated, refuse_lost_gradients
from torchmbd.multibody.bodies.frame import MODAL, VELOCITIES
from torchmbd.multibody.forces.controller import VARIABLES as OF_CONTROLLERS
from torchmbd.multibody.forces.feedback import Port
from torchmbd.multibody.forces.laws import VARIABLES as OF_FORCES
from torchmbd.multibody.joints.drive import VARIABLES as OF_DRIVES

_CONSTANTS = ("axes",)  # numbers of bodies that cannot be design variables
_VARIABLES = ("gravity", "mass", "center", "inertia", "position", *VELOCITIES, *MODAL)  # those that can, as Parameters


def refuse_lost_constants(system: Any) -> None:
    """InputError for numbers of a system and its bodies that are differentiated and have no gradient."""
    for owner in (system, *system.bodies):
        for name in (*_CONSTANTS, *_VARIABLES):
            x = owner._buffers.get(name, owner._parameters.get(name) if name in _CONSTANTS else None)
            if x is not None and (name in owner._parameters or x.requires_grad or is_differentiated(x)):
                label = name if owner is system else f"{owner.name}.{name}"
                allowed = "a tensor that requires none"
                if name in _VARIABLES:
                    allowed += ", or a Parameter given to the constructor"
                raise InputError(f"{label!r} is a constant: it has no gradient; allowed: {allowed}")


def refuse_lost_laws(system: Any) -> None:
    """InputError for laws of a system with a tensor whose gradient would be lost."""
    for kind in system.topology.actions:
        for law in kind.laws:
            if isinstance(law, Port):
                refuse_lost_gradients(law.control.label, law.control.module, OF_CONTROLLERS, law.control.module)
            else:
                refuse_lost_gradients("law of a force", law, OF_FORCES)
    for joint in system.joints:
        registered = joint.variables.module if joint.variables else None
        refuse_lost_gradients(f"law of {joint.name!r}", getattr(joint, "law", None), OF_DRIVES, registered)
