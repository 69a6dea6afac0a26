"""A body whose stiffness or mass is not positive definite says which node moves, and beside which others."""

import pytest
import torch
from scipy.sparse import block_diag

import torchmbd as mbd
from torchmbd.errors import DesignFailure
from torchmbd.fem.elements import GivenElements
from torchmbd.fem.reduction import elimination


class Springs(GivenElements):
    """Springs of six directions between pairs of nodes, with rotary inertias at the nodes."""

    def masses(self):
        return super().masses()._replace(rotary=torch.ones(4, dtype=torch.float64))


@pytest.mark.parametrize(
    ("labels", "neighbor"), [((), "[23]"), (tuple(f"GRID {k} (a.bdf)" for k in range(4)), r"GRID [23] \(a\.bdf\)")]
)
def test_a_part_that_moves_without_stiffness_is_named(labels, neighbor):
    """Nodes 2 and 3 are joined by a spring, and to nothing else; a deck's nodes have the names of their cards."""
    nodes = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=torch.float64)
    sets = {"held": [0], "end": [1]}
    quads = torch.tensor([[0, 1, 2, 3]])
    mesh = mbd.Mesh(nodes, quads=quads, node_sets=sets, node_labels=labels, as_given=True)
    eye = 100.0 * torch.eye(6, dtype=torch.float64)
    K = torch.cat([torch.cat([eye, -eye], 1), torch.cat([-eye, eye], 1)])
    springs = Springs(
        mesh, [torch.arange(24).reshape(2, 12)], [torch.stack([K, K])], torch.arange(4), torch.ones(4).double()
    )
    arguments = {"modes": 2, "reference": "held", "reduction": "craig-bampton", "interface": ["end"]}
    node = neighbor if labels else f"node {neighbor}"
    words = rf"K .* {node} moves most, (along|about) [xyz]; its neighbors are {neighbor}: must be positive definite$"
    with pytest.raises(mbd.InputError, match=words):
        mbd.FlexibleBody("frame", mesh, {"springs": springs}, **arguments)


@pytest.fixture(params=[0.0, float("inf")], ids=["sparse factor", "blocks"])
def _either_factor(request, monkeypatch):
    monkeypatch.setattr(elimination, "seconds_of_fill", lambda *patterns: request.param)


@pytest.mark.usefixtures("_either_factor")
@pytest.mark.parametrize(
    "options", [{}, {"reduction": "craig-bampton", "interface": ["end"]}], ids=["vibration", "interface"]
)
def test_a_spring_that_pushes_is_named_by_the_node_that_it_pushes_most(options):
    """A chain 0-1-2-3 of springs that push along z: with nodes 0 and 1 held, node 2 goes 1.6 times as far as node 3."""
    nodes = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=torch.float64)
    mesh = mbd.Mesh(nodes, quads=torch.tensor([[0, 1, 2, 3]]), node_sets={"held": [0], "end": [1]}, as_given=True)
    spring = torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0, 1.0, 1.0], dtype=torch.float64))
    K = torch.cat([torch.cat([spring, -spring], 1), torch.cat([-spring, spring], 1)])
    places = torch.stack([torch.arange(6 * k, 6 * k + 12) for k in range(3)])
    springs = Springs(mesh, [places], [torch.stack([K] * 3)], torch.arange(4), torch.ones(4).double())
    words = r"K .* node 2 moves most, along z; its neighbors are 1, 3: must be positive definite"
    with pytest.raises(mbd.InputError, match=words):
        mbd.FlexibleBody("chain", mesh, {"springs": springs}, modes=2, reference="held", **options)


LAMINATE = mbd.Laminate(mbd.examples.carbon(), mbd.deg([45, -45]), thickness=1e-3)


@pytest.mark.extensions
@pytest.mark.usefixtures("_either_factor")
def test_supports_that_leave_a_body_movable_name_a_node():
    """A plate on a hinge along its left edge turns about it: nodes turn about y, and the last ones move most."""
    mesh = mbd.mesh.rectangle(length=0.5, width=0.1, cells=(6, 2))
    body = mbd.FlexibleBody.plate("plate", mesh, LAMINATE, modes=3, reference="left_edge")
    supports = {"left_edge": "u1 u2 u3 phi1 phi3"}
    words = r"supports of 'plate' do not hold the body: .*node \d+ moves most, about y; its neighbors are \d+, "
    with pytest.raises(DesignFailure, match=words):
        mbd.natural_frequencies(body, supports)
    with pytest.raises(DesignFailure, match=words):
        mbd.buckling.linear_buckling(body, {"right_edge": (-1.0, 0.0, 0.0)}, supports)


@pytest.mark.usefixtures("_either_factor")
@pytest.mark.parametrize(
    "options", [{}, {"reduction": "craig-bampton", "interface": [8]}], ids=["vibration", "interface"]
)
def test_matrices_of_two_bodies_in_one_name_a_node_of_the_loose_one(options):
    mesh = mbd.mesh.rectangle(length=0.5, width=0.1, cells=(2, 2))
    body = mbd.FlexibleBody.plate("plate", mesh, LAMINATE, modes=3, reference="left_edge")
    M, K = (block_diag([A, A], format="csr") for A in body.mass_and_stiffness())
    nodes = torch.cat([mesh.nodes, mesh.nodes + 1.0])
    with pytest.raises(mbd.InputError, match=r"K .*node (9|1\d) r?[xyz] move.*: must be "):
        mbd.FlexibleBody.from_matrices(
            "pair", M, K, nodes, modes=3, reference=list(mesh.node_set("left_edge")), **options
        )


@pytest.mark.usefixtures("_either_factor")
def test_a_mass_that_is_not_positive_definite_names_a_node():
    mesh = mbd.mesh.rectangle(length=0.5, width=0.1, cells=(4, 2))
    body = mbd.FlexibleBody.plate("plate", mesh, LAMINATE, modes=3, reference="left_edge", mass="consistent")
    M, K = body.mass_and_stiffness()
    M, first, second = M.tolil(), 6 * 14, 6 * 10
    for i in range(3):
        for row, column in ((first + i, second + i), (second + i, first + i)):
            M[row, column] += 9.0 * M[first + i, first + i]
    with pytest.raises(mbd.InputError, match=r"M .* node 1[04] [xyz] moves most: must be positive definite"):
        mbd.FlexibleBody.from_matrices(
            "plate", M.tocsr(), K, mesh.nodes, modes=3, reference=list(mesh.node_set("left_edge"))
        )
