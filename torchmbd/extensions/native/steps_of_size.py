"""One step of sizes and ends that differ from lane to lane, its unknowns found by compiled code (steps.cpp).

Every correction has a new matrix. What is left to operators of torch: lanes that do not converge so, laws that are called
back, tangents.
Checked in tests/integrate/phases/test_variable_step.py.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchmbd.extensions.native.library import library
from torchmbd.extensions.native.simd_layout import LANES, addresses, blocks, lanes_out, unknown_weights
from torchmbd.extensions.native.steps import Job, make_steps
from torchmbd.integrate.lanes import expanded
from torchmbd.integrate.step import Step
from torchmbd.math.pair import value
from torchmbd.multibody.system.dynamics import Dynamics

_CORRECTIONS = 7  # quadratic from a hundredth: four reach rounding, a further one shows it


def unknowns(dynamics: Dynamics, step: Step) -> tuple[Tensor, Tensor] | None:
    """Unknowns [n, 1, lanes] of a step, and the sizes of its last two corrections [2, lanes]; None: there is no such code."""
    code = library(dynamics)
    if code is None or code.called.actions:
        return None
    T, lanes, new = dynamics.topology, step.x.q.shape[-1], torch.zeros
    state = blocks(torch.cat([expanded(x, lanes) for x in step.x.values()]).detach())
    values = code.value_blocks(dynamics)
    values = values if len(values) == len(state) else values.expand(len(state), -1, -1, -1).contiguous()  # of one lane
    prescribed, moved = (blocks(x) for x in _prescribed(step, lanes))
    numbers = {"lanes": lanes, "data": values.shape[2], "prescribed": prescribed.shape[2], "first": 1, "steps": 1}
    numbers |= {"corrections": _CORRECTIONS, "refresh": -1 if T.has_fast_elements else 0, "fresh": 1}
    numbers |= {"moving": moved.shape[2], "tables": len(prescribed)}
    rows = {"q": T.n_q, "v": T.n_v, "vd": T.n_v, "lam": T.rows, "sizes": 3}
    arrays: dict[str, Tensor | None] = {name: new(n, lanes, dtype=torch.float64) for name, n in rows.items()}
    arrays |= {"shared": prescribed, "state": state, "values": values, "moved": moved}
    arrays["tangents"] = arrays["errors"] = new(0, dtype=torch.float64)
    arrays["row_mask"], arrays["diagonal_shift"] = dynamics.diagonal() or (None, None)
    arrays["factors"] = new(len(values) * code.code.steps_factors(code.address) // 8, dtype=torch.float64)
    each = new(len(values), LANES, dtype=torch.float64)
    arrays |= {"passes": each, "counted": each + 2.0, "scale": each.clone()}
    arrays["weights"] = unknown_weights(dynamics, lanes)
    job = Job(mechanism=code.address, **numbers, **addresses(arrays))
    if make_steps(code.code, job, code.threads(lanes)):
        return None
    _, _, vd, _, lam = lanes_out(state, lanes).split([T.n_q, T.n_v, T.n_v, T.n_v, T.rows])
    sizes = arrays["sizes"]
    assert sizes is not None
    return torch.cat([vd, lam]), sizes[:2]


def _prescribed(step: Step, lanes: int) -> tuple[Tensor, Tensor]:
    """Weights and what drives prescribe, and what laws with design variables prescribe [n, 1, lanes]."""
    T, at = step.model.T, step.prescribed.values()
    weights = [torch.as_tensor(value(w), dtype=torch.float64).reshape(1, -1) for w in step.model.plain]
    shared: list[Tensor] = []
    varied = [torch.zeros(0, lanes, dtype=torch.float64)]
    for i, law in enumerate(at.laws):
        of_law = [x.reshape(-1, x.shape[-1]) for x in law or ()]
        varied, shared = (varied + of_law, shared) if i in T.varying_primitives else (varied, shared + of_law)
    poses = [at.A.reshape(-1, at.A.shape[-1]), at.r.reshape(-1, at.r.shape[-1]), at.t.reshape(1, -1)]
    numbers, moved = (
        torch.cat([expanded(x, lanes) for x in parts])[:, None].detach()
        for parts in ([*weights, *poses, *shared], varied)
    )
    return numbers, moved
