"""Local searches from many starts."""

from torchmbd.optimization.multistart.run import MultistartResult, multistart

__all__ = ["MultistartResult", "multistart"]
