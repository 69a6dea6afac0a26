"""Pictures of a study that asks for vibrations of the whole system: Campbell diagrams, root loci, shapes in the player.

    campbell_start.png, campbell_best.png     frequencies and damping over speed, with the orders that are asked for
    root_locus_best.png                       poles over speed, where damping or stability is asked for
    mode_best_1.html                          shapes of the numbers that are asked for, at the largest speed

For machines at rest there are the shapes alone. A shaft beyond the first has its number in the names.
Checked in tests/extensions/vibrations/pictures/test_vibration_pictures.py.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch

from torchmbd.extensions.vibrations.campbell_diagram import CampbellDiagram, campbell
from torchmbd.extensions.vibrations.eigenvalues import NATURAL, POLES
from torchmbd.extensions.vibrations.measures.critical_values import SPEED, CriticalSpeed, StabilityLimit
from torchmbd.extensions.vibrations.measures.system_vibrations import (
    CampbellClearance,
    DampingRatio,
    OfVibrations,
    StabilityMargin,
    SystemFrequency,
)
from torchmbd.extensions.vibrations.pictures import spectra
from torchmbd.extensions.vibrations.pictures.mode_motion import animate_mode
from torchmbd.extensions.vibrations.spectrum import SWINGS
from torchmbd.extensions.vibrations.steady_states import SteadyStates, steady_states
from torchmbd.results.mode_shapes import GivenShapes
from torchmbd.results.time_rows import TensorSignals
from torchmbd.results.trajectory import Trajectory
from torchmbd.simulation.equilibrium import Equilibrium

_POINTS = 25  # speeds of a diagram
_BEYOND = 1.1  # its largest speed over the largest that is asked for
_MORE = 1  # vibrations beyond those asked for in a diagram
_SHAPES = 3  # at most

Draw = Callable[..., None]


def draw_vibrations(
    measures: Sequence[OfVibrations], motion: Trajectory, labels: Sequence[str], title: str, draw: Draw, folder: Any
) -> list[Any]:
    """Draw the diagrams of a motion whose lanes are the start and the best design; return the pages of shapes.

    draw   called with a figure function, names of files and arguments
    """
    asked: dict[Any, list[OfVibrations]] = {}
    for measure in measures:
        shaft = measure.shaft_of(motion.system) if isinstance(measure, CriticalSpeed) else measure.shaft
        asked.setdefault(shaft, []).append(measure)
    pages = []
    with torch.no_grad():
        for k, (shaft, of_shaft) in enumerate(asked.items()):
            end = f"_{k + 1}" if k else ""
            top = max(_speed(measure) for measure in of_shaft)
            numbers = sorted({n for measure in of_shaft for n in _numbers(measure)}) or [1]
            if top > 0.0:
                speeds = torch.linspace(0.0, _BEYOND * top, _POINTS, dtype=torch.float64)
                turning = shaft.axis, shaft.center, shaft.observer
                diagram = campbell(motion.system, speeds, *turning, motion.designs, max(numbers) + _MORE)
                _diagrams(diagram, of_shaft, [labels, title, end], draw)
            states = steady_states(motion.system, [top], shaft, motion.designs)
            pages += _shapes(states, motion, numbers[:_SHAPES], top, folder, end)
    return pages


def _speed(measure: OfVibrations) -> float:
    """The largest speed [rad/s] that a measure looks at."""
    if isinstance(measure, CampbellClearance):
        return measure.band[1]
    if isinstance(measure, CriticalSpeed) or (isinstance(measure, StabilityLimit) and measure.parameter == SPEED):
        return measure.between[1]
    return float(getattr(measure, "speed", 0.0))


def _numbers(measure: OfVibrations) -> tuple[int, ...]:
    """Numbers of the vibrations that a measure names."""
    if isinstance(measure, CampbellClearance):
        return tuple(measure.modes)
    if isinstance(measure, SystemFrequency):
        return measure.cluster or (measure.number,)
    return (measure.number,) if isinstance(measure, DampingRatio) else ()


def _orders(measures: Sequence[OfVibrations]) -> list[float]:
    named = {n for m in measures if isinstance(m, CampbellClearance) for n in m.orders}
    named |= {m.order for m in measures if isinstance(m, CriticalSpeed)}
    return sorted(named) or [1.0, 2.0, 3.0]


def _diagrams(diagram: CampbellDiagram, measures: Sequence[OfVibrations], words: Sequence[Any], draw: Draw) -> None:
    labels, title, end = words
    damped = bool((diagram.damping_ratios.abs() > spectra.UNDAMPED).any())
    for lane, name in enumerate(("start", "best")):
        arguments: dict[str, Any] = {"speeds": diagram.speeds, "frequencies": diagram.frequencies[lane]}
        arguments |= {"damping": diagram.damping_ratios[lane] if damped else None, "orders": _orders(measures)}
        whirl = diagram.whirl[lane]
        arguments["whirl"] = whirl if bool(whirl.any()) else None  # blades do not whirl
        files = [f"campbell_{name}{end}.png", f"campbell_{name}{end}.pdf"]
        draw(spectra.campbell, files, **arguments, title=f"{labels[lane]}: {title}")
    if any(isinstance(m, (DampingRatio, StabilityMargin, StabilityLimit)) for m in measures):
        arguments = {"values": diagram.speeds, "poles": diagram.poles[1], "heading": "speed [rad/s]"}
        files = [f"root_locus_best{end}.png", f"root_locus_best{end}.pdf"]
        draw(spectra.root_locus, files, **arguments, title=f"{labels[1]}: {title}")


def _shapes(
    states: SteadyStates, motion: Trajectory, numbers: Sequence[int], speed: float, folder: Any, end: str
) -> list[Any]:
    """Pages of vibrations of the best design; those of frequency zero have none."""
    frequencies = states.eigenvalues(NATURAL)[1, 0]
    free = int((frequencies == 0.0).sum())
    poles, rest = states.eigenvalues(POLES)[1, 0], _rest(states, motion)
    most = int((poles.imag > SWINGS * poles.abs()).sum())
    pages = []
    for number in numbers:
        if not free < number <= free + most:
            continue
        at = f" at {speed:g} rad/s" if speed else ""
        page = folder / f"mode_best_{number}{end}.html"
        pages.append(animate_mode(rest, page, number - free, title=f"best design, vibration {number}{at}"))
    return pages


def _rest(states: SteadyStates, motion: Trajectory) -> Equilibrium:
    """The state of the best design, the last lane, as an equilibrium without reactions."""
    lane = motion.lanes - 1
    dynamics = states.dynamics.values().select_lanes([lane])
    T, designs = dynamics.topology, {name: x[lane : lane + 1].detach() for name, x in motion.designs.items()}
    still, unknown = states.q.new_zeros(1, 1, T.n_v), states.q.new_full((1, 1, T.rows), torch.nan)
    signals = {"q": states.q[:, :, lane].T[None].detach(), "v": still, "a": still, "lam": unknown}
    return Equilibrium(
        t=states.t.reshape(1),
        signals=TensorSignals(signals),
        status=["ok"],
        stats={},
        system=motion.system,
        dynamics=dynamics,
        shapes=GivenShapes(lambda name: states.modes[name][-1:].detach()),  # with the modes of the batch
        designs=designs,
        rotation=states.rotation,
    )
