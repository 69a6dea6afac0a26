"""Segments: a trivial phase beside none, a further switch, and the antenna in two phases; native steps.

trivial_phase     time with one phase that changes nothing over time without phases, the largest of the rows
switch_ms         a further switch at a given time, gradient by the adjoint, of 32 designs [ms a design]
event_ms          the same at an event, with the times at which it is sought
antenna_values_s  the antenna of 4,000 steps, a second motion;  antenna_gradient_s: with a gradient by two angles
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import torch

import torchmbd as mbd
from experiments.benchmark.cases import compilation, interleaved
from experiments.benchmark.report import Grid, Result, Settings
from experiments.models import sar_antenna_whole
from torchmbd.examples import slider_crank
from torchmbd.extensions.native.codegen.compiler import unavailable
from torchmbd.integrate.phases.phase import Phase

ANGLES, STEP, ANTENNA_STEPS, REPEATS = "rod.laminate.angles", 2e-4, 4000, 2  # STEP [s] resolves the rod
WAYS = {"values": False, "gradient": True}


def segments(settings: Settings) -> Result:
    """See the module header."""
    names = ("trivial_phase", "switch_ms", "event_ms", "antenna_values_s", "antenna_gradient_s")
    figures: dict[str, float | None] = dict.fromkeys(names)
    if unavailable() is not None and not settings.quick:
        return Result(figures)
    system = slider_crank.build(6)
    with compilation(not settings.quick):
        trivial = _trivial_phase(system, settings)
        switches = _switches(system, settings)
        antenna = [] if settings.quick else _antenna()
    if not settings.quick:
        figures["trivial_phase"] = max(row[-1] for row in trivial)
        figures |= {f"{kind}_ms": ms for kind, name, ms in switches if name == "gradient"}
        figures |= {f"antenna_{name}_s": seconds for name, seconds in antenna}
    return Result(
        figures,
        [
            Grid("one trivial phase over none", ["designs", "what", "ratio"], trivial),
            Grid("a further switch, ms a design", ["end of phases", "what", "ms"], switches),
            Grid("antenna, 4,000 steps, processor seconds", ["what", "s"], antenna),
        ],
    )


def _run(system: mbd.System, lanes: int, duration: float, with_gradient: bool, phases: Sequence[Phase] | None) -> None:
    angles = dict(system.named_parameters())[ANGLES].detach() + 0.01 * torch.arange(lanes, dtype=torch.float64)[:, None]
    designs = {ANGLES: angles.requires_grad_(with_gradient)}
    gradients = "reverse" if with_gradient else "none"
    steps = round(duration / STEP)
    motion = mbd.simulate(system, duration, steps=steps, designs=designs, phases=phases, gradients=gradients)
    if with_gradient:
        mbd.Integral(mbd.StrainEnergy("rod"))(motion).sum().backward()


def _duration(settings: Settings) -> float:
    """Duration [s]: of 500 steps, or a few."""
    return 0.01 if settings.quick else 0.1


def _measured(functions: dict[str, Callable[[], None]], settings: Settings) -> dict[str, float]:
    for function in functions.values():
        function()
    return interleaved(functions, settings.repeat)


def _trivial_phase(system: mbd.System, settings: Settings) -> list[list]:
    rows = []
    for lanes in (1,) if settings.quick else (1, 32):
        for name, with_gradient in WAYS.items():
            run = partial(_run, system, lanes, _duration(settings), with_gradient)
            both = {"none": partial(run, None), "one": partial(run, [mbd.Phase()])}
            seconds = _measured(both, settings)
            rows.append([lanes, name, seconds["one"] / seconds["none"]])
    return rows


def _phases(kind: str, switches: int, duration: float) -> list[Phase]:
    """Phases that change nothing: the rod's origin passes the axis of the slider every 0.025 s."""
    if kind == "switch":
        return [*(mbd.Phase(until=duration * (0.11 + 0.251 * k)) for k in range(switches)), mbd.Phase()]
    crossing = mbd.Event(mbd.Position("rod", "y"), "either")
    return [*(mbd.Phase(until=crossing) for _ in range(switches)), mbd.Phase()]


def _switches(system: mbd.System, settings: Settings) -> list[list]:
    rows, lanes, duration = [], 1 if settings.quick else 32, _duration(settings)
    for kind in ("switch",) if settings.quick else ("switch", "event"):
        for name, with_gradient in WAYS.items():
            run = partial(_run, system, lanes, duration, with_gradient)
            seconds = _measured({str(n): partial(run, _phases(kind, n, duration)) for n in (1, 3)}, settings)
            rows.append([kind, name, 1e3 * (seconds["3"] - seconds["1"]) / (2 * lanes)])
    return rows


def _antenna() -> list[list]:
    model = sar_antenna_whole
    system = model.whole((55.0, -55.0))
    angles = dict(system.named_parameters())[model.ANGLES].detach()[None]
    options = model.FLEXIBLE | model.INTEGRATOR["rigid"]

    def run(with_gradient: bool) -> None:
        designs = {model.ANGLES: angles.clone().requires_grad_(with_gradient)}
        gradients = "reverse" if with_gradient else "none"
        motion = mbd.simulate(
            system,
            model.DURATION,
            steps=ANTENNA_STEPS,
            phases=model.phases(),
            designs=designs,
            gradients=gradients,
            **options,
        )
        if with_gradient:
            (motion.q.square().sum() + motion.switches[0].t.sum()).backward()

    run(True)
    seconds = interleaved({name: partial(run, way) for name, way in WAYS.items()}, REPEATS)
    return [[name, x] for name, x in seconds.items()]
