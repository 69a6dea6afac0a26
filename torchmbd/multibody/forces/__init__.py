"""Applied forces: lists of actions between frames. A new force element is one file and one line here."""

from torchmbd.multibody.forces.bushing import Bushing
from torchmbd.multibody.forces.control_history import ControlHistory
from torchmbd.multibody.forces.controller import Controller
from torchmbd.multibody.forces.force import ForceElement
from torchmbd.multibody.forces.laws import Gap, OfTime, Pieces, Scaled, Spring, Table
from torchmbd.multibody.forces.load import Force, Torque
from torchmbd.multibody.forces.pressure import Pressure
from torchmbd.multibody.forces.spring_damper import AxialSpringDamper, RotationalSpringDamper, SpringDamper

FORCES: dict[str, type[ForceElement]] = {
    kind.__name__.lower(): kind
    for kind in (AxialSpringDamper, Bushing, Controller, Force, Pressure, RotationalSpringDamper, SpringDamper, Torque)
}

__all__ = [
    "FORCES",
    "AxialSpringDamper",
    "Bushing",
    "ControlHistory",
    "Controller",
    "Force",
    "ForceElement",
    "Gap",
    "OfTime",
    "Pieces",
    "Pressure",
    "RotationalSpringDamper",
    "Scaled",
    "Spring",
    "SpringDamper",
    "Table",
    "Torque",
]
