"""A laminated panel on three joints, a ball joint and two massless links at three of its corners; a force pulls the fourth.

Its lay-up is unbalanced, it stands askew: bending, twist and the turning of the frame in space all take part.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

import torchmbd as mbd
from torchmbd.examples.slider_crank import CARBON

LENGTH, WIDTH, THICKNESS, DURATION = 0.6, 0.4, 4e-3, 0.3
FORCE = (4.0, -12.0, 6.0)  # on the free corner [N]
CORNERS = ("corner_left_bottom", "corner_right_bottom", "corner_left_top")  # ball joint, link, link
FREE = "corner_right_top"
LINKS = ((0.1, 0.35, -0.2), (-0.15, 0.4, 0.1))  # from the corners to the ground [m]


def build(
    angles: Sequence[float] = (30.0, -50.0, 70.0, 10.0), cells: tuple[int, int] = (12, 8), modes: int = 8
) -> mbd.System:
    """The panel at rest, the force in ground axes.

    angles   ply angles [deg], bottom to top, of equal layers
    cells    of the mesh along length and width
    modes    retained modes
    """
    laminate = mbd.Laminate(mbd.Ply(**CARBON), angles=mbd.deg(list(angles)), thickness=THICKNESS / len(angles))
    mesh = mbd.mesh.rectangle(length=LENGTH, width=WIDTH, cells=cells)
    axes = torch.from_numpy(Rotation.from_rotvec([0.5, -0.3, 0.4]).as_matrix())
    panel = mbd.FlexibleBody.plate("panel", mesh, laminate, modes=modes, axes=axes)
    ball, *links = corners(panel)
    ground = mbd.Ground()
    joints: list = [mbd.Spherical(ground.at(*ball.tolist()), panel.at(CORNERS[0]))]
    for corner, place, arm in zip(CORNERS[1:], links, LINKS, strict=True):
        arm = torch.tensor(arm, dtype=torch.float64)
        joints.append(
            mbd.DistanceJoint(ground.at(*(place + arm).tolist()), panel.at(corner), float(arm.norm()), name=corner)
        )
    return mbd.System([panel], joints, [mbd.Force(panel.at(FREE), FORCE)])


def corners(panel: mbd.FlexibleBody) -> list[Tensor]:
    """Places of the three corners at the start, in ground axes [3] [m]."""
    nodes = panel.mesh.nodes - panel.origin
    return [panel.position + panel.axes @ nodes[panel.mesh.node(corner)] for corner in CORNERS]
