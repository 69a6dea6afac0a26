"""Robots and mechanisms out of files: the Unified Robot Description Format, and MuJoCo's format."""

from torchmbd.extensions.robots.readers import read_mjcf, read_urdf

__all__ = ["read_mjcf", "read_urdf"]
