"""What gradients cost beside values, in the motion stage of the slider-crank: three angles, 32 designs, 500 steps.

adjoint_ratio   backward() of one response, the integral of the energy, over the steps of the same batch
no_grad_ratio   `simulate` under no_grad over its structure stage and its steps: what grad mode costs who does not want it
"""

from __future__ import annotations

import time

import torch

import torchmbd as mbd
from experiments.benchmark.cases import compilation, compiled_ready, crank3, differentiable_motion, interleaved
from experiments.benchmark.report import Cell, Grid, Result, Settings
from torchmbd.integrate.backend import with_backend
from torchmbd.integrate.initial_value import InitialValueProblem
from torchmbd.integrate.registry import DEFAULT, integrator_of

LANES, STEPS = 32, 500


def adjoint(settings: Settings) -> Result:
    """See the module header."""
    figures: dict[str, float | None] = dict.fromkeys(("adjoint_ratio", "no_grad_ratio"))
    case = crank3()
    moving, designs = case.dynamics(LANES, gradients=True), case.designs(LANES)
    values, integrator = moving.values(), integrator_of(DEFAULT, {})
    if settings.quick or not compiled_ready(values):
        return Result(figures)

    @torch.no_grad()
    def steps() -> None:
        InitialValueProblem.of_dynamics(with_backend(values, "native"), case.duration).integrate(integrator, STEPS)

    def backward() -> float:
        responses, leaves = differentiable_motion(moving, case.duration, STEPS)
        start = time.process_time()
        torch.autograd.grad(responses[1].sum(), list(leaves.values()))
        return time.process_time() - start

    @torch.no_grad()
    def structure() -> None:
        case.system.reduced(designs)

    @torch.no_grad()
    def simulation() -> None:
        mbd.simulate(case.system, case.duration, steps=STEPS, designs=designs)

    functions = {"steps": steps, "backward": backward, "structure stage": structure, "simulate, no_grad": simulation}
    with compilation(True):
        for function in functions.values():
            function()
        seconds = interleaved(functions, 2 * settings.repeat)
    figures["adjoint_ratio"] = seconds["backward"] / seconds["steps"]
    figures["no_grad_ratio"] = seconds["simulate, no_grad"] / (seconds["structure stage"] + seconds["steps"])
    rows: list[list[Cell]] = [[name, 1e3 * total / LANES] for name, total in seconds.items()]
    return Result(figures, [Grid(f"gradients beside values, {LANES} designs", ["what", "ms per design"], rows)])
