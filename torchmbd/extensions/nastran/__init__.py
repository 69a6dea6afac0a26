"""Flexible bodies out of Nastran models (bulk data)."""

from torchmbd.extensions.nastran.reader import read_bdf

__all__ = ["read_bdf"]
