"""Pictures: figures of studies, and the animation of a motion."""

from torchmbd.viz.animation import animate
from torchmbd.viz.figures import convergence, criterion, energy_over_time, save
from torchmbd.viz.vtu import save_mesh, save_modes, save_motion

__all__ = ["animate", "convergence", "criterion", "energy_over_time", "save", "save_mesh", "save_modes", "save_motion"]
