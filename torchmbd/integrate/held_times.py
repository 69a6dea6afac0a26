"""Held values of controllers: when they change, and steps that end there.

    f(t_j) = (f(t_j-) + f(t_j+)) / 2     where a step ends at a jump: the impulse is exact, the motion of second order

A step takes a law at its ends. If a jump D comes a share s of a step after the end of one, the impulse is off by
h D (s - 1/2), of first order, whatever the weights of a method. At s = 0 the mean of both sides makes it exact.

`ControlHistory(kind="hold")` has this mean, and its jumps are known: the number of steps is chosen such that some end there
(step_count.py), and steps that the caller states are divided until they do (retries.py). Of other laws, and where that cannot
be, diagnosis/jumps.py warns.
Checked in tests/diagnosis/test_jumps.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction

from torchmbd.integrate.contacts import MOST_SUBSTEPS
from torchmbd.integrate.phases.phase import Phase
from torchmbd.math.jumps import distinct
from torchmbd.multibody.forces.control_history import ControlHistory
from torchmbd.multibody.forces.feedback import Control
from torchmbd.multibody.system.dynamics import Dynamics

SAME = 1e-9  # relative: times that are equal, and of a step
MOST = 20_000  # steps: a larger number that all jumps need is not taken


def held_times(control: Control, duration: float) -> list[float]:
    """Times within the duration at which held values of a controller change [s]; it may contain a ControlHistory."""
    module = getattr(control, "module", None)
    histories = [m for m in module.modules() if isinstance(m, ControlHistory)] if module is not None else []
    return distinct((t for m in histories for t in m.jumps), duration)


def within_phases(times: Sequence[float], phases: Sequence[Phase], duration: float) -> list[float]:
    """Those of the times at which no phase ends: steps end there anyway."""
    ends = [phase.end_time for phase in phases if phase.end_time is not None]
    return [t for t in times if not any(abs(t - end) <= SAME * duration for end in ends)]


def steps_at(times: Sequence[float], duration: float) -> int | None:
    """The least number of equal steps some of which end at these times; None: it is beyond 20,000."""
    count = 1
    for t in times:
        share = Fraction(t / duration).limit_denominator(MOST)
        count = math.lcm(count, share.denominator)
        if count > MOST or abs(float(share) - t / duration) * count > SAME:
            return None
    return count


def held_times_of(dynamics: Dynamics, duration: float) -> list[float]:
    """Times within the duration at which held values of any controller change [s]."""
    links = dynamics.topology.links
    controls = [link.control for link in links.each if bool((link.read == 2 * links.total).any())]  # those that read t
    return distinct((t for control in controls for t in held_times(control, duration)), duration)


def substeps_at(times: Sequence[float], duration: float, steps: int) -> int | None:
    """Into how many parts each of the equal steps is divided so that some end at these times; None: too many."""
    count = steps_at(times, duration)
    substeps = None if count is None else count // math.gcd(count, steps)
    return substeps if substeps is not None and substeps <= MOST_SUBSTEPS else None
