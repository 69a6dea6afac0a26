"""Many design variables: `backward()` of one response by the ply angles of every zone of a rod, in simulations.

Structure stage included, one design. The rod of the slider-crank in 24x4 cells, each a zone of three plies: 288 angles.
"""

from __future__ import annotations

import torch

import torchmbd as mbd
from experiments.benchmark_cases import compilation, interleaved
from experiments.benchmark_report import Grid, Result, Settings
from experiments.slider_crank import CARBON, CRANK, DEPTH, DURATION, ROD, THICKNESS, build
from torchmbd.elements import Plates
from torchmbd.numerics.native import unavailable

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


def many_angles(settings: Settings) -> Result:
    """many_angles: gradient of one response by 288 angles over one simulation, structure stages included."""
    if unavailable() is not None:
        return Result({"many_angles": None})
    cells, zones = ((6, 2), (6, 2)) if settings.quick else ((24, 4), (24, 4))
    system, measure = zoned(cells, zones), mbd.Integral(mbd.StrainEnergy("rod"))
    steps = 20 if settings.quick else STEPS

    def values() -> None:
        with torch.no_grad():
            mbd.simulate(system, DURATION * steps / STEPS, steps=steps)

    def gradient() -> None:
        measure(mbd.simulate(system, DURATION * steps / STEPS, steps=steps)).sum().backward()

    with compilation(not settings.quick):
        gradient()
        seconds = interleaved({"values": values, "gradient": gradient}, settings.repeat)
    count = sum(x.numel() for x in system.parameters() if x.requires_grad)
    ratio = seconds["gradient"] / seconds["values"]
    rows = [[count, 1e3 * seconds["values"], 1e3 * seconds["gradient"], ratio]]
    columns = ["angles", "simulation ms", "gradient ms", "in simulations"]
    return Result({"many_angles": None if settings.quick else ratio}, [Grid("many angles, one design", columns, rows)])
