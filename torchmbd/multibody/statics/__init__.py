"""Bodies on supports: natural frequencies."""

from torchmbd.multibody.statics.vibrations import VibrationCase, Vibrations, frequencies

__all__ = ["VibrationCase", "Vibrations", "frequencies"]
