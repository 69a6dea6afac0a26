"""Held nodes, rigid links and averages: the map T against rigid motions, and T' K T against dense products."""

import pytest
import torch
from torch.testing import assert_close

from tests.fem.elements.plate_cases import GENERAL, irregular, rotation, turned
from torchmbd.errors import InputError
from torchmbd.fem.elements import Average, Combination, Freedoms, PlateMatrices, RigidLink

MESH = turned(irregular(0.4, 0.3, (3, 2)), rotation(4))
PARTLY = (
    RigidLink(0, 5, (0, 1, 2)),
    RigidLink(1, 5, (2, 4)),
    Average(7, (2, 3, 10, 11), (1.0, 2.0, 0.5, 1.0), (1, 5)),
    Combination(1, 3, ((0, 4, 0.5), (6, 2, -3.0), (6, 2, 1.0))),  # node 0 turns freely, so it may lead
)
LINKS = (RigidLink(0, 5), RigidLink(1, 5), Average(7, (2, 3, 10, 11), (1.0, 2.0, 0.5, 1.0)))


def dense(freedoms: Freedoms) -> torch.Tensor:
    T = torch.zeros(6 * freedoms.nodes, len(freedoms.free), dtype=torch.float64)
    T.index_put_((freedoms.rows, freedoms.cols), freedoms.factor, accumulate=True)
    return T


def rigid_motion(x: torch.Tensor) -> torch.Tensor:
    """A general small rigid motion of all nodes [6 n]."""
    u, phi = torch.tensor([0.3, -0.5, 0.2]), torch.tensor([0.7, 0.4, -0.6])
    motion = torch.cat([u + torch.linalg.cross(phi.expand_as(x), x.to(phi.dtype)), phi.expand_as(x)], 1)
    return motion.to(torch.float64).flatten()


def test_rigid_motion_passes_through_links_and_averages():
    """What follows a body that moves rigidly moves with it."""
    freedoms = Freedoms(MESH.nodes, links=LINKS)
    motion = rigid_motion(MESH.nodes)
    result = freedoms.expand(motion[freedoms.free][:, None])
    assert_close(result.flatten(), motion, rtol=1e-6, atol=1e-7)  # the motion itself is made in single precision
    assert_close(dense(freedoms) @ motion[freedoms.free], result.flatten(), rtol=1e-12, atol=1e-12)
    assert len(freedoms.free) == 6 * (len(MESH.nodes) - 3)


def test_only_the_named_components_follow():
    """Six freedoms of a node less those that follow; a rigid motion passes through links and averages."""
    freedoms, motion = Freedoms(MESH.nodes, links=PARTLY[:3]), rigid_motion(MESH.nodes)
    assert sorted(set(range(6 * len(MESH.nodes))) - set(freedoms.free.tolist())) == [0, 1, 2, 8, 10, 43, 47]
    assert_close(freedoms.expand(motion[freedoms.free][:, None]).flatten(), motion, rtol=1e-6, atol=1e-7)
    tied = dense(Freedoms(MESH.nodes, links=PARTLY))[9]  # phi_x of node 1
    own = Freedoms(MESH.nodes, links=PARTLY).free.tolist()
    assert {own[k]: float(tied[k]) for k in tied.nonzero()[:, 0].tolist()} == {4: 0.5, 38: -2.0}


@pytest.mark.parametrize(("held", "links"), [((4,), ()), ((4, 9), LINKS), ((5,), LINKS), ((4,), PARTLY)])
def test_reduced_values_are_those_of_the_product(held, links):
    """Also where the leader of a link is held: what follows it stands still."""
    freedoms = Freedoms(MESH.nodes, held, links)
    plate = PlateMatrices(MESH, GENERAL)
    values = plate.stiffness(GENERAL.entries().detach()).values
    K, T = plate.stiffness(GENERAL.entries().detach()).dense(), dense(freedoms)
    entries = freedoms.reduced(plate.pattern)
    pattern, small = entries.pattern, entries.values(values[entries.source])
    result = torch.zeros(pattern.size, pattern.size, dtype=torch.float64)
    result[pattern.rows, pattern.cols] = small
    assert_close(result, T.T @ K @ T, rtol=1e-10, atol=1e-12 * float(K.max()))
    x = torch.randn(len(freedoms.free), 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert_close(freedoms.expand(x).flatten(0, 1), T @ x)


@pytest.mark.parametrize(
    ("held", "links", "words"),
    [
        ((), (RigidLink(0, 99),), ["99", "0 to 11"]),
        ((), (RigidLink(0, 5), RigidLink(0, 6)), ["node 0", "two links"]),
        ((), (RigidLink(0, 5, (0, 1)), Combination(0, 1, ((7, 2, 1.0),))), ["components [1] of node 0", "two links"]),
        ((), (RigidLink(0, 5, (0, 6)),), ["components", "(0, 6)", "0 to 5"]),
        ((), (Combination(0, 0, ((7, 1, 1.0),)), Combination(7, 1, ((0, 0, 1.0),))), ["node", "circle"]),
        ((0,), (RigidLink(0, 5),), ["node 0", "must not be held"]),
        ((), (RigidLink(0, 5), RigidLink(5, 0)), ["node", "circle", "must follow nodes that do not follow it"]),
        ((), (Average(0, (1, 2), (1.0, 1.0)),), ["average at node 0", "one line"]),
    ],
)
def test_what_cannot_be_is_refused(held, links, words):
    with pytest.raises(InputError) as error:
        Freedoms(MESH.nodes, held, links)
    assert all(word in str(error.value) for word in words), str(error.value)


def test_chains_of_links():
    """Node 0 follows 1 in displacements, 1 follows 5; u_x of node 8 is half of u_z of node 0, u_y of node 9 stands still."""
    links = (
        RigidLink(0, 1, (0, 1, 2)),
        RigidLink(1, 5),
        Combination(8, 0, ((0, 2, 0.5),)),
        Combination(9, 1, ()),
        Average(10, (0, 1, 8), (1.0, 2.0, 1.0)),
    )
    freedoms = Freedoms(MESH.nodes, links=links)
    assert len(freedoms.free) == 6 * len(MESH.nodes) - 3 - 6 - 1 - 1 - 6
    motion = rigid_motion(MESH.nodes)
    result = freedoms.expand(motion[freedoms.free][:, None])[..., 0]
    expected = motion.reshape(-1, 6)
    assert_close(result[[0, 1]], expected[[0, 1]], rtol=1e-6, atol=1e-7)
    assert float(result[8, 0]) == pytest.approx(0.5 * float(result[0, 2]), rel=1e-12)
    assert float(result[9, 1]) == 0.0
    mean = dense(Freedoms(MESH.nodes, links=links[-1:]))[60:66]  # of what it averages, wherever that comes from
    kept = torch.tensor([f for f in range(6 * len(MESH.nodes)) if not 60 <= f < 66])
    assert_close(mean @ result.flatten()[kept], result[10], rtol=1e-9, atol=1e-12)
