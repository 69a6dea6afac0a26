"""The motion stage on a device: gradients of thousands of designs of the slider-crank as one batch.

As in benchmark_motion.py, with the number of steps that is accurate enough there; structure stage not counted. The motion
and its responses are made on the device, what leaves it are values and gradients.
"""

from __future__ import annotations

from typing import Any

import torch

from experiments.benchmark_cases import Case, crank3, interleaved, motion
from experiments.benchmark_motion import both_accuracies
from experiments.benchmark_report import Grid, Result, Settings
from torchmbd.numerics.pair import Pair, value
from torchmbd.system import Dynamics

FIGURE = "device_3x4096_ms"
LANES, CHUNK = 4096, 128
_TITLE = "slider-crank, 3 angles, on a device: milliseconds per design"


def batch(case: Case, lanes: int) -> Dynamics:
    """Dynamics of many designs with their tangents; the structure stage takes some at a time."""
    designs, names = case.designs(lanes), list(case.variables)
    some = [{name: x[i : i + CHUNK] for name, x in designs.items()} for i in range(0, lanes, CHUNK)]
    parts = [case.system.dynamics(own, tangents=names) for own in some]

    def joined(pieces: list[Any]) -> Any:
        if isinstance(pieces[0], Pair):
            return Pair(torch.cat([x.full for x in pieces], -1))
        return torch.cat(pieces, -1) if value(pieces[0]).shape[-1] > 1 else pieces[0]

    parts[0].data = {name: joined([part.data[name] for part in parts]) for name in parts[0].data}
    return parts[0]


def device_part(settings: Settings) -> Result:
    """Gradients of 4,096 designs: device_3x4096_ms, below 1 is asked for."""
    if not torch.cuda.is_available():
        return Result({FIGURE: None}, [Grid(f"{_TITLE}: no CUDA device", ["what", "lanes", "ms"], [])])
    return measured("cuda", crank3(), 64 if settings.quick else LANES, settings)


def measured(device: str, case: Case, lanes: int, settings: Settings) -> Result:
    """Time motions with gradients on a device."""
    steps = 60 if settings.quick else both_accuracies(case, Settings())[0].steps
    dynamics = batch(case, lanes)

    def run() -> None:
        value_and_gradient = motion(dynamics, case.duration, steps, device=device)
        assert all(bool(torch.isfinite(x.cpu()).all()) for x in value_and_gradient)

    run()  # makes what is made once
    ms = 1e3 * interleaved({"ours": run}, settings.repeat)["ours"] / lanes
    table = Grid(_TITLE, ["what", "lanes", "steps", "ms"], [["gradient", lanes, steps, ms]])
    return Result({FIGURE: ms if lanes == LANES else None}, [table])
