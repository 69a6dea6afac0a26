"""What is told of every model and of every motion: `Simulation` calls these functions before and after it integrates.

Checked in the tests of each function.
"""

from __future__ import annotations

from collections.abc import Sequence

from torchmbd.diagnosis.elastic_limits import warn_of_displacements, warn_of_spin
from torchmbd.diagnosis.failures import name_causes, report_singular_positions
from torchmbd.diagnosis.gains import mark_gains
from torchmbd.diagnosis.jumps import warn_of_jumps
from torchmbd.diagnosis.load_shares import warn_of_loads
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


def diagnose(motion: Trajectory, beyond: Trajectory) -> None:
    """Add causes to the status of lanes that failed, and doubts to that of others; warn of what linear elastic displacements
    leave out. The motion has plain numbers; `beyond` has them also after a failure.
    """
    if motion.is_single:
        report_singular_positions(beyond)
    warn_of_spin(motion)
    warn_of_loads(motion)
    warn_of_displacements(motion)
    name_causes(motion)
    mark_gains(motion)
