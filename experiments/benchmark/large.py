"""Large bodies: a plate and a wing box (experiments/models/large_shells.py), and factorization and modes by other libraries.

    build             the body and its system
    first motion      100 steps and the gradient of the integral of strain energy by the ply angles
    another design    both again, at other angles
    CHOLMOD           order, symbolic and numeric factorization by cvxopt, of the K of the same body
    eigsh             as many modes of the same K and M by SciPy's shift and inversion, with this factorization

Processor seconds. Each body has a process of its own (`python -m experiments.benchmark.large plate 120 40`), in which torchmbd
runs once, as a user would. The peak memory does not include the other libraries, which are not measured without cvxopt.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from scipy.sparse import csr_array, tril
from scipy.sparse.linalg import LinearOperator, eigsh

import torchmbd as mbd
from experiments.benchmark.processes import fresh, resident_mb
from experiments.benchmark.report import Grid, Result, Settings, ratio
from experiments.models import large_shells

STEPS, DURATION = 100, 0.05
ANGLES = "shell.laminate.angles"
SHAPES: dict[str, Callable[..., mbd.System]] = {"plate": large_shells.plate, "box": large_shells.wing_box}
#: Shape and cells by name; the name says thousands of freedoms.
BODIES = {
    "plate-30": "plate 120 40",
    "plate-117": "plate 240 80",
    "plate-250": "plate 352 118",
    "plate-500": "plate 496 166",
    "box-14": "box 60 12 4 6",
    "box-58": "box 120 24 8 6",
    "box-234": "box 240 48 16 6",
}
USUAL = ("plate-30", "plate-117", "box-14", "box-58")
_SMALL = ("plate 12 4", "box 12 4 2 6")
STAGES = ("freedoms", "build", "first motion", "gradient", "another design", "its gradient", "peak MB")
OTHERS = ("modes", "CHOLMOD", "eigsh")


def large(settings: Settings) -> Result:
    """large_ratio, large_again, of the plate of 117,000 freedoms: all up to the first gradient, and another design with its
    gradient, over CHOLMOD and eigsh; large_gb: its peak memory."""
    if settings.quick:
        rows = {text: measured(*_arguments(text)) for text in _SMALL}
    else:
        names = settings.bodies or USUAL
        rows = {name: fresh("experiments.benchmark.large", *BODIES[name].split()) for name in names}
    stages, others = [], []
    for name, row in rows.items():
        peers = None if row["eigsh"] is None else row["CHOLMOD"] + row["eigsh"]
        first = row["build"] + row["first motion"] + row["gradient"]
        again = row["another design"] + row["its gradient"]
        row |= {"first": ratio(first, peers), "again": ratio(again, peers)}
        stages.append([name, *(row[column] for column in STAGES)])
        others.append([name, *(row[column] for column in OTHERS), row["first"], row["again"]])
    known = rows.get("plate-117", {"first": None, "again": None, "peak MB": None})
    figures = {"large_ratio": known["first"], "large_again": known["again"], "large_gb": ratio(known["peak MB"], 1024)}
    columns = ["body", *OTHERS, "up to the gradient, over both", "another design, over both"]
    title = f"large bodies, {STEPS} steps, processor seconds"
    return Result(figures, [Grid(title, ["body", *STAGES], stages), Grid("beside other libraries", columns, others)])


def measured(shape: str, cells: list[int]) -> dict[str, Any]:
    """Seconds and MB by the names of STAGES and OTHERS, of this process."""
    row: dict[str, Any] = {}
    energy = mbd.Integral(mbd.StrainEnergy("shell"))

    def seconds(name: str, function: Callable[[], Any]) -> Any:
        start = time.process_time()
        result = function()
        row[name] = time.process_time() - start
        return result

    system = seconds("build", lambda: SHAPES[shape](*cells))
    motion = seconds("first motion", lambda: mbd.simulate(system, DURATION, steps=STEPS).require_ok())
    seconds("gradient", lambda: energy(motion).sum().backward())
    del motion
    angles = mbd.deg([30.0, -60.0, 10.0, 80.0])[None].requires_grad_()
    designs = {ANGLES: angles}
    motion = seconds(
        "another design", lambda: mbd.simulate(system, DURATION, steps=STEPS, designs=designs).require_ok()
    )
    seconds("its gradient", lambda: energy(motion).sum().backward())
    row["peak MB"] = resident_mb()
    shell = system.body("shell")
    free = np.asarray(shell.free)
    M, K = (matrix[free][:, free] for matrix in shell.mass_and_stiffness())
    row |= {"freedoms": K.shape[0], "modes": shell.modes, "CHOLMOD": None, "eigsh": None}
    if find_spec("cvxopt") is not None:
        solve = seconds("CHOLMOD", lambda: _factorized(K))
        inverse = LinearOperator(K.shape, matvec=solve, dtype=np.float64)  # pyright: ignore[reportCallIssue]
        seconds("eigsh", lambda: eigsh(K, shell.modes, M, sigma=0.0, OPinv=inverse))
    return row


def _factorized(K: csr_array) -> Callable[[np.ndarray], np.ndarray]:
    """K^-1 of one column."""
    from cvxopt import cholmod, matrix, spmatrix  # pyright: ignore[reportMissingImports, reportAttributeAccessIssue]

    lower = tril(K).tocoo()
    indices = (matrix(x.astype(np.int64)) for x in (lower.row, lower.col))
    A = spmatrix(matrix(lower.data), *indices, K.shape)
    factor = cholmod.symbolic(A)
    cholmod.numeric(A, factor)

    def solve(x: np.ndarray) -> np.ndarray:
        column = matrix(np.ascontiguousarray(x).reshape(-1, 1))
        cholmod.solve(factor, column)
        return np.asarray(column)[:, 0]

    return solve


def _arguments(text: str) -> tuple[str, list[int]]:
    shape, *cells = text.split()
    return shape, [int(x) for x in cells]


if __name__ == "__main__":
    torch.set_num_threads(1)
    print(json.dumps(measured(*_arguments(" ".join(sys.argv[1:])))))
