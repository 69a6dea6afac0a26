"""Vibrations that gain energy which nothing gives them: steps too long for what a switch excites.

Checked in tests/diagnosis/test_gains.py.
"""

from __future__ import annotations

from torchmbd.integrate.estimates import GOOD_STEP
from torchmbd.integrate.lane_status import UNRESOLVED, warn_unresolved
from torchmbd.results.energies import energies
from torchmbd.results.motion_data import OK
from torchmbd.results.trajectory import Trajectory

_GAIN = 0.05  # of the largest kinetic and strain energy, which no load gives: trapezoidal works are off by a percent


def mark_gains(motion: Trajectory) -> None:
    """Set the status of lanes of a motion of values whose vibrations gain energy that nothing gives them, after a switch.

    A lock excites vibrations that the steps before did not have to resolve; those of a fifth of a period or more may grow
    from step to step, as they do not decay in a method of little numerical damping. Works of drives and of laws of forces
    have errors of the steps themselves, so systems with them are left out.
    """
    T, errors = motion.dynamics.topology, motion.stats.get("step_error")
    driven = any(p.driven for p in T.primitives) or len(T.actions) > 0
    if not motion.switches or errors is None or driven or not (T.flexible or T.has_fast_elements):
        return
    lanes = [k for k, status in enumerate(motion.status) if status == OK and float(errors[k]) > GOOD_STEP]
    if not lanes:
        return
    e = energies(motion, lanes)
    gain = (e.stored + e.lost - e.applied - (e.stored - e.applied)[:, :1]).amax(1)
    size = (e.kinetic + e.strain).amax(1)
    for lane, share in zip(lanes, (gain / size).tolist(), strict=True):
        if share > _GAIN:
            motion.status[lane] = (
                f"{UNRESOLVED}energy comes from nothing, {share:.0%} of the largest kinetic and strain energy. The steps "
                "do not resolve vibrations of a flexible body after a switch, and these grow. Try: more steps, a smaller "
                "spectral_radius, or damping of the body"
            )
    warn_unresolved([motion.status[lane] for lane in lanes])
