"""Loads and masses of an exact beam at its nodes.

Checked in tests/fem/exact_beam/test_loads.py, tests/fem/exact_beam/test_vibrations.py.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.fem.elements import BeamLine
from torchmbd.fem.exact_beam.data import BeamData
from torchmbd.fem.exact_beam.loads import element_change, line_loads, nodal_loads, read_vector
from torchmbd.fem.exact_beam.sections import ElementProperties, SpanSections, block
from torchmbd.math.gradients import untransformed


class NodalMass(NamedTuple):
    """Sums of m, m a and m a a' over the particles m on arms a of each node, in the axes of the node."""

    mass: Float[Tensor, "*lanes n"]
    first: Float[Tensor, "*lanes n 3"]
    second: Float[Tensor, "*lanes n 3 3"]


def nodal_mass(line: BeamLine, sections: SpanSections, elements: ElementProperties) -> NodalMass:
    """Masses of the nodes: half of each element's mass at each of its ends."""
    length = elements.matrices.length
    mean = sections.mass_moments(length)[0] / (0.5 * length)[..., None, None, None]
    mass = elements.to_line @ mean @ elements.to_line.mT
    points = elements.matrices.particles(mass)
    n, where = len(line.nodes), points.ends[:, 0]
    m, a = points.mass, points.arm
    first = m[..., None] * a
    second = first[..., None] * a[..., None, :]
    return NodalMass(*(_sum(x, where, n, k) for x, k in ((m, 0), (first, 1), (second, 2))))


def beam_data(
    line: BeamLine,
    sections: SpanSections,
    elements: ElementProperties,
    nodes: Tensor,
    imposed: Tensor,
    arguments: dict[str, Any],
    massive: bool,
) -> tuple[BeamData, bool]:
    """Return the data of a beam under loads, and whether all loads have a potential.

    arguments  loads by name, the arguments of `ExactBeam.equilibrium`
    massive    whether masses are computed even without gravity and spin
    """
    n, where = len(line.nodes), line.elements.flatten()
    q, p = (line_loads(key, line, arguments[key]) for key in ("line_load", "follower_line_load"))
    loads, turning = (nodal_loads(key, line, arguments[key]) for key in ("loads", "follower_loads"))
    symmetric = not any(bool(untransformed(x).any()) for x in (loads[:, 3:], q[:, 3:], p, turning))
    half = 0.5 * elements.matrices.length[..., None]
    tangent = elements.axes[..., 0]  # [*lanes, m, 2, 3]
    arm = tangent * (half / 3.0)[..., None, :] * torch.tensor([[1.0], [-1.0]], dtype=torch.float64)
    share = (half * q)[..., None, :].expand(*tangent.shape[:-1], 6)
    dead = loads + sum_at_nodes(share, where, n, 1)
    arms = sum_at_nodes(arm[..., :, None] * share[..., None, :3], where, n, 2)
    push = (block(elements.axes) @ (half * p)[..., None, :, None])[..., 0]
    push = push + torch.cat([torch.zeros_like(arm), torch.linalg.cross(arm, push[..., :3])], -1)
    first = _first_ends(line)
    axes = elements.axes.flatten(-4, -3)[..., first, :, :]
    follower = (block(axes) @ turning[..., None])[..., 0] + sum_at_nodes(push, where, n, 1)
    gravity, spin, center = (read_vector(key, arguments[key]) for key in ("gravity", "spin", "center"))
    heavy = massive or bool(untransformed(gravity).any()) or bool(untransformed(spin).any())
    masses = nodal_mass(line, sections, elements) if heavy else _massless(n)
    start, end = elements.axes.unbind(-3)
    free = torch.zeros(len(line.elements), 6, dtype=torch.float64)
    for change, screws in elements.free.items():
        free = free + element_change(change, line, arguments[change])[..., None] * screws
    data = BeamData(
        elements.stiffness,
        elements.screws,
        start,
        end,
        nodes,
        dead,
        arms,
        follower,
        masses.mass,
        masses.first,
        masses.second,
        gravity,
        spin,
        center,
        imposed,
        free,
    )
    return data, symmetric


def _massless(n: int) -> NodalMass:
    return NodalMass(*(torch.zeros(n, *core, dtype=torch.float64) for core in ((), (3,), (3, 3))))


def _first_ends(line: BeamLine) -> Tensor:
    """The first element end at each node: 2 * element + end [n]."""
    flat = line.elements.flatten().tolist()
    return torch.tensor([flat.index(k) for k in range(len(line.nodes))])


def sum_at_nodes(ends: Tensor, where: Tensor, n: int, core: int) -> Tensor:
    """Sum values of element ends [*lanes, m, 2, *core axes] at their nodes [*lanes, n, *core axes]."""
    return _sum(ends.flatten(-2 - core, -1 - core), where, n, core)


def _sum(x: Tensor, where: Tensor, n: int, core: int) -> Tensor:
    dim = -1 - core
    shape = list(x.shape)
    shape[dim] = n
    return x.new_zeros(shape).index_add(dim, where, x)
