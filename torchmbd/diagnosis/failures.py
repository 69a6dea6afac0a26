"""Why a motion failed: what is added to the status of its lanes.

Singular positions (results/singular_positions.py), for lanes that did not fail when they were integrated again
(integrate/retries.py) as a warning; bodies that spin or are displaced beyond what linear elastic displacements hold for
(elastic_limits.py); and laws of forces that are not finite just after the last finite state,

    f(s, s', t + h),  f(s + h s', s', t + h)        at the last time t at which the motion is finite, h the output interval

Checked in tests/results/test_singular_positions.py, tests/diagnosis/test_elastic_limits.py,
tests/multibody/forces/test_laws.py.
"""

from __future__ import annotations

from collections import Counter

import torch

from torchmbd.diagnosis.elastic_limits import FAST, LARGE, displacement_ratios, is_stiffened, spin_ratios
from torchmbd.errors import warn
from torchmbd.math.pair import value
from torchmbd.multibody.equations import equations
from torchmbd.multibody.forces.feedback import Port
from torchmbd.multibody.joints.joint import AttachmentTable
from torchmbd.results.motion_data import MotionData, has_failed
from torchmbd.results.singular_positions import may_be_near, positions_of_lane
from torchmbd.results.trajectory import Trajectory

_MANY = 3  # further corrections of a step, each with a new matrix: elsewhere one is mostly enough


def action_names(motion: MotionData) -> dict[tuple[type, int], str]:
    """Name of the force element of each action: (kind, number among its kind) -> name."""
    count, names = Counter(), {}
    for force in motion.system.forces:
        for action in force.actions(AttachmentTable()):
            names[action.kind, count[action.kind]] = force.name
            count[action.kind] += 1
    return names


def laws_at_fault(motion: MotionData, lane: int) -> list[str]:
    """Messages on the laws that are not finite just after the last finite state of a lane; [] if all are."""
    T = motion.dynamics.topology
    good = torch.isfinite(motion.q[lane]).all(1) & torch.isfinite(motion.v[lane]).all(1)
    ended = torch.nonzero(~good)
    if not T.actions or not len(ended) or int(ended[0]) == 0:
        return []
    i = int(ended[0]) - 1
    t, h = motion.t[i + 1], motion.t[i + 1] - motion.t[i]
    dynamics = motion.dynamics.values().select_lanes([lane if motion.dynamics.lanes > 1 else 0])
    data = {name: value(x) for name, x in dynamics.data.items()}
    q, v = (x[lane, i][:, None, None] for x in (motion.q, motion.v))
    at = equations.placement(T, data, q, T.prescribed(t, data))
    names, faults = action_names(motion), []
    states = equations.action_states(T, data, at, v)
    ahead = [(s + h * rate, rate, direction) for s, rate, direction in states]
    both = zip(*(equations.strengths(T, data, at_states, t) for at_states in (states, ahead)), strict=True)
    for action, (s, rate, _), forces in zip(T.actions, states, both, strict=True):
        finite = [f.flatten(1).isfinite().all(1) for f in forces]
        for k in torch.nonzero(~(finite[0] & finite[1]))[:, 0].tolist():
            law = action.laws[k]
            if isinstance(law, Port):
                faults.append(f"the {law.control.label} is not finite near t = {float(t):.6g} s")
                continue
            faults.append(
                f"the law of {names[type(action), k]!r} is not finite near s = {float(s[k]):.6g}, "
                f"s' = {float(rate[k]):.6g}, t = {float(t):.6g} s"
            )
    return list(dict.fromkeys(faults))


def name_singular_positions(motion: MotionData) -> None:
    """Add singular positions, and laws of forces that are not finite, to the status of lanes that failed."""
    for lane, status in enumerate(motion.status):
        if has_failed(status):
            near = positions_of_lane(motion, lane)[:1]  # after the first the motion means little
            motion.status[lane] = "; ".join([status, *laws_at_fault(motion, lane), *map(str, near)])


def warn_of_singular_positions(motion: MotionData) -> None:
    """Warn of them in lanes that succeeded when they were integrated again, or in which a step took many corrections."""
    failed_first, further = motion.stats.get("failed_first", ()), motion.stats.get("further_corrections")
    for lane, status in enumerate(motion.status):
        doubtful = lane in failed_first or (further is not None and float(further[lane]) >= _MANY)
        if doubtful and not has_failed(status) and may_be_near(motion, lane):
            for near in positions_of_lane(motion, lane):
                warn(f"{near}. After this position the motion may not be unique, and gradients may be wrong")


def name_causes(motion: Trajectory) -> None:
    """Append to the status of each lane whose motion broke off the spin or the displacements that likely caused it."""
    if not any(has_failed(status) for status in motion.status):
        return
    spins, displacements = spin_ratios(motion), displacement_ratios(motion)
    complete = torch.isfinite(motion.q).flatten(1).all(1)  # to the end: such a motion failed for another reason
    for lane, status in enumerate(motion.status):
        if not has_failed(status) or complete[lane]:
            continue
        spin = {name: float(ratio[lane]) for name, ratio in spins.items() if not is_stiffened(motion, name)}
        size = {name: float(ratio[lane]) for name, ratio in displacements.items()}
        for ratios, limit, text in (
            (spin, FAST, "turns at {:.1g} of its first frequency without stiffening; stiffening=True helps"),
            (size, LARGE, "is displaced by {:.1g} of its size, but elastic displacements are taken as small"),
        ):
            name = max(
                (name for name, x in ratios.items() if limit < x < torch.inf), key=ratios.__getitem__, default=None
            )
            if name is not None:
                motion.status[lane] = f"{status}; likely cause: body {name!r} {text.format(ratios[name])}"
                break
