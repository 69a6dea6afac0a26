"""Evaluations of a problem with gradients beside the sum of their parts: the slider-crank, integral and peak of its energy.

evaluate_ms      of one design
evaluate_ratio   of 32 designs, over the sum of structure stage, steps and adjoint, with gradients of both responses
"""

from __future__ import annotations

import time
from collections.abc import Callable

import torch
from torch import Tensor

import torchmbd as mbd
from experiments.benchmark.cases import Case, compilation, compiled_ready, crank3, differentiable_motion, interleaved
from experiments.benchmark.report import Grid, Result, Settings
from torchmbd.integrate.backend import with_backend
from torchmbd.integrate.initial_value import InitialValueProblem
from torchmbd.integrate.registry import DEFAULT, integrator_of

DESIGNS, FIGURE, STEPS = (1, 4, 16, 32, 128), 32, 500
PARTS = ("structure", "steps", "adjoint")
ANGLES = "rod.laminate.angles"


def evaluate(settings: Settings) -> Result:
    """See the module header."""
    case, rows = crank3(modes=3, cells=(6, 2)) if settings.quick else crank3(), []
    compiled = not settings.quick and compiled_ready(case.dynamics(1, gradients=False))
    figures: dict[str, float | None] = dict.fromkeys(("evaluate_ms", "evaluate_ratio"))
    for lanes in (1, 2) if settings.quick else DESIGNS:
        with compilation(compiled):
            functions = _functions(case, lanes, 20 if settings.quick else STEPS)
            for function in functions.values():
                function()
            seconds = interleaved(functions, settings.repeat if lanes > FIGURE else 2 * settings.repeat)
        whole, parts = 1e3 * seconds["evaluate"] / lanes, [1e3 * seconds[name] / lanes for name in PARTS]
        rows.append([lanes, whole, *parts, whole / sum(parts)])
        if compiled and lanes == 1:
            figures["evaluate_ms"] = whole
        if compiled and lanes == FIGURE:
            figures["evaluate_ratio"] = whole / sum(parts)
    columns = ["designs", "evaluate", *PARTS, "over their sum"]
    return Result(figures, [Grid("evaluation with gradients, processor ms per design", columns, rows)])


def _functions(case: Case, lanes: int, steps: int) -> dict[str, Callable[[], object]]:
    energy = mbd.StrainEnergy("rod")
    limits = [mbd.Max(energy) <= 1.0]
    problem = mbd.Problem(case.system, case.duration, mbd.Integral(energy), limits, steps=steps)
    X = case.designs(lanes)[ANGLES]
    designs = {ANGLES: X.clone().requires_grad_()}
    moving = case.dynamics(lanes, gradients=True)
    values, integrator = moving.values(), integrator_of(DEFAULT, {}).with_defaults(moving.topology)

    def pulled(rows: Tensor, inputs: list[Tensor]) -> None:
        torch.vmap(lambda weights: torch.autograd.grad(rows, inputs, weights, retain_graph=True))(torch.eye(2).to(rows))

    def structure() -> None:
        data = [x for x in case.system.reduced(designs).data.values() if x.requires_grad]
        pulled(torch.stack([torch.stack([x.sum(), x.square().sum()]) for x in data]).sum(0), list(designs.values()))

    @torch.no_grad()
    def motion() -> None:
        InitialValueProblem.of_dynamics(with_backend(values, "auto"), case.duration).integrate(integrator, steps)

    def adjoint() -> float:
        responses, leaves = differentiable_motion(moving, case.duration, steps)
        start = time.process_time()
        pulled(responses.sum(-1), list(leaves.values()))
        return time.process_time() - start

    return {
        "evaluate": lambda: problem.evaluate(X.numpy(), True) and None,
        "structure": structure,
        "steps": motion,
        "adjoint": adjoint,
    }
