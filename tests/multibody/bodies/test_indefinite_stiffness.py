"""A body whose stiffness is not positive definite says which node moves, and beside which others."""

import pytest
import torch

import torchmbd as mbd
from torchmbd.fem.elements import GivenElements


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
    words = rf"K is not positive definite .* {node} moves most, (along|about) [xyz]; its neighbors are {neighbor}$"
    with pytest.raises(mbd.InputError, match=words):
        mbd.FlexibleBody("frame", mesh, {"springs": springs}, **arguments)
