"""Laws of forces that are to blame for a motion that failed: those that are not finite where it went next.

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


def names(motion: MotionData) -> dict[tuple[type, int], str]:
    """Name of the force element of each action: (kind, number among its kind) -> name."""
    count, found = Counter(), {}
    for force in motion.system.forces:
        for action in force.actions(AttachmentTable()):
            found[action.kind, count[action.kind]] = force.name
            count[action.kind] += 1
    return found


def laws_at_fault(motion: MotionData, lane: int) -> list[str]:
    """What to say of the laws that are not finite where a lane went after its last finite time; [] if all are."""
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
    called, found = names(motion), []
    states = equations.action_states(T, data, at, v)
    ahead = [(s + h * rate, rate, direction) for s, rate, direction in states]
    both = zip(*(equations.strengths(T, data, some, t) for some in (states, ahead)), strict=True)
    for action, (s, rate, _), forces in zip(T.actions, states, both, strict=True):
        good = [f.flatten(1).isfinite().all(1) for f in forces]
        for k in torch.nonzero(~(good[0] & good[1]))[:, 0].tolist():
            law = action.laws[k]
            if isinstance(law, Port):
                found.append(f"the {law.control.label} is not finite near t = {float(t):.6g} s")
                continue
            found.append(
                f"the law of {called[type(action), k]!r} is not finite near s = {float(s[k]):.6g}, "
                f"s' = {float(rate[k]):.6g}, t = {float(t):.6g} s"
            )
    return list(dict.fromkeys(found))
