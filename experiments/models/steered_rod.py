"""A wide connecting rod whose fibers steer, against the best straight fibers: the slider-crank with 300 and 3,000 ply angles.

The rod of the paper is narrow and bends like a beam. This one is as wide as half its length (chosen), and its two pins hold
one point each: near these the plate bends in both directions. Mass is the same for all;
minimized is the integral of strain energy over a turn. Start of the steered laminates: the best straight one, disturbed by
a few degrees, because its symmetry makes it stationary.

    python -m experiments.models.steered_rod [--figure fibers.png]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

import torchmbd as mbd
from torchmbd.examples.slider_crank import CARBON, CRANK, DURATION, ROD, SLIDER_MASS, SPEED, THICKNESS

WIDTH, LAYERS, STEPS = 0.15, 3, 800
RADIUS = 0.4  # least steering radius of the third case [m]
SMALL = (1e-4, 1e-4, 1e-4)
ENERGY = mbd.Integral(mbd.StrainEnergy("rod"))
Laminates = mbd.Laminate | mbd.fibers.SteeredLaminate


def build(laminate: Callable[[mbd.Mesh], Laminates], cells: tuple[int, int]) -> mbd.System:
    """The slider-crank with a rod of that laminate, which is made of the rod's mesh."""
    mesh = mbd.mesh.rectangle(length=ROD, width=WIDTH, cells=cells)
    rod = mbd.FlexibleBody.plate(
        "rod",
        mesh,
        laminate(mesh),
        modes=4,
        reduction="craig-bampton",
        interface=["left", "right"],
        position=(CRANK + ROD / 2, 0, 0),
        axes=[[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    )
    crank = mbd.RigidBody("crank", mass=0.1, inertia=SMALL)
    slider = mbd.RigidBody("slider", mass=SLIDER_MASS, inertia=SMALL, position=(CRANK + ROD, 0, 0))
    ground = mbd.Ground()
    joints = [
        mbd.Revolute(ground.at(0, 0, 0), crank.at(0, 0, 0), axis="z"),
        mbd.Drive(ground, crank, axis="z", speed=SPEED),
        mbd.Spherical(crank.at(CRANK, 0, 0), rod.at("left")),
        mbd.Universal(rod.at("right"), slider.at(0, 0, 0), axes="yz"),
        mbd.Prismatic(ground.at(0, 0, 0), slider.at(0, 0, 0), axis="x"),
    ]
    return mbd.System([crank, rod, slider], joints)


def straight(angles: Sequence[float], cells: tuple[int, int]) -> mbd.Problem:
    """One angle [rad] for each layer of the whole rod."""
    ply = mbd.Ply(**CARBON)
    system = build(lambda mesh: mbd.Laminate(ply, torch.tensor(angles, dtype=torch.float64), THICKNESS / LAYERS), cells)
    return mbd.Problem(system, DURATION, ENERGY, bounds=mbd.deg([-90, 90]), steps=STEPS)


def steered(
    angles: Sequence[float], controls: tuple[int, int], cells: tuple[int, int], radius: float | None = None
) -> mbd.Problem:
    """An angle for each control point and layer; radius: least one of the fibers' paths [m], as p-norm."""
    ply, make = mbd.Ply(**CARBON), torch.Generator().manual_seed(0)

    def laminate(mesh: mbd.Mesh) -> mbd.fibers.SteeredLaminate:
        field = mbd.fibers.FiberField(mesh, controls, degree=1)
        start = torch.tensor(angles, dtype=torch.float64).expand(field.controls, LAYERS)
        start = start + 0.03 * torch.randn(start.shape, generator=make, dtype=start.dtype)
        return mbd.fibers.SteeredLaminate(ply, start, THICKNESS / LAYERS, field)

    limits = [] if radius is None else [mbd.fibers.FiberCurvature("rod", power=50) <= 1.0 / radius]
    return mbd.Problem(build(laminate, cells), DURATION, ENERGY, limits, bounds=mbd.deg([-180, 180]), steps=STEPS)


def best_straight(cells: tuple[int, int], samples: int = 200, searches: int = 5) -> tuple[np.ndarray, float]:
    """Angles [rad] and objective of the best of SLSQP's ends, from the best of random laminates."""
    problem = straight([0.0] * LAYERS, cells)
    X = np.random.default_rng(0).uniform(problem.lower, problem.upper, (samples, LAYERS))
    values = [e.objective for e in problem.evaluate(X, False)]
    starts = X[np.argsort(values)[:searches]]  # failed ones are nan and come last
    results = [mbd.optimize(straight(x.tolist(), cells), method="slsqp", progress=False) for x in starts]
    best = min(results, key=lambda result: result.value)
    return best.x, best.value


def cost(problem: mbd.Problem, repeat: int = 3) -> float:
    """Processor time of a gradient in simulations; the least of each."""
    times = np.zeros((repeat, 2))
    for row in times:
        for k, gradients in enumerate((False, True)):
            began = time.process_time()
            problem.evaluate(problem.start[None], gradients)
            row[k] = time.process_time() - began
    values, both = times.min(0)
    return both / values


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--figure", type=Path, help="file of a picture of the fibers of the case with a steering radius"
    )
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    coarse, fine = (24, 12), (50, 20)
    x, value = best_straight(coarse)
    angles = ", ".join(f"{a:.1f}" for a in np.degrees(x))
    print(f"best straight fibers: {angles} degrees, {value:.5e} J s on {coarse[0]} x {coarse[1]} cells\n")
    print("variables  cells    limit         objective [J s]  less by  KKT residual  gradient costs  simulations")
    cases: list[tuple[tuple[int, int], tuple[int, int], float | None, int]] = [
        ((10, 10), coarse, None, 900),
        ((10, 10), coarse, RADIUS, 1500),
        ((50, 20), fine, None, 3000),
    ]
    for controls, cells, radius, most in cases:
        reference = value if cells == coarse else straight(x.tolist(), cells).evaluate(x[None], False)[0].objective
        problem = steered(x.tolist(), controls, cells, radius)
        # Angles are of one kind: not each in units of its own start.
        result = mbd.optimize(problem, method="lbfgs", max_iterations=most, scaling=False, progress=False)
        limit = "none" if radius is None else f"radius {radius:g} m"
        print(
            f"{len(problem.start):9d}  {cells[0]} x {cells[1]}  {limit:12s}  {result.value:15.5e}"
            f"  {1.0 - result.value / reference:6.1%}  {result.kkt_residual:12.1e}  {cost(problem):8.1f} sim."
            f"  {result.analyses:11d}  {result.status}"
        )
        if options.figure is not None and radius is not None:
            angles_of_best = dict(problem.system.named_parameters())["rod.laminate.angles"]
            angles_of_best.data = torch.from_numpy(result.x).reshape(angles_of_best.shape)
            mbd.viz.fiber_paths(problem.system.body("rod")).savefig(options.figure, dpi=120)


if __name__ == "__main__":
    main()
