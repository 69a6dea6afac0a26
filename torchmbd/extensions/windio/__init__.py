"""Blades of wind turbines in windIO files."""

from torchmbd.extensions.windio.blade import read_windio

__all__ = ["read_windio"]
