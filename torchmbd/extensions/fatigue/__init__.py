"""Fatigue: cycles of a history by rainflow, equivalent loads, damage of histories and of plies, S-N curves."""

from torchmbd.extensions.fatigue.damage import Damage, EquivalentLoad, FatigueDamage
from torchmbd.extensions.fatigue.rainflow import rainflow
from torchmbd.extensions.fatigue.sn_curve import SNCurve

__all__ = ["Damage", "EquivalentLoad", "FatigueDamage", "SNCurve", "rainflow"]
