"""The registry of measurements: names as experiment files spell them. A new one is one file here, and one line."""

from __future__ import annotations

from torchmbd.extensions.identification.frequency_response_data import FrequencyResponseData
from torchmbd.extensions.identification.measurement import Measurement
from torchmbd.extensions.identification.modal_data import ModalData
from torchmbd.extensions.identification.static_curve import StaticCurve
from torchmbd.extensions.identification.time_series import TimeSeries

MEASUREMENTS: dict[str, type[Measurement]] = {
    "time_series": TimeSeries,
    "modal_data": ModalData,
    "static_curve": StaticCurve,
    "frequency_responses": FrequencyResponseData,
}
