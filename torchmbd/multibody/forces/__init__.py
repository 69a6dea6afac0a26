"""Applied forces: lists of actions between frames. A new force element is one file and one line here.

Laws of springs are here too: Friction, Gap, Table, Pieces, Scaled.

>>> stop = mbd.forces.Gap(stiffness=1e4, limit=0.1, sign=-1.0)  # it acts where s > 0.1 m
>>> [round(stop(torch.tensor(s), torch.tensor(0.0), 0.0).item()) for s in (0.05, 0.11)]  # [N]
[0, -100]
"""

from torchmbd.multibody.forces.beam_element import BeamElement
from torchmbd.multibody.forces.bushing import Bushing
from torchmbd.multibody.forces.contact import AxialStop, PlaneContact, RotationalStop
from torchmbd.multibody.forces.control_history import ControlHistory
from torchmbd.multibody.forces.controller import Controller
from torchmbd.multibody.forces.force import ForceElement
from torchmbd.multibody.forces.laws import Friction, Gap, OfTime, Pieces, Scaled, Spring, Table
from torchmbd.multibody.forces.load import Force, Torque
from torchmbd.multibody.forces.pressure import Pressure
from torchmbd.multibody.forces.spring_damper import AxialSpringDamper, RotationalSpringDamper, SpringDamper
from torchmbd.multibody.forces.temperature import Temperature

FORCES: dict[str, type[ForceElement]] = {
    kind.__name__.lower(): kind
    for kind in (
        AxialSpringDamper,
        AxialStop,
        BeamElement,
        Bushing,
        Controller,
        Force,
        PlaneContact,
        Pressure,
        RotationalSpringDamper,
        RotationalStop,
        SpringDamper,
        Temperature,
        Torque,
    )
}

__all__ = [
    "FORCES",
    "AxialSpringDamper",
    "AxialStop",
    "BeamElement",
    "Bushing",
    "ControlHistory",
    "Controller",
    "Force",
    "ForceElement",
    "Friction",
    "Gap",
    "OfTime",
    "Pieces",
    "PlaneContact",
    "Pressure",
    "RotationalSpringDamper",
    "RotationalStop",
    "Scaled",
    "Spring",
    "SpringDamper",
    "Table",
    "Temperature",
    "Torque",
]


def __dir__() -> list[str]:
    return [*__all__]
