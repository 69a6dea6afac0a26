"""Frames on sets of nodes and on arms: rigid motion, weights, virtual work, and rigid sets against their leader."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

import torchmbd as mbd
from tests.mechanisms import cross_matrix, laminate, plate, tensor, turned
from tests.refused import refused
from torchmbd.multibody.bodies.interpolation import InterpolationConstraint
from torchmbd.multibody.joints.joint import Attached, AttachmentTable

pytestmark = pytest.mark.usefixtures("compiled")

MESH = mbd.mesh.rectangle(length=0.3, width=0.1, cells=(4, 2))
EDGE, CORNERS = MESH.node_sets["left_edge"], (0, 5, 14)
SETS = {
    "one node": ((7,), None),
    "a line": (EDGE, (1.0, 2.0, 1.0)),
    "three": (CORNERS, (0.3, 1.0, 2.0)),
    "all": (range(15), None),
}
every = pytest.mark.parametrize("nodes", SETS.values(), ids=SETS.keys())


def rigid(x: Tensor, u: Tensor, th: Tensor) -> Tensor:
    """Motion [nodes, 6, 1] of all nodes with a body that moves by u and turns by th, linearized."""
    return torch.cat([u + torch.linalg.cross(th.expand_as(x), x), th.expand_as(x)], 1)[..., None]


@every
def test_a_rigid_motion_is_the_motion_of_the_frame(nodes):
    interpolation, u, th = InterpolationConstraint.on(*nodes), tensor(0.2, -0.1, 0.5), tensor(0.3, 0.7, -0.4)
    result = interpolation.motion(MESH.nodes, rigid(MESH.nodes, u, th))[:, 0]
    center = interpolation.center(MESH.nodes)
    assert_close(result, torch.cat([u + torch.linalg.cross(th, center), th]), rtol=0, atol=1e-14)


@every
def test_the_mean_motion_is_the_best_fit(nodes):
    """Against a least-squares solution of all displacements; where they tell no rotation, against the nodes' own."""
    interpolation = InterpolationConstraint.on(*nodes)
    psi = torch.randn(15, 6, 1, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    d = MESH.nodes[list(interpolation.nodes)] - interpolation.center(MESH.nodes)
    fields = torch.cat([torch.cat([torch.eye(3).double(), -cross_matrix(x)], 1) for x in d])
    root = tensor(*interpolation.weights).sqrt().repeat_interleave(3)
    expected = torch.linalg.pinv(root[:, None] * fields, rtol=1e-9) @ (
        root * psi[list(interpolation.nodes), :3, 0].flatten()
    )
    own = tensor(*interpolation.weights) @ psi[list(interpolation.nodes), 3:, 0]
    if len(interpolation.nodes) == 1:
        expected[3:] = own
    elif len(interpolation.nodes) == 3 and float(d[:, 0].abs().max()) == 0.0:  # a line along y
        expected[4] = own[1]
    assert_close(interpolation.motion(MESH.nodes, psi)[:, 0], expected, rtol=0, atol=1e-13)


def test_an_arm_moves_with_its_nodes():
    body = plate("a")
    frame = body.at("left_edge", axes=turned(0.3, 0.1, 0.2), offset=(0.02, -0.05, 0.03))
    assert_close(frame.point, tensor(-0.13, -0.05, 0.03), rtol=0, atol=1e-15)
    u, th = tensor(1e-3, 2e-3, -1e-3), tensor(2e-3, -1e-3, 3e-3)
    x = MESH.nodes - body.origin
    attachments = AttachmentTable()
    attachments.point(frame), attachments.axis(frame, "y")
    point, axis = (attached.modal_rows(rigid(x, u, th))[:, 0] for attached in attachments.vectors)
    assert_close(point, u + torch.linalg.cross(th, frame.point), rtol=0, atol=1e-16)
    assert_close(axis, torch.linalg.cross(th, frame.axis("y")), rtol=0, atol=1e-16)


def hanging(**on) -> mbd.System:
    """A soft plate that hangs by a hinge along its edge."""
    body = plate(
        "panel", modes=4, cells=(4, 4), axes=turned(0.4, 0.2, 0.1), **{k: on.pop(k) for k in ("rigid",) if k in on}
    )
    frame = body.at(**on)
    place = body.axes @ frame.point
    return mbd.System([body], [mbd.Revolute(mbd.Ground().at(*place.tolist()), frame, "y")], gravity=(2.0, -9.0, 4.0))


@pytest.mark.thorough
def test_the_point_of_a_frame_stays_on_its_hinge():
    system = hanging(node="left_edge", offset=(0.0, 0.0, 0.02))
    motion = mbd.simulate(system, 0.05, steps=100).require_ok()
    frame = system.joints[0].b
    at = motion.body("panel").at(frame)
    assert_close(at.position, system.joints[0].a.point.expand_as(at.position), rtol=0, atol=1e-10)
    assert float(at.displacement.abs().max()) > 1e-9


@pytest.mark.thorough
def test_energy_is_kept_with_forces_on_a_set():
    """The mean motion and the forces on the nodes are transposes: constraint forces do no work."""
    motion = mbd.simulate(hanging(node="left_edge"), 0.1, steps=800, spectral_radius=1.0).require_ok()
    T, M = motion.dynamics.topology, motion.dynamics
    at = motion.body("panel")
    place, v = at.nodes[0], torch.gradient(at.nodes[0], spacing=float(motion.t[1]), dim=0)[0]
    assert T.rows == 5
    masses = motion.system.body("panel").assembly.masses()
    m = masses.mass.detach()
    assert float(m.sum()) == pytest.approx(float(M.data["mass"].sum()))
    kinetic = 0.5 * (m * v.square().sum(-1)).sum(-1)
    potential = -(m[:, None] * place).sum(1) @ motion.system.gravity
    total = (kinetic + potential + at.strain_energy[0])[2:-2]
    assert float((total - total[0]).abs().max()) < 2e-3 * float(kinetic.max())


def test_a_rigid_set_moves_as_its_leader():
    nodes = MESH.node_sets["right_edge"]
    body = mbd.FlexibleBody.plate("a", MESH, laminate(), modes=3, rigid=["right_edge"])
    psi = body.structure()["psi"].detach()
    lead = psi[nodes[0]]
    for node in nodes[1:]:
        d = (MESH.nodes[node] - MESH.nodes[nodes[0]])[:, None].expand(3, 3)
        assert_close(psi[node, 3:], lead[3:], rtol=0, atol=1e-14)
        assert_close(psi[node, :3], lead[:3] + torch.linalg.cross(lead[3:], d, dim=0), rtol=0, atol=1e-14)
    one, mean = (Attached(body, body.at(n).point, body.at(n).interpolation, False) for n in (nodes[0], "right_edge"))
    assert_close(
        one.modal_rows(psi), Attached(body, one.vector, mean.interpolation, False).modal_rows(psi), rtol=0, atol=1e-13
    )


@pytest.mark.parametrize(
    ("given", "path"),
    [
        (
            {"node": "left_edge", "weights": (1.0, 2.0)},
            "weights",
        ),
        ({"node": [3, 4], "weights": (1.0, -2.0)}, "weights"),
        ({"node": [3, 99]}, "node"),
        ({"node": "left_edgy"}, "node"),
        ({"node": 3, "offset": (1.0, 2.0)}, "offset"),
    ],
)
def test_frames_that_are_none(given, path):
    with refused(path):
        plate("a").at(**given)


def test_a_rigid_set_of_one_node_is_refused():
    with refused("rigid"):
        mbd.FlexibleBody.plate("a", MESH, laminate(), modes=3, rigid=["left"])
