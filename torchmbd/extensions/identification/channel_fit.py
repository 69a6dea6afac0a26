"""How model and data agree in the channels of a fit.

Checked in tests/extensions/identification/test_identify.py.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchmbd.extensions.identification.fit_problem import FitProblem
from torchmbd.extensions.identification.statistics import ljung_box, runs_test


@dataclass(frozen=True)
class ChannelFit:
    """How model and data agree in one channel.

    name        of the channel, with that of its experiment where there are several
    count       of its numbers
    rms         root of the mean square of model minus data, in the unit of the channel
    relative    rms over the standard deviation of the data
    deviation   mean standard deviation that was given or, with `estimated`, estimated
    chi_square  mean square of the residuals in deviations: near one where the model is right
    ljung_box, runs   probabilities of such residuals of white noise (statistics.py); small: the model is in them
    note        what a user must know of this channel
    """

    name: str
    count: int
    rms: float
    relative: float
    deviation: float
    estimated: bool
    chi_square: float
    ljung_box: float
    runs: float
    note: str = ""


def agreement(x: ChannelFit) -> str:
    """In words."""
    white = min((p for p in (x.ljung_box, x.runs) if np.isfinite(p)), default=np.nan)
    text = f"rms {x.rms:.3g}, {100.0 * x.relative:.2g} % of the data"
    if not x.estimated:
        text += f", chi-square {x.chi_square:.3g}"
    return text + ("; residuals are not white" if white < 0.01 else "")


def channel_fits(problem: FitProblem, values: np.ndarray) -> list[ChannelFit]:
    """How model and data agree in every block of a problem, of residuals [rows]."""
    result = []
    for row in problem.rows:
        r, deviation = values[row.rows], problem.deviations[row.rows]
        difference = r * deviation
        rms = float(np.sqrt(np.mean(difference**2)))
        spread = float(np.std(row.block.measured)) or float(np.abs(row.block.measured).max()) or 1.0
        result.append(
            ChannelFit(
                row.name,
                len(r),
                rms,
                rms / spread,
                float(deviation.mean()),
                row.estimated,
                float(np.mean(r**2)),
                ljung_box(r),
                runs_test(r),
                row.block.note,
            )
        )
    return result
