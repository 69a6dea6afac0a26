"""Identification: unknowns of a model from what was measured, with exact Jacobians."""

from torchmbd.identification.channel import Channel
from torchmbd.identification.channel_fit import ChannelFit
from torchmbd.identification.experiment import Experiment
from torchmbd.identification.frequency_response_data import FrequencyResponseData
from torchmbd.identification.identification import Identification
from torchmbd.identification.identify import identify
from torchmbd.identification.measurement import Measurement
from torchmbd.identification.modal_data import ModalData
from torchmbd.identification.registry import MEASUREMENTS
from torchmbd.identification.static_curve import StaticCurve
from torchmbd.identification.time_series import TimeSeries

__all__ = [
    "MEASUREMENTS", "Channel", "ChannelFit", "Experiment", "FrequencyResponseData", "Identification", "Measurement",
    "ModalData", "StaticCurve", "TimeSeries", "identify",
]  # fmt: skip
