"""Many design variables: `backward()` of one response by the ply angles of every zone of a rod, in simulations.

Structure stage included, one design. The rod of the slider-crank in 24x4 cells, each a zone of three plies: 288 angles; and in
82x20 cells, 1,000 zones: 3,000 angles. `python -m experiments.benchmark.angles 24 4 24 4` is the fresh process of a case.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence

import torch

import torchmbd as mbd
from experiments.benchmark.cases import compilation, interleaved
from experiments.benchmark.processes import fresh, resident_mb
from experiments.benchmark.report import Grid, Result, Settings
from torchmbd.examples.slider_crank import CARBON, CRANK, DEPTH, DURATION, ROD, THICKNESS, build
from torchmbd.extensions.native.codegen.compiler import unavailable
from torchmbd.fem.elements import Plates

STEPS = 800  # that Exudyn is compared with, at equal accuracy


def zoned(cells: tuple[int, int], zones: tuple[int, int], layers: int = 3) -> mbd.System:
    """The slider-crank whose rod has a laminate of its own in every zone."""
    base = build(layers, cells=cells)
    old = base.body("rod")
    centers = old.mesh.nodes[old.mesh.quads].mean(1) - old.mesh.nodes.min(0).values
    ix, iy = (
        (centers[:, k] / length * count).long().clamp(max=count - 1)
        for k, length, count in ((0, ROD, zones[0]), (1, DEPTH, zones[1]))
    )
    parts = {}
    for zone in range(zones[0] * zones[1]):
        angles = mbd.deg([30.0 + zone % 7, -20.0 - zone % 5, 50.0][:layers])
        laminate = mbd.Laminate(mbd.Ply(**CARBON), angles=angles, thickness=THICKNESS / layers)
        parts[f"z{zone}"] = Plates(old.mesh, laminate, cells=torch.nonzero(ix * zones[1] + iy == zone)[:, 0])
    rod = mbd.FlexibleBody("rod", old.mesh, parts, old.modes, (CRANK + ROD / 2, 0, 0), old.axes)
    crank, slider, ground = base.body("crank"), base.body("slider"), mbd.Ground()
    joints = [
        mbd.Revolute(ground.at(0, 0, 0), crank.at(0, 0, 0), axis="z"),
        mbd.Drive(ground, crank, axis="z", speed=124.8),
        mbd.Spherical(crank.at(CRANK, 0, 0), rod.at("left")),
        mbd.Universal(rod.at("right"), slider.at(0, 0, 0), axes="yz"),
        mbd.Prismatic(ground.at(0, 0, 0), slider.at(0, 0, 0), axis="x"),
    ]
    return mbd.System([crank, rod, slider], joints)


def measured(cells: tuple[int, int], zones: tuple[int, int], steps: int, repeat: int) -> dict[str, float]:
    """Angles, freedoms, seconds of a simulation and of a gradient, and what the process came to need."""
    system, measure = zoned(cells, zones), mbd.Integral(mbd.StrainEnergy("rod"))

    def values() -> None:
        with torch.no_grad():
            mbd.simulate(system, DURATION * steps / STEPS, steps=steps)

    def gradient() -> None:
        measure(mbd.simulate(system, DURATION * steps / STEPS, steps=steps)).sum().backward()

    gradient()
    figures = interleaved({"values": values, "gradient": gradient}, repeat)
    figures["angles"] = sum(x.numel() for x in system.parameters() if x.requires_grad)
    figures["freedoms"] = len(system.body("rod").free)
    return figures | {"gb": resident_mb() / 1024}


def many_angles(settings: Settings) -> Result:
    """many_angles, many_angles_3000: gradient of one response by 288 and by 3,000 angles, the latter of 10,000 freedoms, over
    one simulation, structure stages included; many_angles_gb: memory of the process of the latter."""
    figures: dict[str, float | None] = dict.fromkeys(("many_angles", "many_angles_3000", "many_angles_gb"))
    if unavailable() is not None:
        return Result(figures)
    if settings.quick:
        with compilation(False):
            measurements = [measured((6, 2), (6, 2), 20, settings.repeat)]
    else:
        measurements = [fresh("experiments.benchmark.angles", *sizes.split()) for sizes in ("24 4 24 4", "82 20 50 20")]
        few, many = (x["gradient"] / x["values"] for x in measurements)
        figures = {"many_angles": few, "many_angles_3000": many, "many_angles_gb": measurements[1]["gb"]}
    rows = [
        [x["angles"], x["freedoms"], 1e3 * x["values"], 1e3 * x["gradient"], x["gradient"] / x["values"], x["gb"]]
        for x in measurements
    ]
    columns = ["angles", "freedoms", "simulation ms", "gradient ms", "in simulations", "GB"]
    return Result(figures, [Grid("many angles, one design", columns, rows)])


def main(sizes: Sequence[int]) -> None:
    """What a fresh process does: cells and zones along the rod and across it."""
    torch.set_num_threads(1)
    with compilation(True):
        print(json.dumps(measured((sizes[0], sizes[1]), (sizes[2], sizes[3]), STEPS, Settings().repeat)))


if __name__ == "__main__":
    main([int(x) for x in sys.argv[1:]])
