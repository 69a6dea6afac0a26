"""What things cost: structure stage, one more variable, a finer mesh, a longer chain, the start, memory, compilation.

`python -m experiments.benchmark.costs first-step` and `... memory LANES` are the fresh processes that `start` and
`memory` measure.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch

import torchmbd as mbd
from experiments.benchmark.cases import (
    Case,
    compilation,
    compiled_ready,
    crank3,
    interleaved,
    loops,
    motion,
    motion_backwards,
    pendulum,
)
from experiments.benchmark.modes import rod
from experiments.benchmark.processes import fresh, resident_mb
from experiments.benchmark.report import Cell, Grid, Result, Settings
from experiments.paper import gradients
from experiments.peers import exudyn_peer
from torchmbd.examples import slider_crank
from torchmbd.extensions.native import library
from torchmbd.extensions.native.codegen.compiler import unavailable
from torchmbd.integrate.backend import with_backend
from torchmbd.math.pair import Pair
from torchmbd.multibody.system import Dynamics

STEPS, LANES, LONG = 500, 32, 600_000
TANGENTS = (3, 10)  # numbers of variables between which the cost of one more is taken
ANGLES = "rod.laminate.angles"
fresh_process = partial(fresh, "experiments.benchmark.costs")


def structure(settings: Settings) -> Result:
    """Structure stage with tangents, and with its gradient: processor milliseconds per design, compiled and by torch."""
    figures: dict[str, float | None] = dict.fromkeys(("structure_ms", "structure_reverse_ms"))
    rows = []
    kinds = {"values": "values_ms", "with tangents": "structure_ms", "with gradient": "reverse_ms"}
    for layers, designs in ((3, 4),) if settings.quick else ((3, 1), (3, 32), (4, 32), (10, 32)):
        with compilation(True):
            fastest = rod(designs=designs, layers=layers) if unavailable() is None else None
        with compilation(False):
            eager = rod(designs=designs, layers=layers)
        fastest = fastest or eager
        size = [layers, designs, int(fastest["freedoms"])]
        rows += [[*size, what, fastest[k], eager[k]] for what, k in kinds.items()]
        if (layers, designs) == (3, 32):
            figures = {"structure_ms": fastest["structure_ms"], "structure_reverse_ms": fastest["reverse_ms"]}
    columns = ["angles", "designs", "freedoms", "what", "compiled", "eager"]
    return Result(figures, [Grid("structure stage, processor ms per design", columns, rows)])


def variables(settings: Settings) -> Result:
    """One more variable, in simulations of the batch: the mean between the third and the tenth of a ten-layer rod.

    Gradients of peak and integral of the energy, by the adjoint as a problem of so many variables has them; and tangents of
    the whole motion.
    """
    system = slider_crank.build(10)
    case = Case("ten angles", system, slider_crank.DURATION, {ANGLES: 1.0}, exudyn_peer.slider_crank)
    whole = case.dynamics(LANES, gradients=True)
    some = {n: _first_tangents(whole, n) for n in TANGENTS}
    batches = {"values": whole.values()} | {str(n): dynamics for n, dynamics in some.items()}
    figures: dict[str, float | None] = dict.fromkeys(("tenth_variable", "tenth_variable_tangents"))
    if not all(compiled_ready(x, build=not settings.quick) for x in batches.values()):
        return Result(figures)
    with compilation(True):
        functions = {f"{name}, tangents" if x.tangents else name: _stage(x, STEPS) for name, x in batches.items()}
        functions |= {f"{n}, adjoint": partial(motion_backwards, x, case.duration, STEPS) for n, x in some.items()}
        for function in functions.values():
            function()
        seconds = interleaved(functions, settings.repeat)
    few, many = TANGENTS
    for name, kind in zip(figures, ("adjoint", "tangents"), strict=True):
        more = seconds[f"{many}, {kind}"] - seconds[f"{few}, {kind}"]
        figures[name] = more / (many - few) / seconds["values"]
    rows = [[name, 1e3 * s / LANES] for name, s in seconds.items()]
    title = f"variables: slider-crank, {LANES} lanes, {STEPS} steps"
    return Result(figures, [Grid(title, ["variables", "ms per design"], rows)])


def _first_tangents(dynamics: Dynamics, count: int) -> Dynamics:
    data = {k: Pair(x.full[..., : count + 1, :]) if isinstance(x, Pair) else x for k, x in dynamics.data.items()}
    return replace(dynamics, data=data)


def _stage(dynamics: Dynamics, steps: int, duration: float = slider_crank.DURATION) -> Callable[[], object]:
    return lambda: motion(dynamics, duration, steps) and None


def mesh(settings: Settings) -> Result:
    """Motion stage of rods of about a hundred and ten thousand nodes, the same modes: values of a batch."""
    batches, rows = {}, []
    for cells in ((24, 4), (48, 8)) if settings.quick else ((24, 4), (332, 30)):
        case = crank3(cells=cells)
        nodes = len(case.system.body("rod").mesh.nodes)
        batches[str(nodes)] = _widened(case.system.dynamics(), LANES)
    ready = all(compiled_ready(x, build=not settings.quick) for x in batches.values())
    steps = STEPS if ready else 20
    with compilation(ready):
        functions = {name: _stage(x, steps, slider_crank.DURATION * steps / STEPS) for name, x in batches.items()}
        for function in functions.values():
            function()
        seconds = interleaved(functions, settings.repeat if settings.quick else 10)
    rows = [[name, 1e3 * s / LANES] for name, s in seconds.items()]
    coarse, fine = seconds.values()
    figure = None if settings.quick else fine / coarse
    title = f"mesh: motion stage, values, {LANES} lanes, {steps} steps"
    return Result({"mesh_ratio": figure}, [Grid(title, ["nodes", "ms per design"], rows)])


def _widened(dynamics: Dynamics, lanes: int) -> Dynamics:
    """The same design in every lane."""
    return replace(dynamics, data={k: x.expand(*x.shape[:-1], lanes) for k, x in dynamics.data.items()})


def chain(settings: Settings) -> Result:
    """Cost per link of flexible pendulum chains, values of designs with other angles: the longest over five links."""
    lanes, steps, modes = 8, 100, 4
    counts = (5, 10) if settings.quick else (5, 10, 20, 50, 100)
    functions = {}
    for links in counts:
        case = pendulum(links, modes=modes, cells=(8, 2))
        functions[str(links)] = _stage(case.dynamics(lanes, gradients=False), steps, 0.06 * steps / STEPS)
    ready = not settings.quick and unavailable() is None
    with compilation(ready):
        for function in functions.values():
            function()
        seconds = interleaved(functions, min(settings.repeat, 3))
    rows: list[list[Cell]] = [[int(n), 1e3 * s / steps, 1e3 * s / steps / int(n)] for n, s in seconds.items()]
    last = str(counts[-1])
    figure = (seconds[last] / int(last)) / (seconds["5"] / 5)
    title = f"chain of flexible links, {lanes} lanes, {modes} modes each, {'compiled' if ready else 'eager'}"
    columns = ["links", "ms per step", "ms per step and link"]
    return Result({"chain_ratio": None if settings.quick else figure}, [Grid(title, columns, rows)])


def gradient_error(settings: Settings) -> Result:
    """Gradients at default settings against differences of the same discrete map: integral and peak of U."""
    rows, worst = [], 0.0
    for layers in (1,) if settings.quick else (1, 3):
        p, x = gradients.problem(layers, steps=100 if settings.quick else STEPS), gradients.DESIGNS[layers]
        error = gradients.relative(gradients.gradients(p, x), gradients.differences(p, x, 1e-4))
        rows.append([f"L{layers}", float(error[0]), float(error[1])])
        worst = max(worst, float(error.max()))
    columns = ["laminate", "integral of U", "peak of U"]
    title = "gradients against differences of the same discrete map, default settings"
    return Result({"gradient_error": None if settings.quick else worst}, [Grid(title, columns, rows)])


def start(settings: Settings) -> Result:
    """Seconds from the start of a fresh process to its first step with gradients, compiled code at hand."""
    if not compiled_ready(crank3().dynamics(LANES, gradients=True), build=not settings.quick):
        return Result({"warm_start_s": None})
    seconds = []
    for _ in range(1 if settings.quick else 3):
        begin = time.time()
        seconds.append(fresh_process("first-step", TORCHMBD_COMPILE="1")["at"] - begin)
    rows = [["process to first step", min(seconds), max(seconds)]]
    return Result(
        {"warm_start_s": min(seconds)}, [Grid("start, compiled code at hand", ["what", "least s", "most s"], rows)]
    )


def memory(settings: Settings) -> Result:
    """Peak memory per lane: growth of the largest resident set of fresh processes from few to many lanes."""
    few, many = (2, 34) if settings.quick else (32, 160)
    steps = 50 if settings.quick else STEPS
    ready = compiled_ready(crank3().dynamics(few, gradients=True), build=not settings.quick)
    compiled = "1" if ready else "0"
    # The structure stage of a batch has memory of its own: here every lane is the same design.
    mb = [fresh_process("memory", str(lanes), str(steps), TORCHMBD_COMPILE=compiled)["mb"] for lanes in (few, many)]
    figure = (mb[1] - mb[0]) / (many - few)
    rows = [[few, mb[0]], [many, mb[1]]]
    title = f"largest resident set, {steps} steps, 3 variables"
    return Result({"mb_per_lane": None if settings.quick else figure}, [Grid(title, ["lanes", "MB"], rows)])


def long(settings: Settings) -> Result:
    """long_gb: peak memory of a fresh process that differentiates 600,000 steps with every twentieth state kept.

    long_phases_gb   the same through three phases
    """
    figures: dict[str, float | None] = {"long_gb": None, "long_phases_gb": None}
    if not _compiler() or settings.quick:
        return Result(figures)
    rows = []
    for name, phases in (("long_gb", 1), ("long_phases_gb", 3)):
        run = fresh_process("long", str(LONG), str(phases), TORCHMBD_COMPILE="1")
        figures[name] = run["mb"] / 1024
        rows.append([LONG, phases, run["seconds"], run["mb"]])
    table = Grid("gradient of one long motion, checkpoint=20", ["steps", "phases", "CPU s", "MB"], rows)
    return Result(figures, [table])


def compile_time(settings: Settings) -> Result:
    """Seconds to compile the slider-crank with an empty cache, in a fresh process."""
    if settings.quick or not _compiler():
        return Result({"compile_s": None})
    with tempfile.TemporaryDirectory() as empty:
        seconds = fresh_process("compile", TORCHMBD_COMPILE="1", TORCHMBD_CACHE=empty)["seconds"]
    return Result({"compile_s": seconds}, [Grid("compilation", ["what", "s"], [["cold", seconds]])])


def _compiler() -> bool:
    return unavailable() is None


def main(arguments: list[str]) -> None:
    """What a fresh process does."""
    torch.set_num_threads(1)
    what = arguments[0]
    if what == "first-step":
        motion(crank3().dynamics(LANES, gradients=True), slider_crank.DURATION / STEPS, 1)
        print(json.dumps({"at": time.time()}))
    elif what == "memory":
        lanes, steps = int(arguments[1]), int(arguments[2])
        dynamics = crank3().dynamics(1, gradients=True)
        data = {
            k: Pair(x.full.expand(*x.full.shape[:-1], lanes)) if isinstance(x, Pair) else x.expand(*x.shape[:-1], lanes)
            for k, x in dynamics.data.items()
        }
        motion(replace(dynamics, data=data), slider_crank.DURATION * steps / STEPS, steps)
        print(json.dumps({"mb": resident_mb()}))
    elif what == "long":
        steps, count, system = int(arguments[1]), int(arguments[2]), mbd.examples.arm()
        duration, begin = 5e-4 * steps, time.process_time()
        ends = [mbd.Phase(until=duration * (k + 0.9371) / count) for k in range(count - 1)]
        swing = mbd.simulate(
            system, duration, steps=steps, phases=[*ends, mbd.Phase()], gradients="reverse", checkpoint=20
        ).require_ok()
        mbd.Integral(mbd.StrainEnergy("arm"))(swing).sum().backward()
        print(json.dumps({"seconds": time.process_time() - begin, "mb": resident_mb()}))
    elif what == "ready":
        dynamics = (pendulum(50) if arguments[1] == "chain" else loops()).dynamics(1, gradients=False)
        begin = time.perf_counter()
        native = with_backend(dynamics, "native")
        library.library(native.condensed())
        print(json.dumps({"seconds": time.perf_counter() - begin}))
    elif what == "compile":
        dynamics = crank3().dynamics(2, gradients=True)
        begin = time.perf_counter()
        compiled_ready(dynamics)
        print(json.dumps({"seconds": time.perf_counter() - begin}))


if __name__ == "__main__":
    main(sys.argv[1:])
