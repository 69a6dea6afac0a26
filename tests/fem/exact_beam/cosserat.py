"""Cantilevers by the differential equations of Cosserat's rod, a boundary value problem: another route to exact beams.

    r' = R (e_1 + gamma),    R' = R ~(k_0 + kappa),    n' = -q,    m' = -r' cross n,    (gamma, kappa) = S R' (n, m)

R by Euler parameters; S: compliance of the section; k_0: curvature and twist without load, in the section's axes; q: dead
load per length.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.integrate import solve_bvp


def rotations(p: np.ndarray) -> np.ndarray:
    """[n, 3, 3] of Euler parameters [4, n]."""
    w, x, y, z = p / np.linalg.norm(p, axis=0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.moveaxis(np.array([np.stack(row) for row in rows]), -1, 0)


def cantilever(
    length: float,
    stiffness: Callable[[float], np.ndarray] | np.ndarray,
    bent: np.ndarray,
    force: np.ndarray | None,
    moment: np.ndarray | None = None,
    load: np.ndarray | None = None,
    levels: int = 6,
    follower: bool = False,
) -> np.ndarray:
    """Place of the tip of a beam that starts at the origin along x, its section's y-axis along y.

    bent   curvature and twist without load [3], of the section's axes
    follower   force and moment are in the axes of the section at the tip
    """
    own = stiffness if callable(stiffness) else lambda s: stiffness
    unit = own(0.0)[5, 5] / length**2  # of forces: all unknowns of one size
    tip, couple, q = (np.zeros(3) if x is None else x / unit for x in (force, moment, load))

    def K(s: float) -> np.ndarray:
        return own(s) / unit

    def slope(share: float):
        def f(s, y):
            R = rotations(y[3:7])
            n, m = y[7:10].T, y[10:13].T
            inside = np.concatenate([np.einsum("aji,aj->ai", R, n), np.einsum("aji,aj->ai", R, m)], 1)
            strain = np.stack([np.linalg.solve(K(t), x) for t, x in zip(s, inside, strict=True)])
            rate = np.einsum("aij,aj->ai", R, strain[:, :3] + [1.0, 0.0, 0.0])
            k = (strain[:, 3:] + bent).T
            w, v = y[3], y[4:7]
            turn = np.concatenate([-0.5 * (v * k).sum(0)[None], 0.5 * (w * k + np.cross(v.T, k.T).T)])
            zero = np.zeros_like(n) - share * q
            return np.concatenate([rate.T, turn, zero.T, -np.cross(rate, n).T])

        def ends(a, b):
            R = rotations(b[3:7, None])[0] if follower else np.eye(3)
            result = np.concatenate([b[7:10] - share * R @ tip, b[10:13] - share * R @ couple])
            return np.concatenate([a[:3], a[3:7] - [1.0, 0.0, 0.0, 0.0], result])

        return f, ends

    s = np.linspace(0.0, length, 41)
    y = np.zeros((13, 41))
    y[0], y[3] = s, 1.0
    for share in np.linspace(0.0, 1.0, levels + 1):
        result = solve_bvp(*slope(share), s, y, tol=1e-7, max_nodes=20000)
        assert result.success, result.message
        s, y = result.x, result.y
    return y[:3, -1]
