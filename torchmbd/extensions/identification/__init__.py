"""Identification: unknowns of a model from what was measured, with exact Jacobians, in Python and in experiment files.

>>> channel = mbd.identification.Channel(mbd.Position("bob", "x"), deviation=1e-3)  # measured with an error of 1 mm
"""

from torchmbd.extensions.identification.channel import Channel
from torchmbd.extensions.identification.experiment import Experiment
from torchmbd.extensions.identification.figure import data_and_model
from torchmbd.extensions.identification.frequency_response_data import FrequencyResponseData
from torchmbd.extensions.identification.identification import Identification
from torchmbd.extensions.identification.identify import identify
from torchmbd.extensions.identification.kind import IDENTIFY as IDENTIFY
from torchmbd.extensions.identification.modal_data import ModalData
from torchmbd.extensions.identification.static_curve import StaticCurve
from torchmbd.extensions.identification.time_series import TimeSeries

__all__ = [
    "Channel", "Experiment", "FrequencyResponseData", "Identification", "ModalData", "StaticCurve", "TimeSeries",
    "data_and_model", "identify",
]  # fmt: skip


def __dir__() -> list[str]:
    return [*__all__]
