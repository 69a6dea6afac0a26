"""Blades of wind turbines in windIO files."""

from torchmbd.io.windio.blade import WindIOBlade

__all__ = ["WindIOBlade"]
