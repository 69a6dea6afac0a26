"""Cost of stiffening: steps and structure stage of the slider-crank, its rod with and without."""

from __future__ import annotations

from functools import partial

import torch

import torchmbd as mbd
from experiments.benchmark.cases import compilation, interleaved
from experiments.benchmark.report import Grid, Result, Settings
from torchmbd.examples import slider_crank
from torchmbd.extensions.native.codegen.compiler import unavailable

LANES, FEW, MANY = 32, 400, 4400


def system(stiffening: bool) -> mbd.System:
    """The slider-crank of three angles."""
    base = slider_crank.build(3)
    old = base.body("rod")
    laminate = next(iter(old.plates.values())).laminate
    options = {"modes": old.modes, "position": (slider_crank.CRANK + slider_crank.ROD / 2, 0, 0), "axes": old.axes}
    rod = mbd.FlexibleBody.plate("rod", old.mesh, laminate, stiffening=stiffening, **options)
    crank, slider, ground = base.body("crank"), base.body("slider"), mbd.Ground()
    joints = [
        mbd.Revolute(ground.at(), crank.at(), axis="z"),
        mbd.Drive(ground, crank, axis="z", speed=slider_crank.SPEED),
        mbd.Spherical(crank.at(slider_crank.CRANK, 0, 0), rod.at("left")),
        mbd.Universal(rod.at("right"), slider.at(), axes="yz"),
        mbd.Prismatic(ground.at(), slider.at(), axis="x"),
    ]
    return mbd.System([crank, rod, slider], joints, truncation=None)


def _run(model: mbd.System, steps: int, gradients: bool) -> None:
    make = torch.Generator().manual_seed(1)
    angles = 0.7 + 0.05 * torch.rand(LANES, 3, generator=make, dtype=torch.float64)
    designs = {"rod.laminate.angles": angles.requires_grad_(gradients)}
    way, duration = "reverse" if gradients else "none", slider_crank.DURATION * steps / 1200
    motion = mbd.simulate(model, duration, steps=steps, designs=designs, gradients=way, backend="native")
    if gradients:
        mbd.Integral(mbd.StrainEnergy("rod"))(motion).sum().backward()


def stiffening(settings: Settings) -> Result:
    """stiffening_steps, stiffening_structure: of a gradient, time with stiffening over time without."""
    figures: dict[str, float | None] = dict.fromkeys(("stiffening_steps", "stiffening_structure"))
    if settings.quick or unavailable() is not None:
        return Result(figures)
    rows = []
    models = {False: system(False), True: system(True)}
    for gradients in (False, True):
        ways = {
            f"{on} {steps}": partial(_run, models[on], steps, gradients)
            for on in (False, True)
            for steps in (FEW, MANY)
        }
        with compilation(True):
            for run in ways.values():
                run()  # builds the library
            seconds = interleaved(ways, settings.repeat)
        step = {on: (seconds[f"{on} {MANY}"] - seconds[f"{on} {FEW}"]) / (MANY - FEW) / LANES for on in (False, True)}
        fixed = {on: seconds[f"{on} {FEW}"] / LANES - FEW * step[on] for on in (False, True)}
        what = "gradient" if gradients else "values"
        rows.append([f"{what}, a step", 1e3 * step[False], 1e3 * step[True], step[True] / step[False]])
        rows.append([f"{what}, all but steps", 1e3 * fixed[False], 1e3 * fixed[True], fixed[True] / fixed[False]])
        figures = {"stiffening_steps": step[True] / step[False], "stiffening_structure": fixed[True] / fixed[False]}
    columns = ["milliseconds per design", "without", "with stiffening", "ratio"]
    return Result(figures, [Grid(f"stiffening of the slider-crank's rod, {LANES} designs", columns, rows)])
