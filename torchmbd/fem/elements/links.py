"""Links, by which a node depends on others: rigid links, averages, combinations; rows of the map T of freedoms.py.

rigid link    u_s = u_m + phi_m x d,  phi_s = phi_m       node s follows node m, d from m to s        (RBE2)
              or only some of the six components: a ball joint has the first three
average       the rigid motion that fits weighted nodes best, in the sense of least squares           (RBE3)
combination   u_i of one node is the weighted sum of single degrees of freedom of others                        (MPC)

Degrees of freedom that lead may follow others themselves: with D the rows of all links and F the projection on degrees of
freedom that follow, the rows of the free ones are D (1 - F) + D F D (1 - F) + ...; links that run in a circle are refused.
Checked in tests/fem/elements/test_freedoms.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import scipy.sparse
import torch
from jaxtyping import Float
from torch import Tensor

from torchmbd.errors import InputError
from torchmbd.math.rigid_motion import hat

#: Entries of T: freedoms that follow, freedoms that lead them, and factors.
Entries: TypeAlias = tuple[Tensor, Tensor, Tensor]
ALL = (0, 1, 2, 3, 4, 5)


@dataclass(frozen=True)
class RigidLink:
    """Node `node` moves with node `leader` as parts of one rigid body, in `components` 0 to 5 (ux uy uz, phi_x phi_y phi_z)."""

    node: int
    leader: int
    components: tuple[int, ...] = ALL

    def entries(self, x: Float[Tensor, "n 3"]) -> Entries:
        return _entries(self.node, self.components, [(self.leader, _rigid(x[self.node] - x[self.leader]))])

    @property
    def nodes(self) -> tuple[int, ...]:
        return (self.leader,)


@dataclass(frozen=True)
class Average:
    """Node `node` carries the mean motion of other nodes, with weights, in `components`."""

    node: int
    nodes: tuple[int, ...]
    weights: tuple[float, ...]
    components: tuple[int, ...] = ALL

    def entries(self, x: Float[Tensor, "n 3"]) -> Entries:
        return _entries(self.node, self.components, _mean(x, self))


@dataclass(frozen=True)
class Combination:
    """Component `component` of `node` is the sum of factor * component of node over `terms` (node, component, factor)."""

    node: int
    component: int
    terms: tuple[tuple[int, int, float], ...]

    def entries(self, x: Float[Tensor, "n 3"]) -> Entries:
        source = torch.tensor([6 * node + i for node, i, _ in self.terms], dtype=torch.long)
        factor = torch.tensor([a for *_, a in self.terms], dtype=x.dtype)
        return torch.full_like(source, 6 * self.node + self.component), source, factor

    @property
    def components(self) -> tuple[int, ...]:
        return (self.component,)

    @property
    def nodes(self) -> tuple[int, ...]:
        return tuple(node for node, *_ in self.terms)


#: A link that makes freedoms of a node follow others.
Follower: TypeAlias = RigidLink | Average | Combination


def link_entries(x: Float[Tensor, "n 3"], links: Sequence[Follower]) -> Entries:
    """Return the entries of all links by degrees of freedom that follow none. InputError names a node of a circle."""
    none = torch.zeros(0, dtype=torch.long)
    entries = [(none, none, x.new_zeros(0)), *(link.entries(x) for link in links)]
    led, source, factor = (torch.cat(part) for part in zip(*entries, strict=True))
    following = torch.zeros(6 * len(x), dtype=torch.bool)
    following[torch.tensor([6 * link.node + i for link in links for i in link.components], dtype=torch.long)] = True
    ends = ~following[source]
    made = [(led[ends], source[ends], factor[ends])]
    size = (6 * len(x), 6 * len(x))
    step = scipy.sparse.csr_array((factor.numpy(), (led.numpy(), source.numpy())), shape=size)
    while not bool(ends.all()):
        if len(made) > len(links):
            raise InputError(
                ("links", int(led[~ends][0]) // 6),
                allowed="must follow nodes that do not follow it",
                noun=f"node {int(led[~ends][0]) // 6}",
                state="follows itself through a circle of links",
            )
        rest = (factor[~ends].numpy(), (led[~ends].numpy(), source[~ends].numpy()))
        product = scipy.sparse.coo_array(scipy.sparse.csr_array(rest, shape=size) @ step)
        led, source = (torch.from_numpy(part.astype("int64")) for part in product.coords)
        factor = torch.from_numpy(product.data)
        ends = ~following[source]
        made.append((led[ends], source[ends], factor[ends]))
    return tuple(torch.cat(part) for part in zip(*made, strict=True))  # pyright: ignore[reportReturnType]


def check_links(n: int, held: list[int], links: Sequence[Follower]) -> None:
    for k in (*held, *(k for link in links for k in (link.node, *link.nodes))):
        if not 0 <= k < n:
            raise InputError("links", allowed=f"0 to {n - 1}", state=f"is {k}", noun="a link or a held node")
    taken: set[int] = set()
    for link in links:
        k, components = link.node, link.components
        if not components or not set(components) <= set(ALL) or len(set(components)) < len(components):
            raise InputError(
                ("links", k),
                components,
                "different numbers from 0 to 5",
                state=f"are {components}",
                noun=f"components of the link of node {k}",
            )
        again = [i for i in components if 6 * k + i in taken]
        if again:
            raise InputError(
                ("links", k),
                allowed="must follow by one link",
                state="follow other nodes by two links",
                noun=f"components {again} of node {k}",
            )
        taken |= {6 * k + i for i in components}
        if k in held:
            raise InputError(
                ("links", k),
                hint="hold the node that leads it",
                noun=f"node {k}",
                allowed="must not be held, because it follows other nodes by a link",
            )


def _entries(node: int, components: tuple[int, ...], blocks: list[tuple[int, Tensor]]) -> Entries:
    """Rows `components` of the blocks [6, 6] (leader, block), without zeros."""
    chosen = torch.tensor(components, dtype=torch.long)
    led, source, factor = [], [], []
    for leader, block in blocks:
        i, j = torch.nonzero(block[chosen], as_tuple=True)
        led.append(6 * node + chosen[i])
        source.append(6 * leader + j)
        factor.append(block[chosen][i, j])
    return torch.cat(led), torch.cat(source), torch.cat(factor)


def _rigid(d: Tensor) -> Float[Tensor, "6 6"]:
    """Motion at d from a point, from the motion of the point: u + phi x d, phi."""
    block = torch.eye(6, dtype=d.dtype)
    block[:3, 3:] = -hat(d)
    return block


def _mean(x: Tensor, link: Average) -> list[tuple[int, Tensor]]:
    """Blocks of the rigid motion at the node that fits the displacements of the others best."""
    at, w = x[link.node], x.new_tensor(link.weights) / sum(link.weights)
    fields = torch.stack([_rigid(x[node] - at)[:3] for node in link.nodes])  # displacement of each for a rigid motion
    normal = torch.einsum("k,kij,kil->jl", w, fields, fields)
    size = fields[..., 3:].abs().amax()
    scale = torch.cat([x.new_ones(3), (1.0 / size).repeat(3)]) if size > 0 else x.new_ones(6)
    values = torch.linalg.eigvalsh(normal * scale * scale[:, None])
    if float(values[0]) < 1e-10 * float(values[-1]):
        raise InputError(
            ("links", link.node),
            list(link.nodes),
            "must span a plane",
            noun=f"average at node {link.node}: nodes {list(link.nodes)}",
            state="lie on one line, so that the rotation about this line is unknown",
        )
    inverse = torch.linalg.inv(normal)
    blocks = []
    for weight, node, field in zip(w, link.nodes, fields, strict=True):
        block = x.new_zeros(6, 6)
        block[:, :3] = weight * inverse @ field.T
        blocks.append((node, block))
    return blocks
