"""The warnings about every model and every motion. `Simulation` calls these functions before and after it integrates.

`diagnose=False` puts `warn_of_model` and `warn_of_motion` off. The status of a lane says the same in both cases.
Checked in tests/diagnosis/test_diagnose.py, and where each function is.
"""

from __future__ import annotations

from collections.abc import Sequence

from torchmbd.diagnosis.elastic_limits import warn_of_damping, warn_of_displacements, warn_of_spin
from torchmbd.diagnosis.failures import name_causes, name_singular_positions, warn_of_singular_positions
from torchmbd.diagnosis.gains import mark_gains
from torchmbd.diagnosis.jumps import warn_of_jumps
from torchmbd.diagnosis.load_shares import warn_of_loads
from torchmbd.diagnosis.rigid_vibrations import mark_vibrations
from torchmbd.diagnosis.truncation import warn_static_truncation
from torchmbd.integrate.integrator import Integrator
from torchmbd.integrate.phases.phase import Phase
from torchmbd.multibody.system import System
from torchmbd.results.trajectory import Trajectory


def warn_of_model(
    system: System, duration: float, steps: int | None, integrator: Integrator, phases: Sequence[Phase]
) -> None:
    """Warn of modes that are too few at joints and forces, and of laws that jump between the steps."""
    warn_static_truncation(system)
    warn_of_jumps(system, duration, steps, integrator, phases)


def explain(motion: Trajectory, beyond: Trajectory) -> None:
    """Add causes to the status of lanes that failed, and mark lanes that gain energy from nothing or whose vibrations are
    unresolved.

    motion   of plain numbers;  beyond: the same with the numbers after a failure
    """
    if motion.is_single:
        name_singular_positions(beyond)
    name_causes(motion)
    mark_gains(motion)
    mark_vibrations(motion)


def warn_of_motion(motion: Trajectory, beyond: Trajectory) -> None:
    """Warn of singular positions, and of what linear elastic displacements leave out: spin, loads, large displacements.

    stats["spin_ratio"] and stats["load_share"] have the numbers.
    """
    if motion.is_single:
        warn_of_singular_positions(beyond)
    warn_of_spin(motion)
    warn_of_loads(motion)
    warn_of_displacements(motion)
    warn_of_damping(motion)
