"""How good are the elements, what do large meshes cost? `python -m experiments.benchmark.elements [PART ...]`

published  problems of experiments/models/shell_problems.py with triangles and with quadrilaterals, side by side: found over
           reference at the usual mesh and at meshes twice and four times as fine
bending    those that bend, with the bending of MITC4 and of DKMQ as published in the same quadrilateral, beside ours
laminated  carbon strips of 3 x 0.5 under end forces in their plane and across, 6 x 1, 12 x 2 and 24 x 4 cells, over 96 x 16
stage      the structure stage of a rod of 24 x 4 cells, 8 modes, with quadrilaterals over that with triangles, by turns
cost       processor seconds of one core:

section    6 x 6 stiffness of a laminated box of some 5,000 elements; with its derivative by all ply angles
plate      the structure stage of a plate of some 50,000 freedoms with 10 modes: assembly, factorization, invariants
           (with either kind of cells)
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from unittest import mock

import torch
from torch import Tensor
from torch.func import functional_call, jvp, vmap

import torchmbd as mbd
from experiments.models.shell_problems import PROBLEMS, cantilever
from torchmbd.fem.elements import ELEMENTS, quad, quad_bending, sides
from torchmbd.fem.elements.quad_shape import Bilinear
from torchmbd.fem.materials import IsotropicMean

CARBON = mbd.Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=3.6e9, nu12=0.23, density=1586.0)


def seconds(function: Callable[[], object]) -> float:
    """Processor time of one call."""
    start = time.process_time()
    function()
    return time.process_time() - start


def section() -> tuple[int, float, float]:
    """Elements, seconds of the stiffness, seconds with the derivative by all angles."""
    angles = mbd.deg([20.0, -50.0, 75.0, 0.0])
    section = mbd.sections.box(0.2, 0.1, ply=CARBON, angles=angles, thickness=1e-3, cells=(210, 104, 2))
    value = seconds(section.stiffness)
    both = seconds(lambda: section.stiffness()[3, 4].backward())
    return len(section.mesh.layer), value, both


def plate(kind: str) -> tuple[int, float, float]:
    """Freedoms, seconds to make the body, seconds of its structure stage."""
    laminate = mbd.Laminate(CARBON, mbd.deg([20, -50, 75]), 1e-3)
    mesh = mbd.mesh.rectangle(1.2, 0.7, (120, 68), kind)
    start = time.process_time()
    body = mbd.FlexibleBody.plate("plate", mesh, laminate, modes=10)
    assembly = time.process_time() - start
    with torch.no_grad():
        stage = seconds(body.structure)
    return len(body.free), assembly, stage


def published() -> None:
    """Print one line for each problem and quantity."""
    print("computed / reference, on the usual mesh and on meshes twice and four times as fine")
    print(f"{'problem: quantity':44s}" + "   ".join(f"{kind:19s}" for kind in ELEMENTS))
    for name, problem in PROBLEMS.items():
        by_kind = {kind: [problem(kind, n) for n in (1, 2, 4)] for kind in ELEMENTS}
        for quantity in by_kind["triangle"][0]:
            columns = [
                ", ".join(f"{ratios[quantity]:.3f}" for ratios in kind_ratios) for kind_ratios in by_kind.values()
            ]
            print(f"{name + ': ' + quantity:44s}" + "   ".join(columns))


def mitc4(corners: Tensor, points: Bilinear, *_: object) -> tuple[Tensor, Tensor]:
    """Bilinear rotations, every gap taken for shear: K.-J. Bathe and E. N. Dvorkin (1985)."""
    gap = sides.gaps(corners)[0]
    return quad_bending.linear_curvatures(points), quad_bending.shear_strains(corners, points, gap)


def dkmq(corners: Tensor, points: Bilinear, mean: IsotropicMean, *_: object) -> tuple[Tensor, Tensor]:
    """Gaps shared by the length of the side, curvatures as they are: I. Katili (1993)."""
    gap, tangent, length = sides.gaps(corners)
    delta, gamma = sides.split_gaps(gap, mean.shear_length, length**2)
    curvature = (
        quad_bending.linear_curvatures(points) + quad_bending.quadratic_curvatures(points, tangent) @ delta[:, None]
    )
    return curvature, quad_bending.shear_strains(corners, points, gamma)


def bending() -> None:
    """Print one line for each problem and quantity: MITC4, DKMQ, ours."""
    kinds = {"MITC4": mitc4, "DKMQ": dkmq, "ours": quad_bending.plate_strains}
    print("computed / reference, quadrilaterals of the usual mesh and of meshes twice and four times as fine")
    print(f"{'problem: quantity':44s}" + "   ".join(f"{name:19s}" for name in kinds))
    for name, problem in PROBLEMS.items():
        by_kind = []
        for strains in kinds.values():
            with mock.patch.object(quad, "plate_strains", strains):
                by_kind.append([problem("quad", n) for n in (1, 2, 4)])
        for quantity in by_kind[0][0]:
            columns = [", ".join(f"{ratios[quantity]:.3f}" for ratios in kind_ratios) for kind_ratios in by_kind]
            print(f"{name + ': ' + quantity:44s}" + "   ".join(columns))


def laminated() -> None:
    """Print one line for each stack: triangles and quadrilaterals in plane, then out of plane."""
    columns = [f"{kind}, {way} plane" for way in ("in", "out of") for kind in ("triangles", "quads")]
    print("deflection with 6x1, 12x2, 24x4 cells / with 96x16 quadrilaterals")
    print(f"{'angles [deg]':18s}" + "  ".join(f"{name:22s}" for name in columns))
    for degrees in ([0], [30], [90], [45, -45], [0, 45, 90, -45], [20, 70]):
        laminate = mbd.Laminate(CARBON, mbd.deg(degrees), 0.01 / len(degrees))

        def deflection(kind: str, n: int, laminate: mbd.Laminate = laminate) -> dict[str, float]:
            return cantilever(lambda s, t: (3 * s, 0.5 * t, 0.0), (6 * n, n), kind, laminate, {1: 1.0, 2: 1.0})

        fine = deflection("quad", 16)
        by_kind = {kind: [deflection(kind, n) for n in (1, 2, 4)] for kind in ELEMENTS}
        columns = [", ".join(f"{u[way] / fine[way]:.3f}" for u in by_kind[kind]) for way in "vw" for kind in ELEMENTS]
        print(f"{degrees!s:18s}" + "  ".join(f"{column:22s}" for column in columns))


def stages(kind: str, lanes: int) -> tuple[Callable[[], object], Callable[[], object]]:
    """The structure stage of a rod in some designs: alone, and with tangents by its three angles."""
    laminate = mbd.Laminate(CARBON, mbd.deg([45, -45, 45]), 2.5e-3)
    body = mbd.FlexibleBody.plate("rod", mbd.mesh.rectangle(0.304, 0.04, (24, 4), kind), laminate, modes=8)
    system = mbd.System([body])
    start = laminate.angles.detach()
    angles = start + 0.3 * torch.randn(lanes, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def stage(x: Tensor) -> dict[str, Tensor]:
        return functional_call(system, {"rod.laminate.angles": x}, ("rod",))

    def tangents() -> object:
        return vmap(lambda way: jvp(stage, (angles,), (way.expand_as(angles),)))(torch.eye(3, dtype=torch.float64))

    return lambda: stage(angles), tangents


@torch.no_grad()
def stage() -> None:
    """Print ratios of the least of ten runs by turns."""
    for lanes in (1, 16, 64):
        runs = {kind: stages(kind, lanes) for kind in ELEMENTS}
        for name, k in (("alone", 0), ("with tangents", 1)):
            spent = [{kind: seconds(runs[kind][k]) for kind in ELEMENTS} for _ in range(12)][2:]
            least = {kind: min(run[kind] for run in spent) for kind in ELEMENTS}
            ratio = least["quad"] / least["triangle"]
            print(f"{lanes} designs, {name}: {1e3 * least['quad']:.0f} ms, {ratio:.2f} times as long as with triangles")


def cost() -> None:
    """Print what large meshes cost."""
    elements, value, both = section()
    print(f"section of {elements} elements: 6 x 6 in {value:.2f} s, with derivatives in {both:.2f} s")
    for kind in ELEMENTS:
        freedoms, assembly, stage = plate(kind)
        print(
            f"plate of {freedoms} freedoms ({kind}s): made in {assembly:.2f} s, 10 modes and invariants in {stage:.2f} s"
        )


def main() -> None:
    parts = {"published": published, "bending": bending, "laminated": laminated, "stage": stage, "cost": cost}
    for name in sys.argv[1:] or parts:
        parts[name]()


if __name__ == "__main__":
    main()
