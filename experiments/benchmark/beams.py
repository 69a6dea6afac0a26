"""A slider-crank whose rod is a geometrically exact beam of 20 elements, beside the peer's beams.

beam_values_x1, beam_values_x32   how many times as fast as Exudyn's geometrically exact beam, per design, in batches of so many
beam_gradient_x32                 peak and integral of the square of the deflection of the rod's middle, by six angles
beam_cable_x1                     one design beside Exudyn's ANCF cable, which has neither torsion nor shear

Both codes take the smallest number of steps whose error is below 2e-3 of their own converged values with 20 elements; less
would be to resolve axial vibrations, which move the peak by 1e-3. A gradient costs the peer n + 1 simulations. The section's
6 x 6 is counted for neither. Spectral radii are 0.6 here, the default with beams, and 0.9 in Exudyn.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call

import torchmbd as mbd
from experiments.benchmark.cases import (
    Case,
    compilation,
    compiled_ready,
    interleaved,
    measures,
    motion,
    motion_backwards,
)
from experiments.benchmark.motion import accuracy
from experiments.benchmark.report import Cell, Grid, Result, Settings, ratio
from experiments.peers.exudyn_beams import CRANK, INERTIA, ROD, SLIDER, TORQUE, Rod, simulations
from torchmbd.extensions.native.codegen.compiler import unavailable
from torchmbd.multibody.system import Dynamics
from torchmbd.results.history import History

ELEMENTS, LANES, DURATION = 20, 32, 0.25
LADDER, CONVERGED, TOLERANCE = (200, 300, 400, 600, 800, 1000, 1200, 1400, 1600), 6400, 2e-3
KEYS = ("beam_values_x1", "beam_values_x32", "beam_gradient_x32", "beam_cable_x1")


def slider_crank(elements: int = ELEMENTS) -> Case:
    """A crank under a constant torque, from rest; a laminated box as rod."""
    carbon = mbd.Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=3.6e9, nu12=0.23, density=1586.0)
    section = mbd.sections.box(0.003, 0.012, carbon, mbd.deg([20, -20, 45, -45, 10, -10]), 0.15e-3, (3, 6, 1))
    rod = mbd.FlexibleBeam("rod", mbd.BeamLine.straight(ROD, elements), section, position=(CRANK, 0.0, 0.0))
    crank = mbd.RigidBody("crank", 0.1, (INERTIA, INERTIA, INERTIA))
    slider = mbd.RigidBody("slider", SLIDER, (1e-4, 1e-4, 1e-4), position=(CRANK + ROD, 0.0, 0.0))
    ground = mbd.Ground()
    joints = [
        mbd.Revolute(ground.at(), crank.at(), axis="z"),
        mbd.Revolute(crank.at(CRANK, 0, 0), rod.at("start"), axis="z"),
        mbd.Spherical(rod.at("end"), slider.at()),
        mbd.Prismatic(ground.at(), slider.at(), axis="x"),
    ]
    system = mbd.System([crank, rod, slider], joints, [mbd.Torque(crank.at(), (0.0, 0.0, TORQUE))])
    title = f"slider-crank with an exact beam of {elements} elements, 6 angles"
    return Case(title, system, DURATION, {"rod.section.angles": 0.1}, peer)


def deflection(dynamics: Dynamics, history: History) -> Tensor:
    """Square of the distance of the rod's middle from the chord [1, lanes, times], m2."""
    names = list(dynamics.topology.names)
    nodes = [k for k, name in enumerate(names) if name.startswith("rod_")]
    rows = [len(names) * j + nodes[k] for k in (0, len(nodes) // 2, -1) for j in range(3)]
    places = history.rows(0, rows, slice(0, 1)).unflatten(1, (3, 3))  # [times, nodes, 3, 1, lanes]
    return off_the_chord(places.permute(1, 3, 4, 0, 2))


def off_the_chord(places: Tensor) -> Tensor:
    """Square of the distance of the second from the line of the others [3, ..., 3], m2."""
    start, middle, end = places
    chord = end - start
    across = torch.linalg.cross(chord, middle - start)
    return across.square().sum(-1) / chord.square().sum(-1)


class _Matrices(nn.Module):
    def __init__(self, section: Any):
        super().__init__()
        self.section = section

    def forward(self) -> tuple[Tensor, Tensor]:
        return self.section.stiffness(), self.section.mass()


def peer(system: mbd.System, designs: dict[str, Tensor], cable: bool = False) -> list[Callable[[float, int], Any]]:
    """Simulations of Exudyn (duration, steps) -> Run, whose U is the square of the deflection."""
    beam: Any = system.body("rod")
    parameters = {name.removeprefix("rod."): x for name, x in designs.items()}
    with torch.no_grad():
        K, M = functional_call(_Matrices(beam.section), parameters, ())
    rods = [Rod(k, m, len(beam.mesh.elements)) for k, m in zip(K, M.expand_as(K), strict=True)]
    return [simulations(rod, off_the_chord, cable) for rod in rods]


def beams(settings: Settings) -> Result:
    """The figures of the module header."""
    if settings.quick or unavailable() is not None:
        return Result(dict.fromkeys(KEYS))
    with compilation(True):
        return _measured(slider_crank(), settings)


def _measured(case: Case, settings: Settings) -> Result:
    single, many = (case.dynamics(lanes, gradients=False) for lanes in (1, LANES))
    moving = case.dynamics(LANES, gradients=True)
    assert compiled_ready(single), case.title

    def measured(run: Callable[[float, int], Any]) -> Callable[[int], Tensor]:
        def responses(steps: int) -> Tensor:
            peer_run = run(case.duration, steps)
            return measures(
                torch.tensor(peer_run.t, dtype=torch.float64), torch.tensor(peer_run.U, dtype=torch.float64)[None]
            )

        return responses

    ours = accuracy(lambda steps: motion(single, case.duration, steps, deflection)[0], LADDER, CONVERGED, TOLERANCE)
    functions: dict[str, Callable[[], object]] = {
        "beam_values_x1": lambda: motion(single, case.duration, ours.steps, deflection) and None,
        "beam_values_x32": lambda: motion(many, case.duration, ours.steps, deflection) and None,
        "beam_gradient_x32": lambda: motion_backwards(moving, case.duration, ours.steps, observed=deflection) and None,
    }
    accuracies = {"torchmbd": ours}
    if settings.peer:
        for name, cable in (("exact beam", False), ("ANCF cable", True)):
            (run,) = peer(case.system, case.designs(1), cable)
            accuracies[name] = theirs = accuracy(measured(run), LADDER, CONVERGED, TOLERANCE)
            functions[name] = lambda run=run, steps=theirs.steps: run(case.duration, steps).seconds
    for function in functions.values():
        function()
    seconds = interleaved(functions, settings.repeat)
    rows: list[list[Cell]] = []
    result = Result()
    for key in KEYS:
        kind = "ANCF cable" if key == "beam_cable_x1" else "exact beam"
        name = "beam_values_x1" if key == "beam_cable_x1" else key
        mine = seconds[name] / (LANES if name.endswith("x32") else 1)
        other = seconds[kind] * (case.count + 1 if "gradient" in key else 1) if settings.peer else None
        result.figures[key] = ratio(other, mine)
        steps = accuracies[kind].steps if settings.peer else None
        rows.append([key, ours.steps, steps, 1e3 * mine, None if other is None else 1e3 * other, ratio(other, mine)])
    columns = ["what", "steps", "steps of Exudyn", "torchmbd", "Exudyn", "Exudyn / torchmbd"]
    result.tables.append(Grid(f"{case.title}: milliseconds per design", columns, rows))
    exact = [
        [name, x.steps, 1e3 * math.sqrt(float(x.converged[0, 0])), x.peak, x.integral] for name, x in accuracies.items()
    ]
    columns = ["code", "steps", "converged max. deflection [mm]", "error of max", "of integral"]
    result.tables.append(Grid(f"{case.title}: accuracy in time", columns, exact))
    return result
