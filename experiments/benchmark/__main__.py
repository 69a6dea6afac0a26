"""torchmbd and a peer side by side: `python -m experiments.benchmark [--json] [--peer exudyn] [--quick] [parts...]`

Parts (default: all):

    motion          gradients and values of batches of the slider-crank, three angles
    motion8         the same with four angles and four thicknesses
    pendulum        another mechanism: two laminated links, six angles
    multistart      a whole optimization from 32 starts
    study           the main job, warm and from an empty cache, by stages
    evaluate        evaluations with gradients of 1 to 128 designs beside the sum of their parts
    cores           the same with one thread and two, one process and two; the share that is serial
    structure       structure stage with tangents
    variables       cost of one more variable
    batches         fixed cost of a batch, and cost of ply failure
    adjoint         gradients beside values, and values under no_grad beside their parts
    angles          gradient by 288 and by 3,000 angles over one simulation
    load-cases      damage over 100 load cases, gradient by 100 variables; 30 variables and 20 cases beside the peer
    stiffening      cost of stiffening
    segments        a trivial phase, a further switch, the antenna in two phases
    mesh            motion stage on a fine mesh
    chain           cost per link of a flexible chain
    chains          chains of 5 to 50 links
    couplings       cost of a coupling of two joints beside a revolute joint
    loops           twelve flexible bodies in closed loops, with springs and a controller
    beams           a slider-crank with a geometrically exact beam of 20 elements
    build           from an empty cache to native steps
    gradients       error of the gradients
    start           a fresh process to its first step
    memory          peak memory per lane
    long            memory and time of a gradient of 600,000 steps
    compile         compiling, with an empty cache
    work-precision  all kinds of integrators
    errors          estimated over true errors of responses by steps
    large           a plate and a wing box of 14,000 to 117,000 freedoms (--bodies: up to 500,000) beside CHOLMOD and eigsh
    campbell        frequencies of a blade at 50 speeds, and their gradient by 100 variables
    chosen-steps    an optimization with steps by these errors over one with fixed steps
    tube            designs of a round tube that fail, for any number of modes, and a search from its start
    tube-starts     searches of the round tube from four starts
    methods         methods of optimization on ten problems whose optima are known (--problems, --methods)

One torch thread. Compiled code that is missing is built first (kept in the cache); not with --quick, which also takes smaller
sizes. What was not measured is null. Processor times of one thread, the fastest of several runs taken in turns; wall times of
cores, multistart, study, start and compile, with as many threads of compiled code as there are cores. A part that fails says
why, and the others go on; the exit code is then 1.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import platform
import sys
from collections.abc import Callable, Sequence
from typing import Any

import torch
from rich.console import Console

import torchmbd as mbd
from experiments.benchmark import chains, costs, motion
from experiments.benchmark.adjoint import adjoint
from experiments.benchmark.angles import many_angles
from experiments.benchmark.batches import batches
from experiments.benchmark.beams import beams
from experiments.benchmark.campbell import campbell
from experiments.benchmark.chosen_steps import chosen_steps
from experiments.benchmark.cores import cores
from experiments.benchmark.couplings import couplings
from experiments.benchmark.errors import errors
from experiments.benchmark.evaluate import evaluate
from experiments.benchmark.integrators import work_precision
from experiments.benchmark.large import BODIES, large
from experiments.benchmark.load_cases import load_cases
from experiments.benchmark.methods import CASES, methods
from experiments.benchmark.multistart import multistart
from experiments.benchmark.processes import run_each
from experiments.benchmark.report import Result, Settings, machine
from experiments.benchmark.segments import segments
from experiments.benchmark.stiffening import stiffening
from experiments.benchmark.study import study
from experiments.benchmark.tube import round_tube, tube_starts
from experiments.peers import exudyn_peer
from torchmbd.optimization.optimizer import OPTIMIZERS

PARTS: dict[str, Callable[[Settings], Result]] = {
    "motion": motion.slider_crank_part,
    "motion8": motion.eight_part,
    "pendulum": motion.pendulum_part,
    "multistart": multistart,
    "study": study,
    "evaluate": evaluate,
    "cores": cores,
    "structure": costs.structure,
    "variables": costs.variables,
    "batches": batches,
    "adjoint": adjoint,
    "angles": many_angles,
    "load-cases": load_cases,
    "stiffening": stiffening,
    "segments": segments,
    "mesh": costs.mesh,
    "chain": costs.chain,
    "chains": chains.chains,
    "couplings": couplings,
    "loops": chains.closed,
    "beams": beams,
    "build": chains.build,
    "gradients": costs.gradient_error,
    "start": costs.start,
    "memory": costs.memory,
    "long": costs.long,
    "compile": costs.compile_time,
    "work-precision": work_precision,
    "errors": errors,
    "large": large,
    "campbell": campbell,
    "chosen-steps": chosen_steps,
    "tube": round_tube,
    "tube-starts": tube_starts,
    "methods": methods,
}
FIGURES = (
    "gradient_3x32",
    "tangents_3x32",
    "gradient_8x32",
    "tangents_8x32",
    "gradient_3x1",
    "values_x32",
    "eager_3x128",
    "multistart",
    "study_warm_s",
    "study_cold_s",
    "evaluate_ms",
    "evaluate_ratio",
    "cores_ratio",
    "cores_serial",
    "structure_ms",
    "structure_reverse_ms",
    "batch_fixed_ms",
    "failure_ratio",
    "adjoint_ratio",
    "no_grad_ratio",
    "many_angles",
    "many_angles_3000",
    "many_angles_gb",
    "load_cases",
    "load_cases_error",
    "load_cases_peer",
    "long_gb",
    "stiffening_steps",
    "stiffening_structure",
    "trivial_phase",
    "switch_ms",
    "event_ms",
    "antenna_values_s",
    "antenna_gradient_s",
    "tenth_variable",
    "tenth_variable_tangents",
    "mesh_ratio",
    "large_ratio",
    "large_again",
    "large_gb",
    "chain_ratio",
    "chain_5",
    "chain_10",
    "chain_20",
    "chain_50",
    "coupling_ratio",
    "closed_loops",
    "beam_values_x1",
    "beam_values_x32",
    "beam_gradient_x32",
    "beam_cable_x1",
    "build_s",
    "cached_s",
    "gradient_error",
    "warm_start_s",
    "mb_per_lane",
    "compile_s",
    "pendulum_6x32",
    "pendulum_values_x32",
    "errors_share",
    "errors_unresolved",
    "chosen_steps_ratio",
)


def versions(peer: bool) -> dict[str, str | None]:
    """Of everything that is measured."""
    return {
        "python": platform.python_version(),
        "torch": torch.__version__,
        "torchmbd": mbd.__version__,
        "exudyn": exudyn_peer.version() if peer else None,
    }


def report(
    parts: Sequence[str], settings: Settings, tell: Callable[[Result], None] = lambda result: None
) -> tuple[dict[str, Any], list[str]]:
    """Run parts; all figures by name, None where nothing was measured, and the parts that failed."""
    figures: dict[str, Any] = dict.fromkeys(FIGURES)

    def run(name: str) -> None:
        result = PARTS[name](settings)
        tell(result)
        figures.update(result.figures)

    failed = run_each(parts, run)
    return figures | {"machine": machine(), "versions": versions(settings.peer)}, failed


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return its exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", help="parts to run; default: all")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of tables")
    parser.add_argument("--peer", choices=["exudyn"], help="measure this code beside torchmbd")
    parser.add_argument("--quick", action="store_true", help="small sizes, nothing is compiled")
    parser.add_argument(
        "--problems", nargs="+", default=[], choices=list(CASES), help="of the part methods; default: all"
    )
    parser.add_argument("--methods", nargs="+", default=[], choices=list(OPTIMIZERS), help="of the part methods")
    parser.add_argument("--bodies", nargs="+", default=[], choices=list(BODIES), help="of the part large")
    options = parser.parse_args(arguments)
    for part in options.parts:
        if part not in PARTS:
            parser.error(f"part = {part!r}: must be one of {', '.join(PARTS)}")
    if options.peer and not exudyn_peer.available():
        parser.error("--peer exudyn, but the package exudyn is not installed: pip install exudyn")
    torch.set_num_threads(1)
    settings = Settings(options.peer is not None, options.quick, options.problems, options.methods, options.bodies)
    console = Console(file=sys.stderr if options.json else sys.stdout)

    def tell(result: Result) -> None:
        for table in result.tables:
            table.show(console)

    # Exudyn greets on standard output, which belongs to the JSON object.
    with contextlib.redirect_stdout(sys.stderr):
        figures, failed = report(options.parts or list(PARTS), settings, tell)
    if options.json:
        print(json.dumps(figures))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
