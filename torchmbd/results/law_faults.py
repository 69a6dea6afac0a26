"""Laws of forces by which a motion failed: those that are not finite just after its last finite state.

    f(s, s', t + h),  f(s + h s', s', t + h)        at the last time t at which the motion is finite, h the output interval

Checked in tests/multibody/forces/test_laws.py.
"""

from __future__ import annotations

from collections import Counter

import torch

from torchmbd.math.pair import value
from torchmbd.multibody.forces.feedback import Port
from torchmbd.multibody.joints.joint import AttachmentTable
from torchmbd.multibody.system import equations
from torchmbd.results.motion_data import MotionData


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
