"""Pictures: figures of studies, and the animation of a motion.

>>> motion = mbd.simulate(mbd.examples.arm(), 0.1, steps=40)
>>> mbd.viz.animate(motion, "arm.html").name  # open it in a browser
'arm.html'
"""

from torchmbd.viz.animation import animate
from torchmbd.viz.design_map import design_map
from torchmbd.viz.fiber_paths import fiber_paths
from torchmbd.viz.figures import convergence, criterion, energy_over_time, save
from torchmbd.viz.film import film
from torchmbd.viz.vtu import save_mesh, save_modes, save_motion

__all__ = [
    "animate",
    "convergence",
    "criterion",
    "design_map",
    "energy_over_time",
    "fiber_paths",
    "film",
    "save",
    "save_mesh",
    "save_modes",
    "save_motion",
]
