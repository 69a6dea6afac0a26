"""Conditions r <= 1 on the lamination parameters of stacks: means of V = (cos 2t, sin 2t, cos 4t, sin 4t).

Of the membrane parameters a, and likewise of the bending parameters d, exactly (Hammer et al.):

    a1^2 + a2^2 <= 1        2 a1^2 (1 - a3) + 2 a2^2 (1 + a3) + a3^2 + a4^2 - 4 a1 a2 a4 <= 1

Together: every function f = f0 + c.V of the direction with 0 <= f <= 1 has the means a_f over the thickness, d_f weighted with
12 z^2 / h^2 and b_f weighted with 4 z / h. Where f is 1 in a share s of the thickness and 0 elsewhere, d_f is largest with the
share at the faces and least with it in the middle, and b_f is largest with it on one side:

    a_f >= 0        a_f^3 <= d_f <= 1 - (1 - a_f)^3        |b_f| <= 2 a_f (1 - a_f)

The functions are f = (1 - cos(2t - p)) (1 - cos(2t - q)) over their largest value, p and q multiples of 30 degrees. All
conditions are convex and necessary. Those of a alone and of d alone are also sufficient; together they are nearly so:
`recover_stacks` shows the distance from feasible parameters to the nearest stack.
Source: Hammer et al., Int. J. Solids Struct. 34 (1997) 415-434; the conditions on d_f given a_f are those of Diaconu, Sato and
Sekine, Feasible region in general design space of lamination parameters, AIAA J. 40 (2002) 559-565, for every such f.
Checked in tests/extensions/lamination/test_conditions.py.
"""

from __future__ import annotations

import math
from functools import cache
from itertools import combinations_with_replacement

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.math.gradients import constant_arguments

DIRECTIONS = 12
#: Number of conditions: two of a, two of d, and five of every f.
CONDITIONS = 4 + 5 * (DIRECTIONS * (DIRECTIONS + 1) // 2)
_ROUNDING = 1e-9
_NAMES = ("membrane", "coupling", "bending")
# Which parameters the first conditions are about, and the others.
_ALONE = (
    "membrane",
    "membrane",
    "bending",
    "bending",
)
_TOGETHER = ("membrane", "bending, membrane", "bending, membrane", "coupling, membrane", "coupling, membrane")


def directions(angles: Float[Tensor, "*lanes"]) -> Float[Tensor, "*lanes 4"]:
    """Return V of angles [rad]."""
    return torch.stack([(2 * angles).cos(), (2 * angles).sin(), (4 * angles).cos(), (4 * angles).sin()], -1)


def conditions(
    a: Float[Tensor, "*lanes 4"], b: Float[Tensor, "*lanes 4"], d: Float[Tensor, "*lanes 4"]
) -> Float[Tensor, "*lanes conditions"]:
    """Return r of membrane, coupling and bending parameters: all at most 1 for a stack, differentiable."""
    a, b, d = torch.broadcast_tensors(a, b, d)  # of lanes only those vary that are differentiated
    constant, slope = _functions()
    a_f, d_f, b_f = constant + a @ slope.T, constant + d @ slope.T, b @ slope.T
    alone = [x for V in (a, d) for x in ((V[..., :2] ** 2).sum(-1), _hammer(V))]
    bound = 1.0 - 2.0 * a_f * (1.0 - a_f)
    together = [1.0 - a_f, 1.0 + a_f.clamp(min=0.0) ** 3 - d_f, d_f + (1.0 - a_f) ** 3, bound + b_f, bound - b_f]
    return torch.cat([torch.stack(alone, -1), *together], -1)


def infeasibility_reasons(
    a: Float[Tensor, "*lanes 4"], b: Float[Tensor, "*lanes 4"], d: Float[Tensor, "*lanes 4"]
) -> list[str]:
    """Return the reason why no stack has these parameters, one text for each lane; empty where all conditions hold."""
    rows = conditions(a, b, d).reshape(-1, CONDITIONS)
    reasons = []
    for row, *parameters in zip(rows, *(x.reshape(-1, 4) for x in (a, b, d)), strict=True):
        worst, k = row.max(0)
        which = _ALONE[int(k)] if k < len(_ALONE) else _TOGETHER[(int(k) - len(_ALONE)) // len(_functions()[0])]
        text = ", ".join(f"{name} = {x.tolist()}" for name, x in zip(_NAMES, parameters, strict=True) if name in which)
        reasons.append(
            f"{text}: no stack has these (a condition that is at most 1 is {worst:.4g})"
            if worst > 1 + _ROUNDING
            else ""
        )
    return reasons


def _hammer(V: Tensor) -> Tensor:
    V1, V2, V3, V4 = V.unbind(-1)
    return 2 * V1**2 * (1 - V3) + 2 * V2**2 * (1 + V3) + V3**2 + V4**2 - 4 * V1 * V2 * V4


@cache
@constant_arguments
def _functions() -> tuple[Tensor, Tensor]:
    """f0 [n] and c [n, 4] of the functions f, 0 <= f <= 1."""
    phases = [2.0 * math.pi * k / DIRECTIONS for k in range(DIRECTIONS)]
    p, q = torch.tensor(list(combinations_with_replacement(phases, 2)), dtype=torch.float64).T
    # (1 - cos(x - p)) (1 - cos(x - q)) by its harmonics, x = 2 t
    rows = [
        -(p.cos() + q.cos()),
        -(p.sin() + q.sin()),
        0.5 * (p + q).cos(),
        0.5 * (p + q).sin(),
    ]
    constant, slope = 1.0 + 0.5 * (p - q).cos(), torch.stack(rows, -1)
    # f depends on u = cos(x - m), m the middle of p and q: f = (u - cos((p - q)/2))^2, largest at u = 1 or -1
    largest = (1.0 + ((p - q) / 2).cos().abs()) ** 2
    return constant / largest, slope / largest[:, None]
