"""Mass of a beam at its nodes: each node carries the adjacent halves of its elements as rigid bodies.

Half an element has the length h / 2, the mass m, first moment S and second moment P about the line per length, and the tangent
t that points away from the node. Its mass and moments about the node are

    mass    m h/2        first   h/2 (S + m h/4 t)        second   h/2 (P + h/4 (t S' + S t') + m h^2/12 t t')

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
    # In the axes of the line.
    W = elements.to_line @ sections.mass(elements.matrices.length, ends) @ elements.to_line.mT
    Q = elements.matrices.frames(ends).mT
    m, b = W[..., 0, 0], 0.5 * elements.matrices.length[..., None].expand(W.shape[:-2])
    S = (Q @ torch.stack([W[..., 1, 5], W[..., 2, 3], W[..., 0, 4]], -1)[..., None])[..., 0]
    J = W[..., 3:, 3:]
    P = 0.5 * J.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] * torch.eye(3, dtype=torch.float64) - J
    t = Q[..., 0] * torch.tensor([[1.0], [-1.0]], dtype=torch.float64)
    both = t[..., :, None] * S[..., None, :]
    along = t[..., :, None] * t[..., None, :]
    first = b[..., None] * (S + (0.5 * m * b)[..., None] * t)
    wide = b[..., None, None]
    second = wide * (Q @ P @ Q.mT + 0.5 * wide * (both + both.mT) + (m / 3.0)[..., None, None] * wide**2 * along)
    n, where = len(line.nodes), line.elements.flatten()
    parts = ((m * b, 0), (first, 1), (second, 2))
    return NodalMass(*(sum_at_nodes(x, where, n, k) for x, k in parts))
