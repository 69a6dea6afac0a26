"""What do modes and their derivatives cost?  `python -m experiments.benchmark.modes [--json] [--no-large]`

1. The structure stage of a batch of designs (laminate, K, modes, invariants) of a connecting rod on a fixed mesh, values
   alone and with tangents for every ply angle: milliseconds of one core per design; also with a Craig-Bampton basis.
2. A plate of 20,000 freedoms, 20 modes, 8 ply angles: the eigensolution alone, all derivatives on top of it, SciPy's
   eigsh (SuperLU) on the same matrices, and the memory that the process came to need.

Times are processor seconds of one thread, the best of several runs. Nothing here is a test.
"""

from __future__ import annotations

import argparse
import json
import math
import platform
import resource
import time
from collections.abc import Callable
from typing import Any

import scipy.sparse
import scipy.sparse.linalg
import torch
from torch import Tensor, nn
from torch.func import functional_call, jvp, vmap

from torchmbd.fem.elements import PlateMatrices
from torchmbd.fem.materials import Laminate, Ply
from torchmbd.fem.mesh import rectangle
from torchmbd.fem.reduction import modal_basis
from torchmbd.math.sparse import SparseMatrix
from torchmbd.multibody.bodies.flexible import FlexibleBody

CARBON = Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=5.36e9, nu12=0.23, density=1586.0)


class _Structure(nn.Module):
    def __init__(self, body: FlexibleBody) -> None:
        super().__init__()
        self.body = body

    def forward(self) -> dict[str, Tensor]:
        return self.body.structure()


def best(function: Callable[[], object], repeat: int) -> float:
    """Processor seconds of the fastest run; the first, which fills caches, does not count."""
    function()
    seconds = []
    for _ in range(repeat):
        start = time.process_time()
        function()
        seconds.append(time.process_time() - start)
    return min(seconds)


def with_tangents(function: Callable[[Tensor], object], angles: Tensor) -> object:
    """Values and the tangents of each angle, for one design [layers] or all lanes [lanes, layers] at once."""
    layers = angles.shape[-1]
    directions = torch.eye(layers, dtype=angles.dtype).reshape(layers, *[1] * (angles.dim() - 1), layers)
    push = vmap(lambda d: jvp(function, (angles,), (d,)), out_dims=(None, 0))  # pyright: ignore[reportArgumentType]
    return push(directions.expand(layers, *angles.shape))


def rod(
    designs: int = 32, layers: int = 4, modes: int = 8, cells: tuple[int, int] = (24, 4), **reduction: Any
) -> dict[str, float]:
    """The structure stage of a connecting rod, milliseconds per design."""
    laminate = Laminate(CARBON, [0.1] * layers, 7.5e-3 / layers)
    body = FlexibleBody.plate("rod", rectangle(0.304, 0.04, cells), laminate, modes=modes, **reduction)
    structure = _Structure(body)
    make = torch.Generator().manual_seed(0)
    angles = (torch.rand(designs, layers, generator=make, dtype=torch.float64) - 0.5) * math.pi

    def stage(angles: Tensor) -> dict[str, Tensor]:
        return functional_call(structure, {"body.laminate.angles": angles}, ())

    with torch.no_grad():
        values = best(lambda: stage(angles), 5)
    both = best(lambda: with_tangents(stage, angles), 5)
    leaf = angles.clone().requires_grad_()
    reverse = best(lambda: torch.autograd.grad(sum(x.sum() for x in stage(leaf).values() if x.requires_grad), leaf), 5)  # type: ignore[arg-type]
    return {
        "freedoms": len(body.free),
        "designs": designs,
        "angles": layers,
        "modes": body.modes,
        "values_ms": 1e3 * values / designs,
        "structure_ms": 1e3 * both / designs,
        "reverse_ms": 1e3 * reverse / designs,
    }


def large(cells: tuple[int, int] = (82, 40), layers: int = 8, modes: int = 20) -> dict[str, float]:
    """One large plate, clamped along one edge: seconds for the modes, and for all derivatives on top of them."""
    mesh = rectangle(0.6, 0.3, cells)
    laminate = Laminate(CARBON, [0.3, -0.5, 0.8, 1.2, -0.2, 0.4, -1.0, 0.1][:layers], 2e-3 / layers)
    matrices = PlateMatrices(mesh, laminate)
    clamped = set(mesh.node_sets["left_edge"])
    keep = [6 * node + f for node in range(len(mesh.nodes)) if node not in clamped for f in range(6)]
    pattern, positions = matrices.pattern.restrict(keep)
    mass = matrices.lumped_mass(laminate.mass_per_area, laminate.rotary_inertia_per_area)[keep].detach()
    angles = laminate.angles.detach()

    def stage(angles: Tensor) -> tuple[Tensor, ...]:
        return modal_basis(
            SparseMatrix(pattern, matrices.values(functional_call(laminate, {"angles": angles}, ()), positions)),
            mass,
            modes,
        )

    with torch.no_grad():
        values = best(lambda: stage(angles), 3)
        K = pattern.to_scipy(matrices.values(laminate.entries().detach(), positions))
    M = scipy.sparse.diags_array(mass.numpy()).tocsc()
    eigsh = best(lambda: scipy.sparse.linalg.eigsh(K, k=modes, M=M, sigma=0.0), 1)
    derivatives = best(lambda: with_tangents(stage, angles), 3) - values
    return {
        "freedoms": len(keep),
        "angles": layers,
        "modes": modes,
        "eigensolution_s": values,
        "derivatives_s": derivatives,
        "eigsh_s": eigsh,
        "derivatives_per_eigensolution": derivatives / values,
        "derivatives_per_eigsh": derivatives / eigsh,
        "process_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="one object instead of tables")
    parser.add_argument("--no-large", action="store_true", help="leave the plate of 20,000 freedoms out")
    options = parser.parse_args()
    torch.set_num_threads(1)
    report: dict[str, object] = {"machine": platform.processor() or platform.machine(), "torch": torch.__version__}
    report["rod"] = rod()
    report["rod, one design"] = rod(designs=1)
    report["rod, Craig-Bampton"] = rod(reduction="craig-bampton", interface=("left", "right"))
    if not options.no_large:
        report["plate"] = large()
    if options.json:
        print(json.dumps(report))
        return
    for title, entry in report.items():
        print(title if isinstance(entry, dict) else f"{title}: {entry}")
        if isinstance(entry, dict):
            for name, value in entry.items():
                print(f"    {name:32s}{value:12.4g}")


if __name__ == "__main__":
    main()
