"""Bodies on supports: natural frequencies."""

from torchmbd.multibody.statics.vibrations import NaturalModes, VibrationCase, natural_frequencies

__all__ = ["NaturalModes", "VibrationCase", "natural_frequencies"]
