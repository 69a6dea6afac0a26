"""What a batch costs beside its designs, and what ply failure costs beside the motion.

batch_fixed_ms   time of a batch with gradients of peak and integral of the energy that does not grow with its designs or its
                 steps: one design with 25 steps, less what a design of a large batch takes for its structure stage
failure_ratio    gradient of the largest failure index of the rod less that of the integral of the energy, over the
                 simulation without gradients: 8 designs, 400 steps
"""

from __future__ import annotations

from collections.abc import Callable

import torch

import torchmbd as mbd
from experiments.benchmark.cases import compilation, crank3, interleaved
from experiments.benchmark.report import Cell, Grid, Result, Settings
from torchmbd.design.response import Measure
from torchmbd.examples import slider_crank
from torchmbd.extensions.native.codegen.compiler import unavailable

FEW, MANY = 1, 32
DESIGNS, STEPS = 8, 400
ANGLES = "rod.laminate.angles"
STRENGTH = mbd.Strength(Xt=1500e6, Xc=1200e6, Yt=50e6, Yc=250e6, S12=70e6)


def batches(settings: Settings) -> Result:
    """See the module header."""
    figures: dict[str, float | None] = dict.fromkeys(("batch_fixed_ms", "failure_ratio"))
    if unavailable() is not None or settings.quick:
        return Result(figures)
    functions = _batches() | _failure()
    with compilation(True):
        for function in functions.values():
            function()
        seconds = interleaved(functions, 4 * settings.repeat)
    figures["batch_fixed_ms"] = 1e3 * (seconds["one design"] - seconds["structure stage"] / MANY)
    figures["failure_ratio"] = (seconds["failure"] - seconds["energy"]) / seconds["simulation"]
    rows: list[list[Cell]] = [[name, 1e3 * total] for name, total in seconds.items()]
    return Result(figures, [Grid("batches and failure, slider-crank", ["what", "ms"], rows)])


def _batches() -> dict[str, Callable[[], object]]:
    case, energy = crank3(), mbd.StrainEnergy("rod")
    problem = mbd.Problem(case.system, case.duration / 20, mbd.Integral(energy), [mbd.Max(energy) <= 1.0], steps=25)
    design = case.designs(FEW)[ANGLES].numpy()
    many = {ANGLES: case.designs(MANY)[ANGLES].requires_grad_()}

    def stage() -> None:
        data = case.system.reduced(many).data
        sum(x.sum() for x in data.values() if x.requires_grad).backward()  # type: ignore[union-attr]

    return {"one design": lambda: problem.evaluate(design, True), "structure stage": stage}


def _failure() -> dict[str, Callable[[], object]]:
    system = slider_crank.build(3, joint="spherical", strength=STRENGTH)
    angles = crank3().designs(DESIGNS)[ANGLES]
    duration = slider_crank.DURATION / 2

    def gradient(measure: Measure) -> None:
        designs = {ANGLES: angles.clone().requires_grad_()}
        measure(mbd.simulate(system, duration, steps=STEPS, designs=designs)).sum().backward()

    def simulation() -> None:
        with torch.no_grad():
            mbd.simulate(system, duration, steps=STEPS, designs={ANGLES: angles})

    return {
        "simulation": simulation,
        "energy": lambda: gradient(mbd.Integral(mbd.StrainEnergy("rod"))),
        "failure": lambda: gradient(mbd.Max(mbd.PlyFailure("rod"))),
    }
