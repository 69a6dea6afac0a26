"""The base point of a rigid body: the point whose position is the r of its coordinates (topology.py).

It is the origin of the body, or the center of mass where the origin is far from it. Steps treat r and the rotation as if they
were independent of each other, so an error of rotation moves the body by the arm of the center from r: forces of constraints
have to undo it. The answers then depend on where the origin is, and steps do not converge. An origin in a joint with the ground
stays: that joint may hold it, so that it has no error, and leaves fewer unknowns (saddle/condensation.py).

    position   r = o + A c        velocity   r' = o' + A (om x c)        torque about o   torque about r + c x A'f

o is the origin and c the base point in body axes. What users give, and results show, is the origin; a base point does not
change with the design. Pairs or tensors, as in equations.py.
Checked in tests/multibody/equations/test_base_points.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchmbd.math.gradients import untransformed
from torchmbd.math.pair import cat, cross, matvec, matvec_t
from torchmbd.math.rotation import rotation_matrix
from torchmbd.multibody.bodies.flexible_beam import BeamNode

FAR = 3.0  # radii of gyration: 10 of them double the error of the steps of a double pendulum, 100 need ten times the steps


def base_points(bodies: Sequence[Any], held: Sequence[Any]) -> Tensor | None:
    """Base points in body axes [3, bodies, 1, 1] [m]; None: all are origins.

    held   bodies whose origin is in a joint with the ground
    """
    points = torch.zeros(3, len(bodies), 1, 1, dtype=torch.float64)
    for i, body in enumerate(bodies):
        if not hasattr(body, "mesh") and not isinstance(body, BeamNode) and not any(body is x for x in held):
            points[:, i, 0, 0] = _base_point(body)
    return points if bool(points.any()) else None


def _base_point(body: Any) -> Tensor:
    """The base point of a rigid body without such a joint [3]."""
    center, mass, P = (
        untransformed(x).detach().reshape(-1, *x.shape[x.dim() - rank :])[0]
        for x, rank in ((body.center, 1), (body.mass, 0), (body.second_moment, 2))
    )
    gyration = (P.diagonal().sum() / mass).sqrt()
    return center if float(center.norm()) > FAR * float(gyration) else torch.zeros_like(center)


def of_origins(c: Tensor | None, q: Any) -> Any:
    """Coordinates q [n_q, ...] of those whose r are origins."""
    return _with_arms(c, q, 1.0)


def to_origins(c: Tensor | None, q: Any) -> Any:
    """Coordinates with origins as r [n_q, ...], of coordinates q."""
    return _with_arms(c, q, -1.0)


def _with_arms(c: Tensor | None, q: Any, sign: float) -> Any:
    if c is None:
        return q
    n = c.shape[1]
    arms = matvec(rotation_matrix(q[3 * n : 7 * n].unflatten(0, (4, n))), sign * c)
    return cat([q[: 3 * n] + arms.flatten(0, 1), q[3 * n :]])


def rates_of_origins(c: Tensor | None, A: Any, v: Any) -> Any:
    """Rates v [n_v, ...] of those whose r' are velocities of origins; A: rotations of the bodies [3, 3, bodies, ...]."""
    return _with_arm_rates(c, A, v, 1.0)


def rates_to_origins(c: Tensor | None, A: Any, v: Any) -> Any:
    """Rates with velocities of origins as r' [n_v, ...], of rates v."""
    return _with_arm_rates(c, A, v, -1.0)


def _with_arm_rates(c: Tensor | None, A: Any, v: Any, sign: float) -> Any:
    if c is None:
        return v
    n = c.shape[1]
    arms = matvec(A, cross(v[3 * n : 6 * n].unflatten(0, (3, n)), sign * c))
    return cat([v[: 3 * n] + arms.flatten(0, 1), v[3 * n :]])


def forces_on_origins(c: Tensor | None, A: Any, f: Any) -> Any:
    """Generalized forces [n_v, ...] on rates with velocities of origins, of those on rates with base points."""
    if c is None:
        return f
    n = c.shape[1]
    torque = cross(c, matvec_t(A, f[: 3 * n].unflatten(0, (3, n))))
    return cat([f[: 3 * n], f[3 * n : 6 * n] + torque.flatten(0, 1), f[6 * n :]])
