"""The virtual-body claim of the paper (section 2.2): a frame on a node is a massless rigid body fixed to it, eliminated.

The massless body is made explicit here, with next to no mass, rigidly fixed to the node; the joint sits on it. Point
constraints agree to the mass that is left. A rigid body cannot follow the linearized triad of a node exactly: directions
differ by the square of the elastic rotation (2e-3 here), which is the rotation itself relative to the elastic motion.
"""

from __future__ import annotations

import pytest
import torch

import torchmbd as mbd
from tests.mechanisms import box, plate, tensor, turned

pytestmark = pytest.mark.usefixtures("compiled")

TRIAD = turned(0.5, 0.7, -0.2)
GRAVITY = (15.0, -90.0, 35.0)


def swinging(joint: str, explicit: bool, mass: float = 1e-7) -> mbd.System:
    """A plate hung up at a node through a joint to a turning box; with or without the explicit massless body.

    All bodies start with one common rotation about the origin, so that nothing is left to project.
    """
    ground, spin = mbd.Ground(), tensor(2.0, -1.0, 3.0)
    tip, axes, swing = tensor(0.2, 0.1, -0.05), turned(0.4, -0.7, 0.3), turned(-0.5, 0.2, 0.9)
    hub = axes @ tip
    center = hub - swing @ tensor(-0.15, 0.0, 0.0)
    arm = box("arm", axes=axes, angular_velocity=axes.T @ spin)
    moving = {"velocity": torch.linalg.cross(spin, center), "angular_velocity": swing.T @ spin}
    rod = plate("rod", modes=4, position=center, axes=swing, **moving)
    bodies, joints = [arm, rod], [mbd.Spherical(ground.at(), arm.at())]
    frame = rod.at("left", axes=TRIAD)
    if explicit:
        inertia = tuple(mass * 1e-4 * x for x in (1.0, 1.2, 1.4))
        moving = {"velocity": torch.linalg.cross(spin, hub), "angular_velocity": swing.T @ spin}
        virtual = mbd.RigidBody("virtual", mass, inertia, position=hub, axes=swing, **moving)
        bodies.append(virtual)
        joints.append(mbd.Fixed(frame, virtual.at(axes=TRIAD)))
        frame = virtual.at(axes=TRIAD)
    kind = {"spherical": mbd.Spherical, "universal": mbd.Universal, "revolute": mbd.Revolute}[joint]
    joints.append(kind(frame, arm.at(*tip.tolist())))
    return mbd.System(bodies, joints, gravity=GRAVITY)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("joint", "whole", "elastic"), [("spherical", 1e-7, 2e-6), ("universal", 1e-6, 1e-4), ("revolute", 1e-4, 5e-3)]
)
def test_an_explicit_massless_body_moves_the_same(joint, whole, elastic):
    """`whole`: of positions, relative to the way they went; `elastic`: of strain energy and modal coordinates."""
    options = {"steps": 100, "iterations": (6, 6), "refresh": 1, "gradients": "forward"}
    motions = [mbd.simulate(swinging(joint, explicit), 0.02, **options).require_ok() for explicit in (False, True)]
    frame, body = (motion.body("rod") for motion in motions)
    way = frame.nodes - frame.nodes[:, :1]
    assert float(way.abs().max()) > 2e-2
    assert float(frame.strain_energy.max()) > 2e-5
    for tolerance, one, other, scale in (
        (whole, frame.nodes, body.nodes, way),
        (elastic, frame.strain_energy, body.strain_energy, frame.strain_energy),
        # Mode shapes of both systems come from the same laminate, so modal coordinates compare directly.
        (elastic, frame.w, body.w, frame.w),
        (5 * elastic, frame.dw_db, body.dw_db, frame.dw_db),
    ):
        assert float((one - other).abs().max()) < tolerance * float(scale.abs().max())


@pytest.mark.thorough
def test_the_node_of_the_frame_is_the_place_of_the_virtual_body():
    motion = mbd.simulate(swinging("revolute", True), 0.01, steps=50).require_ok()
    node = motion.system.body("rod").mesh.node("left")
    gap = motion.body("virtual").r - motion.body("rod").nodes[:, :, node]
    assert float(gap.abs().max()) < 1e-9
    assert torch.linalg.matrix_norm(motion.body("virtual").A - motion.body("rod").A).max() < 0.1
