"""The start of a motion for a system of other modes: the same displacements and rates of its flexible bodies.

    Psi' w' = Psi w      w, w'   modal coordinates of the modes Psi and of more modes Psi', whose span contains that of Psi;
                                 least squares over the same nodes where they are modes on a finer mesh

Checked in tests/design/test_errors_of_motions.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.math.rotation import rotation_matrix
from torchmbd.multibody.bodies.frame import MODAL
from torchmbd.multibody.system import System
from torchmbd.results.mode_shapes import DesignShapes
from torchmbd.results.motion_data import MotionData


def with_other_modes(motion: Any, system: System, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of `simulate` for a `system` of other modes, out of those of a motion: of `start` and `designs`.

    Raises InputError for a static equilibrium that begins with modal coordinates or rates: they cannot be combined.
    """
    designs, start = dict(arguments["designs"]), arguments["start"]
    numbers: dict[str, Any] = {}
    if isinstance(start, MotionData):
        numbers = _last_state(start)
    elif isinstance(start, Mapping):
        numbers = {name: torch.as_tensor(x, dtype=torch.float64).detach() for name, x in start.items()}
    shapes = None
    for name in system.topology.names[: system.topology.flexible]:
        for key in MODAL:
            label = f"{name}.{key}"
            of_design = designs.pop(label, getattr(motion.system.body(name), key))
            w = numbers.pop(label, of_design).detach()
            if bool(w.any()):
                shapes = shapes or DesignShapes(system, designs, motion.lanes)
                numbers[label] = _in_more_modes(motion.modes(name), w, shapes.values(name))
    if start == "equilibrium" and numbers:
        raise InputError(
            f"start is 'equilibrium', and bodies have {', '.join(map(repr, numbers))}; allowed: modal coordinates of zero"
        )
    return {**arguments, "designs": designs, "start": start if isinstance(start, str) and not numbers else numbers}


def _in_more_modes(psi: Tensor, w: Tensor, more: Tensor) -> Tensor:
    """Coordinates [lanes, m'] in shapes `more` [lanes, nodes, 6, m'] of those w [m] or [lanes, m] in shapes psi."""
    u = torch.einsum("lnim,lm->lni", psi, w.expand(len(psi), -1))
    more = more[:, : u.shape[1]]  # a finer mesh has further nodes
    return torch.linalg.lstsq(more.flatten(1, 2), u.flatten(1, 2)[..., None]).solution[..., 0]


def _last_state(motion: Any) -> dict[str, Tensor]:
    """The last state of a motion as numbers of all bodies [lanes, ...]."""
    T, state = motion.dynamics.topology, {}
    for i, name in enumerate(T.names):
        body = motion.body(name)
        p = body.p[:, -1] / body.p[:, -1].norm(dim=-1, keepdim=True)
        state[f"{name}.position"] = body.r[:, -1]
        state[f"{name}.axes"] = rotation_matrix(p.T).movedim(-1, 0)
        state[f"{name}.velocity"] = body.at().velocity[:, -1]
        state[f"{name}.angular_velocity"] = body.omega[:, -1]
        if i < T.flexible:
            state[f"{name}.modal"], state[f"{name}.modal_velocity"] = body.w[:, -1], body.wd[:, -1]
    return {key: x.detach() for key, x in state.items()}
