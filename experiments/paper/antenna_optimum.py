"""The antenna's laminates of least energy: section 6.3, Tables 7, 8. `python -m experiments.paper.antenna_optimum`

    minimize eq. (40), the integral of U2 + U3 over 3 s, with the peak energies (41) of both panels at most those of the start

    mmfd      two angles that the panels share, from 55/-55; the optimum once more with double mesh, double modes, half the step
    starts    the same from 32 Sobol starts in common batches: distinct minima, peak memory
    discrete  angles in increments of 5 degrees
    angles    four angles (two for each panel) and eight (four layers of each panel), from the start of Table 7
    trusses   two angles of the panels and two of wound trusses
    cost      seconds of one gradient with two and with eight angles in multiples of one simulation

Panels are reduced by Craig-Bampton (`MODEL`), for which eq. (40) has converged in the modes; `--vibration` takes the modes
of vibration of experiments/models/sar_antenna.py, with which it is 3 to 10 % smaller.
Checked in tests/experiments/test_sar_antenna_optimum.py.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

import torchmbd as mbd
from experiments.models.sar_antenna import build
from experiments.models.sar_antenna_data import DURATION, INTEGRATOR
from experiments.paper.antenna_tables import ENERGY, OBJECTIVE

START = (55.0, -55.0)  # Table 7 [deg]
OPTIMUM = (8.66, -48.32)  # what `mmfd` finds [deg]
MODEL: dict[str, Any] = {"modes": 4, "cells": (16, 8), "reduction": "craig-bampton"}
VIBRATION: dict[str, Any] = {"modes": 14, "cells": (32, 16), "reduction": "vibration"}
# Five flexible bodies: with more modes a step is too long to be compiled.
TUBES: dict[str, Any] = {"trusses": "tube", "truss_angles": (45.0, -45.0), "reduction": "vibration", "modes": 12}
LAYERS = tuple(START) + tuple(START[::-1])  # all four


def problem(
    steps: int = 300, angles: Sequence[float] = START, angles3: Sequence[float] | None = None, **model: Any
) -> mbd.Problem:
    """Eqs. (40), (41); `model`: options of experiments.models.sar_antenna.build beside `MODEL`."""
    return mbd.Problem(
        build(angles, angles3, **(MODEL | model)),
        DURATION,
        minimize=OBJECTIVE,
        subject_to=[mbd.Max(energy) <= "initial" for energy in ENERGY.values()],
        bounds=mbd.deg([-90, 90]),
        steps=steps,
        **INTEGRATOR[model.get("trusses", "rigid")],
    )


def degrees_text(x: np.ndarray) -> str:
    """A design [rad] in degrees."""
    return "/".join(f"{a:z.2f}" for a in np.degrees(x))


def line(result: mbd.optimization.OptimizationResult) -> str:
    """An optimization in a line."""
    first = result.history[0].objective
    return (
        f"{first:.6f} -> {result.value:.6g} J s, reduction {100 * (1 - result.value / first):.2f} %, "
        f"{degrees_text(result.x)} deg, "
        f"violation {result.violation:.0e}, {result.iterations} iterations, {result.analyses} analyses, {result.status}"
    )


def refined(angles: Sequence[float], steps: int, **model: Any) -> float:
    """Eq. (40) of a design [deg] by `MODEL` with double mesh, double modes and half the step [J s]."""
    finer = model | MODEL
    finer |= {"modes": 2 * finer["modes"], "cells": tuple(2 * n for n in finer["cells"])}
    motion = mbd.simulate(build(angles, **finer), DURATION, steps=2 * steps, halvings=0, gradients="none")
    return float(OBJECTIVE.value(motion.require_ok())[0])


def mmfd(steps: int, **model: Any) -> mbd.optimization.OptimizationResult:
    """Print the optimum from the start of Table 7, and the same design refined."""
    result = mbd.optimize(problem(steps, **model), method="mmfd")
    print(line(result), "(paper 95.6 %, 1.06/-47 deg)")
    for angles, coarse in ((START, result.history[0].objective), (np.degrees(result.x).tolist(), result.value)):
        fine = refined(angles, steps, **model)
        print(f"double mesh, double modes, half step: {fine:.6g} J s, {100 * (fine / coarse - 1):+.1f} %", flush=True)
    return result


def starts(count: int, steps: int, **model: Any) -> None:
    """Print the distinct minima of Sobol starts, and the peak memory of the process."""
    study = mbd.optimization.multistart(
        problem(steps, **model), "mmfd", mbd.optimization.sobol(count, seed=7, include_initial=True)
    )
    for minimum in study.minima:
        print(f"{minimum.value:.6g} J s at {degrees_text(minimum.x)} deg: {minimum.count} starts")
    print(f"{study.converged} of {len(study.results)} starts converged in {study.analyses} analyses")
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB")


def discrete(steps: int, **model: Any) -> None:
    """Print the best design in increments of 5 degrees."""
    result = mbd.optimization.optimize_discrete(problem(steps, **model), float(np.radians(5.0)), "mmfd")
    if result.best is None or result.certificate is None:
        print(f"{result.status}: {result.message}")
        return
    verdict = "holds" if result.certificate.holds else "fails"
    print(
        f"{result.best.value:.6g} J s at {degrees_text(result.best.x)} deg, {result.analyses} simulations; {result.status}"
    )
    print(f"certificate {verdict}: {result.certificate.neighbors} neighbors, {result.certificate.which}")


def more_angles(steps: int, **model: Any) -> None:
    """Print the optima with four and with eight angles."""
    for name, angles in (("two for each panel", START), ("four layers of each panel", LAYERS)):
        print(f"{name}: {line(mbd.optimize(problem(steps, angles, angles, **model), method='mmfd'))}", flush=True)


def cost(steps: int, repetitions: int = 3, **model: Any) -> dict[int, float]:
    """Seconds of a simulation with gradient over those of one without, by the number of angles; interleaved, the fastest."""
    ratios = {}
    for angles, angles3 in ((START, None), (LAYERS, LAYERS)):
        p = problem(steps, angles, angles3, **model)
        best = {False: float("inf"), True: float("inf")}
        for _ in range(repetitions):
            for gradients in best:
                began = time.process_time()
                p.simulate(p.start[None], gradients).require_ok()
                best[gradients] = min(best[gradients], time.process_time() - began)
        ratios[len(p.start)] = best[True] / best[False]
        print(
            f"{len(p.start)} angles: {best[True]:.2f} s, {ratios[len(p.start)]:.2f} simulations of {best[False]:.2f} s"
        )
    return ratios


def trusses(steps: int, **model: Any) -> mbd.optimization.OptimizationResult:
    """Print the optimum by the angles of the panels and of wound trusses, from 55/-55 and 45/-45; 12 modes of vibration."""
    result = mbd.optimize(problem(steps, **(model | TUBES)), method="mmfd")
    print(line(result))
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("mmfd", "starts", "discrete", "angles", "trusses", "cost"))
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--starts", type=int, default=32)
    parser.add_argument("--vibration", action="store_true", help="14 modes of vibration on 32x16 cells")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    model = VIBRATION if arguments.vibration else MODEL
    if arguments.command == "starts":
        starts(arguments.starts, arguments.steps, **model)
    else:
        commands = {"mmfd": mmfd, "discrete": discrete, "angles": more_angles, "trusses": trusses, "cost": cost}
        commands[arguments.command](arguments.steps, **model)


if __name__ == "__main__":
    main()
