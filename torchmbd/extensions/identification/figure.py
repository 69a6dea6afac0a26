"""Measured numbers and those of a model in one picture.

Checked in tests/extensions/identification/test_identify.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from torchmbd.errors import InputError
from torchmbd.viz.figures import BAD, BEST, OTHER, Numbers, figure_of, plain, wrapped

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def data_and_model(
    channels: Sequence[tuple[str, str, str, Numbers, Numbers, Numbers]], before: Sequence[Numbers] | None = None
) -> Figure:
    """Measured numbers and those of a model over time, frequency or load, a panel for each channel, and their difference below.

    channels  of each: name, title of its axis, title of what it is over, values of that, data, model
    before    of each, the numbers of the model before it was fitted; None: they are not drawn

    >>> t = np.linspace(0.0, 1.0, 20)
    >>> figure = mbd.viz.data_and_model([("tip", "x position of tip [m]", "time [s]", t, np.sin(t), t)])
    >>> [axes.get_ylabel() for axes in figure.axes]
    ['x position of tip [m]', 'model - data']
    """
    if not channels:
        raise InputError("channels", channels, "must contain at least one channel", state="is empty")
    figure, axes = figure_of(3.2 * len(channels), rows=2 * len(channels), ratios=[3, 1] * len(channels), sharex=False)
    starts = [None] * len(channels) if before is None else before
    for (name, title, over, x, data, model), first, top, bottom in zip(
        channels, starts, axes[::2], axes[1::2], strict=True
    ):
        x, data, model = (plain(values) for values in (x, data, model))
        order = np.argsort(x, kind="stable")
        top.plot(x, data, ".", color=OTHER, ms=4, zorder=3, label="data")
        if first is not None:
            top.plot(x[order], plain(first)[order], color=BAD, lw=0.9, ls="--", label="model before")
        top.plot(x[order], model[order], color=BEST, lw=1.2, label="model")
        top.set_title(name, loc="left", fontsize=9)
        top.set_ylabel(wrapped(title, 30))
        top.legend(frameon=False, ncols=3, loc="lower right", bbox_to_anchor=(1.0, 0.97), fontsize=9)
        bottom.plot(x, model - data, ".", color=BAD, ms=3)
        bottom.set_ylabel("model - data", fontsize=8)
        bottom.set_xlabel(over)
        bottom.sharex(top)
    return figure
