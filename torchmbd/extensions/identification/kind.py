"""The kind of experiment files that fit a model to measurements; see torchmbd/study/file/kind.py.

Checked in tests/extensions/identification/test_files.py.
"""

from __future__ import annotations

import numpy as np
from rich.console import Console
from rich.markup import escape

from torchmbd.extensions.identification.channel import Channel
from torchmbd.extensions.identification.experiment import Experiment
from torchmbd.extensions.identification.frequency_response_data import FrequencyResponseData
from torchmbd.extensions.identification.identify import identify
from torchmbd.extensions.identification.measurement import unit_of_title
from torchmbd.extensions.identification.modal_data import ModalData
from torchmbd.extensions.identification.plan import IdentificationPlan, read_identification
from torchmbd.extensions.identification.sections import (
    ChannelData,
    ExperimentData,
    FrequencyResponseKeys,
    IdentificationFile,
    Identify,
    ModalDataKeys,
    PortKeys,
    StaticCurveData,
    TimeSeriesData,
)
from torchmbd.extensions.identification.sizes import size_doubts
from torchmbd.extensions.identification.static_curve import StaticCurve
from torchmbd.extensions.identification.time_series import TimeSeries
from torchmbd.extensions.identification.tracked_fit import (
    run_identification,
    start_predictions,
)
from torchmbd.extensions.vibrations.ports_by_name import NamedPort
from torchmbd.study.file.kind import Kind
from torchmbd.study.report.progress import print_table, table_of


def _check(plan: IdentificationPlan, console: Console) -> int:
    """Print a summary of a valid identification, and how model and data agree at the start; return the exit code."""
    problem = plan.problem
    console.print(
        f"{plan.source.path} is valid: {len(problem.names)} unknowns, {problem.data} measured numbers in {len(problem.rows)} "
        f"channels, {len(plan.experiments)} experiments, {len(plan.validation)} held out",
        markup=False,
        soft_wrap=True,
    )
    with console.status("simulating the start"):
        before = start_predictions(problem)
    if before is None:
        console.print("The start cannot be simulated", style="red")
        return 0
    table = table_of("at the start", ["channel", "numbers", "rms of model - data", "of the data"])
    for row in problem.rows:
        rms = float(np.sqrt(np.mean((before[row.rows] - row.block.measured) ** 2)))
        spread = float(np.std(row.block.measured)) or 1.0
        cells = [
            row.name,
            str(len(row.block.measured)),
            f"{rms:.3g} {unit_of_title(row.block.title)}",
            f"{100 * rms / spread:.2g} %",
        ]
        table.add_row(*map(escape, cells))
    print_table(table, console)
    for text in size_doubts(problem, before):
        console.print(text, style="yellow", markup=False, soft_wrap=True)
    return 0


IDENTIFY = Kind(
    "fits a model; allowed here: a study or a sweep; mbd.identification.identify in Python",
    IdentificationFile,
    read_identification,
    run_identification,
    _check,
    constructors={
        Identify: (identify,),
        ChannelData: (Channel,),
        TimeSeriesData: (TimeSeries,),
        StaticCurveData: (StaticCurve,),
        ModalDataKeys: (ModalData,),
        FrequencyResponseKeys: (FrequencyResponseData,),
        PortKeys: (NamedPort,),
        ExperimentData: (Experiment,),
    },
    named_by_parameters=("unknowns",),
)
