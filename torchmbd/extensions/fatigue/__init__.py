"""Fatigue: cycles of a history by rainflow, equivalent loads, damage of histories and of plies, S-N curves.

>>> mbd.fatigue.SNCurve([(1e3, 4e8), (1e6, 2e8)]).points  # cycles, amplitude [Pa]
((1000.0, 400000000.0), (1000000.0, 200000000.0))
"""

from torchmbd.extensions.fatigue.damage import Damage, EquivalentLoad, FatigueDamage
from torchmbd.extensions.fatigue.rainflow import rainflow
from torchmbd.extensions.fatigue.sn_curve import SNCurve

__all__ = ["Damage", "EquivalentLoad", "FatigueDamage", "SNCurve", "rainflow"]


def __dir__() -> list[str]:
    return [*__all__]
