"""Applied forces: lists of actions between frames. A new force element is one file and one line here."""

from torchmbd.forces.bushing import Bushing
from torchmbd.forces.control_history import ControlHistory
from torchmbd.forces.controller import Controller
from torchmbd.forces.force import ForceElement
from torchmbd.forces.laws import Gap, OfTime, Pieces, Scaled, Spring, Table
from torchmbd.forces.load import Force, Torque
from torchmbd.forces.pressure import Pressure
from torchmbd.forces.spring_damper import AxialSpringDamper, RotationalSpringDamper, SpringDamper

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
