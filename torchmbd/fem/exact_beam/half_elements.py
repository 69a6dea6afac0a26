"""Mass of a beam at its nodes: each node carries the adjacent halves of its elements as rigid bodies.

Half an element has the mass m, first moment S and second moment P about the line per length; s is the distance from the node,
and the tangent t points away from it. Its mass and moments about the node are integrals over h / 2:

    mass    int m ds        first   int S + m s t ds        second   int P + s (t S' + S t') + m s^2 t t' ds

A rigid motion of the whole beam has its exact momentum and energy; vibrations converge with h^2.
Checked in tests/multibody/bodies/test_flexible_beam.py.
"""

from __future__ import annotations

import torch

from torchmbd.fem.elements import BeamLine
from torchmbd.fem.exact_beam.assemble import NodalMass, sum_at_nodes
from torchmbd.fem.exact_beam.sections import ElementProperties, SpanSections


def half_element_masses(line: BeamLine, sections: SpanSections, elements: ElementProperties) -> NodalMass:
    """Masses, first and second moments of the nodes, about them, in mesh axes."""
    ends = torch.tensor([0.0, 1.0], dtype=torch.float64)
    moments = sections.mass_moments(elements.matrices.length)
    moments = [elements.to_line @ mass @ elements.to_line.mT for mass in moments]  # in the axes of the line
    Q = elements.matrices.frames(ends).mT
    m = [W[..., 0, 0] for W in moments]
    S = [(Q @ torch.stack([W[..., 1, 5], W[..., 2, 3], W[..., 0, 4]], -1)[..., None])[..., 0] for W in moments[:2]]
    J = moments[0][..., 3:, 3:]
    P = 0.5 * J.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] * torch.eye(3, dtype=torch.float64) - J
    t = Q[..., 0] * torch.tensor([[1.0], [-1.0]], dtype=torch.float64)
    both = t[..., :, None] * S[1][..., None, :]
    along = t[..., :, None] * t[..., None, :]
    first = S[0] + m[1][..., None] * t
    second = Q @ P @ Q.mT + both + both.mT + m[2][..., None, None] * along
    n, where = len(line.nodes), line.elements.flatten()
    parts = ((m[0], 0), (first, 1), (second, 2))
    return NodalMass(*(sum_at_nodes(x, where, n, k) for x, k in parts))
