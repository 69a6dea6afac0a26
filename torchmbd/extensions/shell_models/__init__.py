"""Laminated shells made here as models of other programs: Nastran, Abaqus, CalculiX."""

from torchmbd.extensions.shell_models.writer import write_model

__all__ = ["write_model"]
