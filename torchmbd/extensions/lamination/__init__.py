"""Lamination parameters: laminates without plies, the region of parameters that stacks have, and stacks for parameters.

>>> mbd.lamination.LaminationRules(symmetric=True, balanced=True).symmetric
True
"""

from torchmbd.extensions.lamination.blended_stacks import recover_blended_stacks
from torchmbd.extensions.lamination.parameters import LaminationParameters
from torchmbd.extensions.lamination.region import LaminationRegion
from torchmbd.extensions.lamination.rules import LaminationRules
from torchmbd.extensions.lamination.stack_recovery import recover_stacks

__all__ = ["LaminationParameters", "LaminationRegion", "LaminationRules", "recover_blended_stacks", "recover_stacks"]


def __dir__() -> list[str]:
    return [*__all__]
