"""Flexible bodies out of Nastran models (bulk data), and their optimized plies in the same decks."""

from torchmbd.extensions.nastran.reader import read_bdf
from torchmbd.extensions.nastran.writer import write_bdf

__all__ = ["read_bdf", "write_bdf"]
