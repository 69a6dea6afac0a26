"""Pictures: figures of studies, and the animation of a motion.

>>> motion = mbd.simulate(mbd.examples.arm(), 0.1, steps=40)
>>> mbd.viz.animate(motion, "arm.html").name  # open it in a browser
'arm.html'
"""

from typing import Any

from torchmbd.registry import public, public_names
from torchmbd.viz.animation import animate
from torchmbd.viz.criteria import criteria_over_iterations, criteria_over_time, weighted_parts
from torchmbd.viz.design_map import design_map
from torchmbd.viz.failure_map import failure_map
from torchmbd.viz.fibers import fibers
from torchmbd.viz.figures import convergence, criterion, energy_over_time, save
from torchmbd.viz.film import film
from torchmbd.viz.parallel_coordinates import parallel_coordinates

__all__ = [
    "animate",
    "convergence",
    "criteria_over_iterations",
    "criteria_over_time",
    "criterion",
    "design_map",
    "energy_over_time",
    "failure_map",
    "fibers",
    "film",
    "parallel_coordinates",
    "save",
    "weighted_parts",
]


def __getattr__(name: str) -> Any:
    """Pictures of extensions."""
    return public(f"viz.{name}")


def __dir__() -> list[str]:
    special = [name for name in globals() if name.startswith("__")]
    return [*special, *__all__, *(x.removeprefix("viz.") for x in public_names() if x.startswith("viz."))]
