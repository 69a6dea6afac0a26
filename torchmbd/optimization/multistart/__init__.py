"""Local searches from many starts."""

from torchmbd.optimization.multistart.study import Study, multistart

__all__ = ["Study", "multistart"]
