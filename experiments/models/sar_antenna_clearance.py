"""Interference in the antenna: how near panels and trusses come to each other, from the motion alone (no contact acts).

    gap = normal . (x - surface under x)      of points x that lie above a panel, from its mid-surface   [m]

Panel 1 is the rectangle X = -LENGTH to 0 of the ground plane Z = 0, its front up; panels 2 and 3 have trusses and each other
behind their backs (local -z).
Negative: a body passed through a panel. Points within `NEAR` of a place where both are joined are left out.
Elastic displacements of a panel are interpolated in its grid of nodes.
Checked in tests/experiments/test_sar_antenna.py.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

import torchmbd as mbd
from experiments.models.sar_antenna import phi3, theta
from experiments.models.sar_antenna_data import HALF, LENGTH, ROD_POINT, WIDTH

NEAR = 0.2  # [m]; at 0.19 m from the hinge line the paper's optimum touches panel 1 by half a millimeter, too
APART = 0.3  # [rad] by which the crank may run ahead of panel 3, whose angles are equal in a rigid parallelogram
_SAMPLES = 17


def gaps(motion: mbd.Trajectory, rod_point: Sequence[float] = ROD_POINT) -> dict[str, Tensor]:
    """Smallest gap of every pair over time [lanes, times] [m]; inf while nothing lies above the panel.

    rod_point   of the antenna (experiments.models.sar_antenna.build) [m]
    """
    panels = {name: _nodes(motion, name) for name in ("panel2", "panel3")}
    length = math.hypot(HALF, rod_point[1])
    crank, (roda, rodb) = _line(motion, "crank", HALF + rod_point[0]), (_line(motion, f"rod{k}", length) for k in "ab")
    rods = torch.cat([roda, rodb], 2)
    hinge, ends = (-HALF, None), [(rod_point[0], side * rod_point[1]) for side in (-1, 1)]
    return {
        "panel 1 - panel 2": _above_ground(panels["panel2"]),
        "panel 1 - panel 3": _above_ground(panels["panel3"]),
        "panel 2 - panel 3": _over(motion, "panel2", panels["panel3"], [(HALF, None)]),
        "panel 2 - crank": _over(motion, "panel2", crank, [(0.0, 0.0)]),
        "panel 2 - rods": _over(motion, "panel2", rods, []),
        "panel 3 - crank": _over(motion, "panel3", crank, [hinge]),
        "panel 3 - rods": _over(motion, "panel3", rods, ends),
    }


def _nodes(motion: mbd.Trajectory, name: str) -> Tensor:
    """Points of a panel in ground axes [lanes, times, n, 3]; the corners of a rigid one."""
    body = motion.body(name)
    if body.mesh is not None:
        return body.nodes
    corners = torch.tensor([[x, y, 0.0] for x in (-HALF, HALF) for y in (-WIDTH / 2, WIDTH / 2)], dtype=torch.float64)
    return body.r[:, :, None] + torch.einsum("ltij,nj->ltni", body.A, corners)


def _line(motion: mbd.Trajectory, name: str, length: float) -> Tensor:
    """Points along a truss in ground axes [lanes, times, n, 3]."""
    body = motion.body(name)
    if body.mesh is not None:
        return body.nodes
    along = torch.linspace(0.0, length, _SAMPLES, dtype=torch.float64)[:, None] * torch.eye(3, dtype=torch.float64)[0]
    return body.r[:, :, None] + torch.einsum("ltij,nj->ltni", body.A, along)


def _above_ground(x: Tensor) -> Tensor:
    above = (x[..., 0] > -LENGTH) & (x[..., 0] < -NEAR) & (x[..., 1].abs() < WIDTH / 2 + 1e-6)
    return _least(x[..., 2], above)


def _over(motion: mbd.Trajectory, panel: str, x: Tensor, joined: Sequence[tuple[float, float | None]]) -> Tensor:
    """Smallest gap of points x over the back of a panel; `joined`: places (x, y) or lines x = ... [m] to leave out."""
    body = motion.body(panel)
    local = torch.einsum("ltij,ltni->ltnj", body.A, x - body.r[:, :, None])
    above = (local[..., 0].abs() <= HALF + 1e-6) & (local[..., 1].abs() <= WIDTH / 2 + 1e-6)
    for px, py in joined:
        far = (local[..., 0] - px).abs() if py is None else torch.hypot(local[..., 0] - px, local[..., 1] - py)
        above = above & (far > NEAR)
    return _least(_surface(body, local) - local[..., 2], above)


def _surface(body: Any, local: Tensor) -> Tensor:
    """Height [lanes, times, n] of the bent mid-surface under points in body axes."""
    if body.mesh is None:
        return torch.zeros_like(local[..., 2])
    u = body.displacements[..., 2]
    grid = u[..., _grid(body)].flatten(0, 1)[:, None]  # [lanes times, 1, ny, nx]
    at = torch.stack([local[..., 0] / HALF, local[..., 1] / (WIDTH / 2)], -1).flatten(0, 1)[:, None]
    heights = torch.nn.functional.grid_sample(grid, at, align_corners=True, padding_mode="border")
    return heights[:, 0, 0].unflatten(0, u.shape[:2])


def _grid(body: Any) -> Tensor:
    """Nodes of a panel's mesh in rows of y and columns of x."""
    x = body.mesh.nodes
    columns, rows = (torch.unique((x[:, k] * 1e9).round()) for k in (0, 1))
    place = torch.argsort((x[:, 1] * 1e9).round() * 1e3 + x[:, 0])
    return place.reshape(len(rows), len(columns))


def _least(gap: Tensor, above: Tensor) -> Tensor:
    return torch.where(above, gap, torch.inf).amin(-1)


def verdict(motion: mbd.Trajectory, lane: int = 0) -> str:
    """What became of the deployment: "deploys", or how it fails (Fig. 17 of the paper), or why the motion does."""
    crank, panel = theta(motion)[lane], phi3(motion)[lane]
    good = torch.isfinite(crank) & torch.isfinite(panel)
    t, crank, panel = motion.t[good], crank[good], panel[good]
    passed = torch.nonzero(panel - crank > APART)
    ended = "" if motion.status[lane] == "ok" else f"; {motion.status[lane]}"
    if not len(passed):
        return "deploys" if not ended else motion.status[lane]
    return (
        f"fails as in Fig. 17: from t = {float(t[passed[0, 0]]):.3g} s on the crank runs ahead, at {float(t[-1]):.3g} s by "
        f"{float(panel[-1] - crank[-1]):.2f} rad; panel 3 turned by {float(panel[0] - panel[-1]):.2f} rad{ended}"
    )
